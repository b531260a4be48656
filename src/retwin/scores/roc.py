"""ROC curves over runs, with the classes micro-averaged (the paper's figure 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

GRID = np.linspace(0, 1, 201)
"""False positive rates at which the curves of all runs are averaged."""


@dataclass(frozen=True)
class Roc:
    """Micro-averaged ROC curves over runs.

    Attributes
    ----------
    false_positive : array (201,)
        False positive rates.
    mean, deviation : array (201,)
        Mean and standard deviation over runs of the true positive rate.
    areas : array (runs,)
        Areas under the curves.

    """

    false_positive: NDArray
    mean: NDArray
    deviation: NDArray
    areas: NDArray

    @property
    def band(self) -> tuple[NDArray, NDArray]:
        """The mean minus and plus one standard deviation, within [0, 1]."""
        ends = self.mean - self.deviation, self.mean + self.deviation
        return np.clip(ends[0], 0, 1), np.clip(ends[1], 0, 1)


def micro_roc(probabilities: NDArray, truth: NDArray) -> Roc:
    """ROC curves in which every pair of trajectory and class counts as one decision.

    Parameters
    ----------
    probabilities : array (runs, n, classes)
        Predicted probabilities.
    truth : array (n,)
        True class indices.

    """
    positive = (truth[:, None] == np.arange(probabilities.shape[2])).ravel()
    curves, areas = [], []
    for run in probabilities:
        false, true = _roc(run.ravel(), positive)
        areas.append(np.trapezoid(true, false))
        # Where the curve rises vertically, its upper end counts.
        last = np.append(np.flatnonzero(np.diff(false)), len(false) - 1)
        curves.append(np.interp(GRID, false[last], true[last]))
    stacked = np.array(curves)
    deviation = stacked.std(axis=0, ddof=1) if len(stacked) > 1 else np.zeros(len(GRID))
    return Roc(GRID, stacked.mean(axis=0), deviation, np.array(areas))


def _roc(scores: NDArray, positive: NDArray) -> tuple[NDArray, NDArray]:
    falling = np.argsort(-scores, kind="stable")
    ends = np.append(np.flatnonzero(np.diff(scores[falling])), len(scores) - 1)
    true = np.cumsum(positive[falling])[ends]
    false = ends + 1 - true
    return np.r_[0, false] / max(false[-1], 1), np.r_[0, true] / max(true[-1], 1)
