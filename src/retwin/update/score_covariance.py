"""`score_covariance`: what estimates vary by, where residuals depend on each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import t as student

NORMAL_95 = 1.96
"""Standard errors from an estimate to an end of its 95 % interval."""


def score_covariance(score: NDArray, residual: NDArray, measured: int) -> tuple[NDArray, NDArray]:
    """The covariance of sums of residuals that directions weight, and its degrees of freedom.

    Residuals of each output are an autoregression of first order, as their variance and lag-one
    autocorrelation say, or correlated in any way within blocks of time and independent between
    them, whichever gives the wider interval: what a wrong twin leaves is slower than its steps from
    sample to sample.

    Parameters
    ----------
    score : NDArray
        (n, P, d_y, k), weights of k directions.
    residual : NDArray
        (n, P, d_y), 0 where nothing was measured.
    measured : int
        Number of measured values.

    Returns
    -------
    covariance : NDArray
        (k, k).
    freedom : NDArray
        (k,).

    References
    ----------
    Bester, Conley and Hansen, "Inference with dependent data using cluster covariance estimators",
    Journal of Econometrics 165, 2011.

    """
    size = score.shape[-1]
    effect, plain = np.zeros((size, size)), np.full(size, 1e-300)
    for own, rest in zip(np.moveaxis(score, 2, 0), np.moveaxis(residual, 2, 0), strict=True):
        seen = np.count_nonzero(rest)  # outputs differ in noise, and in how it depends on time
        variance = float(np.sum(rest**2)) / max(seen * (1 - size / measured), 1.0)
        memory = lag_one(rest[..., None])
        after = lfilter([1.0], [1.0, -memory], own, axis=1)
        before = lfilter([1.0], [1.0, -memory], own[:, ::-1], axis=1)[:, ::-1]
        flat, by_others = own.reshape(-1, size), (after + before - own).reshape(-1, size)
        effect += variance * flat.T @ by_others
        plain += variance * np.sum(flat**2, axis=0)
    covariance = 0.5 * (effect + effect.T)
    freedom = np.maximum(measured / np.maximum(np.diag(effect) / plain, 1e-300) - size, 1.0)
    block = blocks_of(residual)
    number = int(block.max()) + 1
    weighted = score * residual[..., None]
    sums = np.zeros((number, size))
    np.add.at(sums, block.ravel(), weighted.sum(axis=2).reshape(-1, size))
    sums -= sums.mean(axis=0)
    count = np.zeros((number, size))
    np.add.at(count, block.ravel(), (score**2).sum(axis=2).reshape(-1, size))
    # Share of the information on a direction that one block may have: beyond it, as with the start
    # of a state, sums over blocks say nothing of the error.
    spread = number > 1 and (count.max(axis=0) < 0.5 * np.maximum(count.sum(axis=0), 1e-300))
    by_blocks = sums.T @ sums * number / max(number - 1, 1)
    usual = np.maximum(np.diag(covariance), 1e-300)
    factor = np.sqrt(np.where(spread, np.diag(by_blocks) / usual, 0.0))
    few = np.minimum(freedom, max(number - 1.0, 1.0))
    more = factor * student.ppf(0.975, few) > student.ppf(0.975, freedom)
    factor = np.where(more, factor, 1.0)
    return covariance * np.outer(factor, factor), np.where(more, few, freedom)


def blocks_of(residual: NDArray, *, blocks: int = 8) -> NDArray:
    """The block of time (n, P) of each sample, of `blocks` in all, with equally many measured.

    Parameters
    ----------
    blocks : int, default 8
        Blocks of time over which residuals are summed, of all trajectories together.

    """
    seen = np.any(residual != 0, axis=2)
    number = max(1, -(-blocks // len(residual)))
    place = np.cumsum(seen, axis=1) - seen
    own = place * number // np.maximum(seen.sum(axis=1, keepdims=True), 1)
    return np.asarray(np.minimum(own, number - 1) + number * np.arange(len(residual))[:, None])


def variance_of(residual: NDArray, measured: int, free: int) -> float:
    """Variance of the residuals after a fit of `free` parameters."""
    return float(np.sum(residual**2)) / max(measured - free, 1)


def lag_one(residual: NDArray, *, max_autocorrelation: float = 0.999) -> float:
    """The lag-one autocorrelation of residuals (n, P, d_y), from 0 to `max_autocorrelation`.

    Parameters
    ----------
    max_autocorrelation : float, default 0.999
        Largest lag-one autocorrelation, which bounds the correlation time at 1999 samples.

    """
    power = float(np.sum(residual**2))
    if power == 0 or residual.shape[1] < 2:
        return 0.0
    correlation = float(np.sum(residual[:, 1:] * residual[:, :-1])) / power
    return min(max(correlation, 0.0), max_autocorrelation)
