"""`evaluate`: the scores of a diagnoser on labelled trajectories."""

from __future__ import annotations

import numpy as np

from retwin.data.trajectories import Trajectories
from retwin.diagnosis import Diagnoser
from retwin.errors import InputError
from retwin.scores.classification import Scores, score

__all__ = ["evaluate"]


def evaluate(diagnoser: Diagnoser, test: Trajectories) -> Scores:
    """Score a diagnoser on labelled trajectories. Raises InputError for labels it does not know."""
    unknown = set(test.labels.tolist()) - set(diagnoser.classes)
    if unknown:
        raise InputError(
            "test",
            expected=f"labels among {', '.join(diagnoser.classes)}",
            got=f"{sorted(unknown)}",
            remedy="label every trajectory with a class the diagnoser was trained on",
        )
    truth = np.array([diagnoser.classes.index(label) for label in test.labels])
    return score(truth, diagnoser.predict_proba(test), diagnoser.classes)
