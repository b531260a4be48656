"""Exact confidence intervals of shares."""

from __future__ import annotations

from scipy.special import betaincinv

__all__ = ["share_interval"]


def share_interval(count: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """The exact interval of a binomial share.

    Parameters
    ----------
    count : int
        Successes, from 0 to `n`.
    n : int
        Trials, at least 1.
    level : float
        Confidence, in (0, 1).

    Returns
    -------
    (float, float)
        Lower and upper end; 0 or 1 where no trial or every trial is a success.

    References
    ----------
    Clopper and Pearson, The use of confidence or fiducial limits, Biometrika 1934.

    """
    tail = (1 - level) / 2
    low = float(betaincinv(count, n - count + 1, tail)) if count else 0.0
    high = float(betaincinv(count + 1, n - count, 1 - tail)) if count < n else 1.0
    return low, high
