"""Bootstrap over test trajectories or over blocks of samples: draws of scores and of means.

The unit of resampling is the trajectory, since samples within one are correlated.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from retwin.scores.classification import weighted_score

__all__ = ["bootstrap", "bootstrap_means", "bootstrap_weights"]

ENOUGH_RECORDS = 5
"""With this number of records or more, whole records are resampled; with fewer, blocks of them."""
BLOCKS = 16
"""Blocks per record in the block bootstrap, a compromise of block length and number of blocks."""


def bootstrap_weights(truth: NDArray, *, draws: int, seed: int) -> NDArray:
    """Counts of each trajectory in draws with replacement within its class.

    Parameters
    ----------
    truth : array (n,)
        True class indices.
    draws : int
        Bootstrap draws.
    seed : int
        The same seed draws the same trajectories, so that two sources are paired.

    Returns
    -------
    array (draws, n)
        The counts; those of a class sum to its number of trajectories.

    """
    rng = np.random.default_rng(seed)
    weights = np.zeros((draws, len(truth)))
    for label in np.unique(truth):
        members = np.flatnonzero(truth == label)
        share = np.full(len(members), 1 / len(members))
        weights[:, members] = rng.multinomial(len(members), share, size=draws)
    return weights


def bootstrap(
    metric: str,
    truth: NDArray,
    probabilities: NDArray,
    weights: NDArray,
    classes: Sequence[str],
) -> NDArray:
    """The metric (draws,) of every draw, averaged over runs.

    Parameters
    ----------
    metric : str
        See `retwin.scores.classification.weighted_score`.
    truth : array (n,)
        True class indices.
    probabilities : array (runs, n, classes)
        Predicted probabilities.
    weights : array (draws, n)
        As `bootstrap_weights` returns them.
    classes : sequence of str
        Their names.

    """
    return np.mean(
        [weighted_score(metric, truth, run, weights, classes) for run in probabilities], axis=0
    )


def bootstrap_means(values: NDArray, *, draws: int, seed: int) -> NDArray:
    """Bootstrap draws (draws, k) of the mean over records of the mean over their samples.

    Parameters
    ----------
    values : array (n, T, k)
        Values of n records; NaN where missing.
    draws : int
        Bootstrap draws.
    seed : int
        The same seed draws the same records or blocks, so that two sources are paired.

    Notes
    -----
    Every record has the same weight. With `ENOUGH_RECORDS` records or more, whole records are drawn
    with replacement. With fewer, each record is composed anew of `BLOCKS` circular blocks of its
    samples, since neighbouring samples are correlated.

    References
    ----------
    Politis and Romano, A circular block-resampling procedure for stationary data, 1992.

    """
    rng = np.random.default_rng(seed)
    n, steps, _ = values.shape
    seen = np.isfinite(values)
    sums = np.where(seen, values, 0.0)
    if n >= ENOUGH_RECORDS:
        with np.errstate(invalid="ignore"):
            each = sums.sum(axis=1) / seen.sum(axis=1)
        return rng.multinomial(n, np.full(n, 1 / n), size=draws) @ each / n
    length = -(-steps // BLOCKS)
    drawn = np.zeros((draws, values.shape[2]))
    for record in range(n):
        begins = rng.integers(steps, size=(draws, BLOCKS))
        total, count = (
            _moving_sums(each[record], length)[begins].sum(axis=1) for each in (sums, seen)
        )
        with np.errstate(invalid="ignore"):
            drawn += total / count / n
    return drawn


def _moving_sums(values: NDArray, length: int) -> NDArray:
    """Sums (T, k) of the `length` samples from each one on; the end continues with the start."""
    circular = np.concatenate([values, values[:length]]).astype(float)
    total = np.cumsum(np.concatenate([np.zeros_like(circular[:1]), circular]), axis=0)
    return total[length : length + len(values)] - total[: len(values)]
