"""`evaluate`: the scores of a diagnoser on labelled trajectories."""

from __future__ import annotations

import numpy as np

from retwin.checks import require
from retwin.data.trajectories import Trajectories
from retwin.diagnosis import Diagnoser
from retwin.scores.statistics import Scores, score

__all__ = ["evaluate"]


def evaluate(diagnoser: Diagnoser, test: Trajectories) -> Scores:
    """Score a diagnoser on labelled trajectories.

    Parameters
    ----------
    diagnoser : Diagnoser
        It predicts without the labels.
    test : Trajectories
        Labelled with classes of the diagnoser.

    Returns
    -------
    Scores
        A score that is not defined is NaN.

    Raises
    ------
    InputError
        If a label is not among the classes, or if `predict_proba` raises it.

    """
    unknown = set(test.labels.tolist()) - set(diagnoser.classes)
    require(
        not unknown,
        "test",
        expected=f"labels among {', '.join(diagnoser.classes)}",
        got=sorted(unknown),
        remedy="label every trajectory with a class the diagnoser was trained on",
    )
    truth = np.array([diagnoser.classes.index(label) for label in test.labels])
    return score(truth, diagnoser.predict_proba(test), diagnoser.classes)
