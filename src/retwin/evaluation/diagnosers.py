"""`evaluate`: the scores of a diagnoser on labelled trajectories."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from retwin.checks import instance, nothing, require
from retwin.data.trajectories import Trajectories
from retwin.diagnosis import Diagnoser
from retwin.scores.classification import Scores, score


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
        If a label is not among the classes, a probability is not finite, or `predict_proba`
        raises it.

    """
    instance("test", test, Trajectories, remedy="load recorded ones, or simulate a twin")
    return scored(test, finite_probabilities(diagnoser, test), diagnoser.classes)


def scored(test: Trajectories, probabilities: NDArray, classes: Sequence[str]) -> Scores:
    """Scores of probabilities (n, classes) of labelled trajectories; see `evaluate`."""
    unknown = set(test.labels.tolist()) - set(classes)
    remedy = "label every trajectory with a class the diagnoser was trained on"
    nothing("test", sorted(unknown), f"labels among {', '.join(classes)}", remedy=remedy)
    truth = np.array([list(classes).index(label) for label in test.labels])
    return score(truth, probabilities, classes)


def finite_probabilities(diagnoser: Diagnoser, trajectories: Trajectories) -> NDArray:
    """Probabilities (n, classes) of a diagnoser that can be scored; see `check_probabilities`."""
    probabilities = diagnoser.predict_proba(trajectories)
    check_probabilities(trajectories, probabilities)
    return probabilities


def check_probabilities(trajectories: Trajectories, probabilities: NDArray) -> None:
    """Check that probabilities (n, classes) of trajectories can be scored.

    Raises InputError if one is not finite, because its largest would be taken for a class.
    """
    failed = trajectories.ids[~np.isfinite(probabilities).all(axis=1)].tolist()
    more = f" and {len(failed) - 5} more" if len(failed) > 5 else ""
    expected = "finite probabilities from the diagnoser"
    got = f"NaN for {', '.join(failed[:5])}{more}"
    remedy = "replace sentinel values in these trajectories by NaN, or train the diagnoser anew "
    remedy += "if it gives NaN for others too"
    require(not failed, "probabilities", expected=expected, got=got, remedy=remedy)
