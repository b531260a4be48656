"""Confidence intervals of shares and of figures over trajectories, in closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv, expit, logit, stdtrit

MIN_GROUPS = 5
"""Least number of trajectories for an interval over trajectories."""
PSEUDO = 0.02
"""Weight of a trajectory with a share of 0, and of one with 1, beside the measured ones."""
LEVEL = 0.95
"""Confidence of intervals, unless it is given."""


def share_interval(count: float, n: int) -> tuple[float, float]:
    """The exact interval of a binomial share, with confidence `LEVEL`.

    Parameters
    ----------
    count : float
        Successes, from 0 to `n`.
    n : int
        Trials, at least 1.

    Returns
    -------
    (float, float)
        Lower and upper end; 0 or 1 where no trial or every trial is a success.

    References
    ----------
    Clopper and Pearson, The use of confidence or fiducial limits, Biometrika 1934.

    """
    tail = (1 - LEVEL) / 2
    low = float(betaincinv(count, n - count + 1, tail)) if count else 0.0
    high = float(betaincinv(count + 1, n - count, 1 - tail)) if count < n else 1.0
    return low, high


def grouped_share_interval(hits: NDArray, counts: NDArray) -> tuple[float, float] | None:
    """The interval of a share of dependent trials, such as the samples of trajectories.

    Parameters
    ----------
    hits, counts : array (n,)
        Successes and trials of each trajectory; real numbers, also shares of 1 trial each.

    Returns
    -------
    (float, float) or None
        None for fewer than `MIN_GROUPS` trajectories, or without a trial.

    Notes
    -----
    Student's t with n - 1 degrees of freedom on the scale of the logit, the variance being that of
    the trajectories. Two pseudo-trajectories of weight `PSEUDO`, a share of 0 and one of 1, keep
    the width above zero where all measured shares are equal. No share varies more between
    trajectories than one of single trials, so that the interval by Clopper and Pearson for n trials
    bounds it.

    """
    n, size = len(hits), float(np.mean(counts)) if len(counts) else 0.0
    if n < MIN_GROUPS or size == 0:
        return None
    hits, counts = np.append(hits, [0, size]), np.append(counts, [size, size])
    weights = np.append(np.ones(n), [PSEUDO, PSEUDO])
    share = weights @ hits / (weights @ counts)
    total = weights.sum()
    variance = weights @ np.square((hits - share * counts) / size) / (total * (total - 1))
    margin = stdtrit(n - 1, (1 + LEVEL) / 2) * np.sqrt(variance) / (share * (1 - share))
    measured = min(float(hits[:n].sum() / counts[:n].sum()), 1.0)
    least, most = share_interval(measured * n, n)
    low, high = float(expit(logit(share) - margin)), float(expit(logit(share) + margin))
    return min(max(low, least), measured), max(min(high, most), measured)


def jackknife_interval(
    of: Callable[[NDArray], NDArray], n: int, *, positive: bool = False
) -> tuple[float, float] | None:
    """The interval of a figure that is computed from weighted trajectories.

    Parameters
    ----------
    of : callable
        The figure (b,) for weights (b, n) of the trajectories, which sum to 1.
    n : int
        Trajectories.
    positive : bool
        Whether the figure is positive, such as a score or a ratio: its logarithm is used.

    Returns
    -------
    (float, float) or None
        None for fewer than `MIN_GROUPS` trajectories, or where the figure is not defined without
        one of them.

    Notes
    -----
    Student's t with n - 1 degrees of freedom and the jackknife's standard error.

    References
    ----------
    Efron and Tibshirani, An Introduction to the Bootstrap, 1993, chapter 11.

    """
    if n < MIN_GROUPS:
        return None
    without = (1 - np.eye(n)) / (n - 1)
    values = of(np.vstack([np.full((1, n), 1 / n), without]))
    if positive:
        with np.errstate(invalid="ignore", divide="ignore"):
            values = np.log(values)
    if not np.isfinite(values).all():
        return None
    error = np.sqrt((n - 1) * values[1:].var())
    margin = stdtrit(n - 1, (1 + LEVEL) / 2) * error
    ends = values[0] - margin, values[0] + margin
    low, high = np.exp(ends) if positive else ends
    return float(low), float(high)
