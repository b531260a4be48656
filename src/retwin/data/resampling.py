"""Series of irregular times on a grid of samples: held, along straight lines, or as they are."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Resampling = Literal["hold", "linear", "none"]
BRIDGED = 2.5
"""Longest interval that is bridged by default, in sample periods: one lost sample."""
SAME = 1e-3
"""Difference of times, in sample periods, that is rounding."""


def longest_bridge(times: NDArray, period: float) -> float:
    """The longest interval in s that is bridged by default: 2.5 times the sample period or the
    median interval of the times (n,), whichever is longer.
    """
    typical = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return BRIDGED * max(period, typical)


def is_sparse(times: NDArray, period: float, *, sparse: float = 1.5) -> bool:
    """Whether values at times (n,) have fewer samples than a period of so many s would give.

    Samples between them would be interpolated: they show no noise, and hold no information.

    Parameters
    ----------
    sparse : float, default 1.5
        Median interval, in sample periods, from which values are fewer than the samples.

    """
    return len(times) > 1 and float(np.median(np.diff(times))) > sparse * period


def resample(
    times: NDArray,
    values: NDArray,
    grid: NDArray,
    period: float,
    how: Resampling,
    *,
    longest: float,
    end: float | None = None,
) -> NDArray:
    """Values (n,) at increasing times (n,), in s, on a grid (N,); NaN where they are missing.

    Parameters
    ----------
    times, values : (n,) array
        The series; values that are not finite count as missing.
    grid : (N,) array
        The times of the samples, in s.
    period : float
        The sample period in s.
    how : {"hold", "linear", "none"}
        `hold`: a value holds until the next one, and a sample is the mean over the period that
        begins with it, so that a pulse keeps its area. `linear`: along straight lines. `none`: the
        value that is nearest, at most half a period away.
    longest : float
        The longest interval between values that is bridged, in s.
    end : float, optional
        The time until which the series was recorded: the last value is held until then, if it is
        not further away than `longest`. By default nothing is known after the last value.

    """
    made = np.full(len(grid), np.nan)
    known = np.isfinite(values)
    if not known.any():
        return made
    at, own = times[known], values[known]
    if how == "none":
        after = np.clip(np.searchsorted(at, grid), 0, len(at) - 1)
        before = np.maximum(after - 1, 0)
        nearest = np.where(np.abs(at[before] - grid) <= np.abs(at[after] - grid), before, after)
        near = np.abs(at[nearest] - grid) <= (0.5 + SAME) * period
        made[near] = own[nearest[near]]
        return made
    margin = SAME * period
    before = np.searchsorted(at, grid + margin, side="right") - 1
    after = np.searchsorted(at, grid - margin)
    bridged = (before >= 0) & (after < len(at))
    bridged[bridged] = (at[after[bridged]] - at[before[bridged]]) <= longest + margin
    if how == "hold" and end is not None and end - at[-1] <= longest + margin:
        bridged |= (before == len(at) - 1) & (grid <= end + margin)
    found = _means(at, own, grid, period) if how == "hold" else np.interp(grid, at, own)
    made[bridged] = found[bridged]
    return made


def _means(at: NDArray, values: NDArray, grid: NDArray, period: float) -> NDArray:
    """Means over a period from each time of the grid, of values that are held from `at` on."""
    until = np.append(at, max(at[-1], grid[-1]) + period)
    area = np.concatenate([[0.0], np.cumsum(values * np.diff(until))])
    means = (np.interp(grid + period, until, area) - np.interp(grid, until, area)) / period
    return np.clip(means, values.min(), values.max())  # against rounding
