"""Scores of predictive distributions that are given as draws: CRPS, log score, PIT, coverage.

All functions are pure functions of arrays. The draws of an ensemble are along the first axis.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from retwin.checks import one_of

LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Levels of the quantiles that bound the central 50 and 90 % bands, and the median."""

BANDS = {50: (1, 3), 90: (0, 4)}
"""Level of a central band in percent, and the indices of its bounds in `LEVELS`."""


def quantiles(draws: NDArray, levels: Sequence[float] = LEVELS) -> NDArray:
    """Quantiles (levels, ...) of draws (m, ...) that are unbiased in their coverage.

    One more independent draw is below each of them with exactly the probability `level` (the
    "weibull" definition), however small m is.
    """
    return np.quantile(draws, levels, axis=0, method="weibull")


def central_band(bands: NDArray, level: int) -> tuple[NDArray, NDArray]:
    """Lower and upper bound of the central 50 or 90 % band.

    Parameters
    ----------
    bands : NDArray
        (n, len(LEVELS), …), quantiles at `LEVELS`; the bounds lack that axis.
    level : int
        50 or 90.

    Raises
    ------
    InputError
        If there is no such band.

    """
    low, high = BANDS[one_of("level", level, BANDS)]
    return bands[:, low], bands[:, high]


def inside(observed: NDArray, low: NDArray, high: NDArray) -> NDArray:
    """1 where a value lies between its bounds, ends included, else 0; NaN where it is missing."""
    within = (low <= observed) & (observed <= high)
    return np.where(np.isnan(observed), np.nan, within)


def crps(observed: NDArray, draws: NDArray) -> NDArray:
    """Continuous ranked probability score of each value, in its unit.

    Parameters
    ----------
    observed : NDArray
        Values (...).
    draws : NDArray
        Draws (m, ...) of each, two at least.

    Returns
    -------
    NDArray
        Scores (...), without the bias of a finite ensemble, so that ensembles of different sizes
        compare; NaN where a value is missing.

    References
    ----------
    Zamo and Naveau, "Estimation of the continuous ranked probability score with limited
    information", Mathematical Geosciences 50 (2018): the estimator by probability weighted
    moments.

    """
    # To import `scoringrules` takes 3 s where numba is installed: it compiles all of its scores.
    count = len(draws)
    rank = np.arange(count).reshape(-1, *[1] * (draws.ndim - 1))
    spread = (rank * np.sort(draws, axis=0)).sum(axis=0) / (count * (count - 1.0))
    return np.abs(draws - observed).mean(axis=0) + draws.mean(axis=0) - 2 * spread


def crps_normal(observed: NDArray, mean: NDArray, deviation: NDArray) -> NDArray:
    """Continuous ranked probability score of each value for a normal distribution, in its unit.

    Parameters
    ----------
    observed, mean, deviation : NDArray
        Values (...), and the mean and the standard deviation that are predicted of each, above 0.

    Returns
    -------
    NDArray
        Scores (...), NaN where a value is missing.

    References
    ----------
    Gneiting, Raftery, Westveld and Goldman, "Calibrated probabilistic forecasting using ensemble
    model output statistics", Monthly Weather Review 133 (2005), equation 5.

    """
    distance = (observed - mean) / deviation
    density = np.exp(-0.5 * distance**2) / np.sqrt(2 * np.pi)
    unit: NDArray = distance * (2 * ndtr(distance) - 1) + 2 * density - 1 / np.sqrt(np.pi)
    return deviation * unit


def log_score(observed: NDArray, draws: NDArray) -> NDArray:
    """Negative log density of each value, in nats, of a normal with the draws' mean and variance.

    Draws of any source have a mean and a variance, so that all are treated alike, and the score is
    proper for these two moments. A change of the unit adds the same constant for every source.

    Parameters
    ----------
    observed : NDArray
        Values (...).
    draws : NDArray
        Draws (m, ...) of each, two at least.

    Returns
    -------
    NDArray
        Scores (...), lower is better; infinite where all draws are equal, NaN where a value is
        missing.

    References
    ----------
    Dawid and Sebastiani, "Coherent dispersion criteria for optimal experimental design", Annals of
    Statistics 27 (1999); Gneiting and Raftery, "Strictly proper scoring rules, prediction, and
    estimation", JASA 102 (2007), section 4.

    """
    differ = draws.max(axis=0) > draws.min(axis=0)  # the variance of equal ones is a rounding error
    variance = np.where(differ, draws.var(axis=0, ddof=1), np.nan)
    square = np.square(observed - draws.mean(axis=0)) / variance
    score = 0.5 * (np.log(2 * np.pi * variance) + square)
    return np.where(np.isnan(observed) | differ, score, np.inf)


def pit_histograms(
    ensemble: NDArray, *, members: int, bins: int, rng: np.random.Generator
) -> NDArray:
    """Histograms of the probability integral transform of members among all others.

    Parameters
    ----------
    ensemble : NDArray
        Members (m, P, d) at P samples of d outputs. Equal values are ranked at random, and the
        PIT is drawn uniformly within its step.
    members : int
        Histograms are returned of the first ones of these.
    bins : int
        Bins of equal width from 0 to 1.
    rng : numpy.random.Generator
        Source of the random ranks.

    Returns
    -------
    NDArray
        Shares (members, d, bins), float32, that sum to 1 over the bins.

    References
    ----------
    Gneiting, Balabdaoui and Raftery, "Probabilistic forecasts, calibration and sharpness", JRSS B
    69 (2007).

    """
    order = np.lexsort((rng.random(ensemble.shape), ensemble), axis=0)
    rank = np.empty_like(order)
    np.put_along_axis(rank, order, np.arange(len(ensemble))[:, None, None], axis=0)
    first = rank[:members]
    place = ((first + rng.random(first.shape)) / len(ensemble) * bins).astype(int)
    place = place.clip(max=bins - 1)
    count, samples, outputs = place.shape
    row = np.arange(count)[:, None, None] * outputs + np.arange(outputs)
    counts = np.bincount((row * bins + place).ravel(), minlength=count * outputs * bins)
    return (counts.reshape(count, outputs, bins) / samples).astype(np.float32)


def grouped_quantile(groups: Sequence[NDArray], level: float) -> float:
    """The least value that a share `level` of the groups' mixture does not exceed.

    Each group of values has the same weight in the mixture, however many values it has.
    """
    pooled = np.concatenate(groups)
    weights = np.concatenate([np.full(each.size, 1 / each.size) for each in groups])
    order = np.argsort(pooled, kind="stable")
    cumulative = np.cumsum(weights[order]) / len(groups)
    # The tolerance allows for the rounding of the sum.
    return float(pooled[order][np.searchsorted(cumulative, level - 1e-9)])


def further_group_quantile(groups: Sequence[NDArray], level: float) -> float:
    """The same for a mixture with one further group, taken to be as large as the largest.

    The largest group is the one with the largest quantile at `level` of its own.
    """
    largest = max(groups, key=lambda each: grouped_quantile([each], level))
    return grouped_quantile([*groups, largest], level)


def cumulative_counts(values: NDArray, places: int) -> tuple[NDArray, NDArray]:
    """Counts from which empirical distribution functions are made.

    Parameters
    ----------
    values : NDArray
        (n, m, k), NaN where missing; some value must be finite.
    places : int
        Largest number of values at which the functions are evaluated.

    Returns
    -------
    below, count : NDArray
        (n, m, places) values of each (n, m) that are not above each place, and (n, m, 1) values
        of each.

    """
    finite = np.isfinite(values)
    grid = np.unique(values[finite])
    grid = grid[:: -(-len(grid) // places)]
    below = (values[..., None] <= grid).sum(axis=2).astype(float)
    return below, finite.sum(axis=2)[..., None].astype(float)


def ks_distance(below: NDArray, count: NDArray, weights: NDArray, member: int) -> NDArray:
    """Kolmogorov–Smirnov distance between one member and all others.

    Parameters
    ----------
    below, count : NDArray
        See `cumulative_counts`.
    weights : NDArray
        Weights (b, n) of the n sets in each of b resamplings.
    member : int
        Index of the member, from 0 to m - 1.

    Returns
    -------
    NDArray
        Distances (b,) from 0 to 1; NaN where either side has no value.

    """
    others = np.arange(below.shape[1]) != member
    with np.errstate(invalid="ignore", divide="ignore"):
        one = (weights @ below[:, member]) / (weights @ count[:, member])
        rest = (weights @ below[:, others].sum(1)) / (weights @ count[:, others].sum(1))
    return np.abs(one - rest).max(axis=1)


def share_as_far(distances: NDArray) -> float:
    """Monte Carlo p-value of the first distance among exchangeable ones: NaN ones are left out."""
    known = distances[np.isfinite(distances)]
    return float((known >= distances[0] - 1e-12).mean())
