"""The error of a twin before and after its update, over the same trajectories."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.scores.intervals import jackknife_interval

MAX_FACTOR = 20
"""Multiple of the present trajectories beyond which no number of them is given."""


@dataclass(frozen=True)
class ErrorChange:
    """Errors of n trajectories, before and after.

    The error is the mean absolute one, for which a median is the best prediction, unless it is
    stated otherwise.

    Attributes
    ----------
    before, after : float
        Mean over all samples of all trajectories and over outputs.
    ratio : float
        After divided by before.
    ratio_interval : (float, float) or None
        The paired 95 % interval of the ratio over trajectories; None for fewer than five.
    outputs_before, outputs_after : array (d,)
        The same for each output.
    trajectories : int
        n.

    """

    before: float
    after: float
    ratio: float
    ratio_interval: tuple[float, float] | None
    outputs_before: NDArray
    outputs_after: NDArray
    trajectories: int


def error_change(
    before: NDArray, after: NDArray, observed: NDArray, scale: ArrayLike = 1.0
) -> ErrorChange | None:
    """The change of the error of predictions of the same measured trajectories.

    Parameters
    ----------
    before, after : array (n, P, d)
        Predictions.
    observed : array (n, P, d)
        The measured outputs, NaN where nothing was measured.
    scale : array (d,), optional
        Factors of the outputs, which bring them to one unit.

    Returns
    -------
    ErrorChange or None
        None if nothing was measured. The interval is that of the jackknife over trajectories, on
        the scale of the logarithm.

    """
    errors = [np.asarray(scale) * (np.asarray(each, float) - observed) for each in (before, after)]
    seen = np.isfinite(errors[0]) & np.isfinite(errors[1])
    counts = seen.sum(axis=1)
    used = counts.any(axis=1)
    if not used.any():
        return None
    sums = [np.where(seen, np.abs(each), 0.0).sum(axis=1)[used] for each in errors]
    counts, n = counts[used], int(used.sum())

    def mean(which: int, weights: NDArray) -> NDArray:
        return weights @ sums[which].sum(axis=1) / (weights @ counts.sum(axis=1))

    def ratio(weights: NDArray) -> NDArray:
        with np.errstate(invalid="ignore", divide="ignore"):
            return mean(1, weights) / mean(0, weights)

    whole = np.full((1, n), 1 / n)
    with np.errstate(invalid="ignore", divide="ignore"):
        outputs = [each.sum(axis=0) / counts.sum(axis=0) for each in sums]
    return ErrorChange(
        float(mean(0, whole)[0]),
        float(mean(1, whole)[0]),
        float(ratio(whole)[0]),
        jackknife_interval(ratio, n, positive=True),
        outputs[0],
        outputs[1],
        n,
    )


def needed_to_decide(change: ErrorChange) -> int | None:
    """About how many trajectories would make the interval of the ratio exclude 1.

    The width of the interval, on the scale of the logarithm, shrinks with the square root of the
    number of trajectories; the ratio is taken to stay as it is.

    Parameters
    ----------
    change : ErrorChange
        The change of the error.

    Returns
    -------
    int or None
        More than there are; None if the ratio is decided already, has no interval, is 1, or would
        take more than 20 times as many.

    """
    if change.ratio_interval is None or change.ratio <= 0 or change.ratio == 1:
        return None
    low, high = change.ratio_interval
    if low > 1 or high < 1 or low <= 0:
        return None
    ratio = math.log(change.ratio)
    toward = math.log(high) - ratio if ratio < 0 else ratio - math.log(low)
    needed = math.ceil(change.trajectories * (toward / ratio) ** 2)
    return (
        None if needed > MAX_FACTOR * change.trajectories else max(needed, change.trajectories + 1)
    )
