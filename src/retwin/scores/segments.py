"""Delay (TDe) and position error (TPE) of one segment, read from its nominal and observed output.

The figures are for illustration in one output; the correction infers z from all outputs jointly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class SegmentError:
    """The error of one segment in one output.

    Attributes
    ----------
    output : int
        Index of the output.
    onset, settle, end : float
        Start of the motion, start of the steady part, and end of the segment, in s.
    midpoints : two pairs of float
        Time in s and value at which the nominal and the observed output are midway between their
        steady values before and after; the time is NaN if it never is.
    offset : float
        Mean observed minus mean nominal output of the steady part (TPE).

    """

    output: int
    onset: float
    settle: float
    end: float
    midpoints: tuple[tuple[float, float], tuple[float, float]]
    offset: float

    @property
    def delay(self) -> float:
        """Time by which the observed output passes its midpoint later (TDe), in s."""
        return self.midpoints[1][0] - self.midpoints[0][0]


def median_error_trajectory(
    nominal: NDArray,
    observed: NDArray,
    times: NDArray,
    candidates: NDArray,
    *,
    at_least: float = 1.0,
) -> int | None:
    """The candidate with the median RMS error, of those that were observed completely.

    Parameters
    ----------
    nominal, observed : array (n, P, d)
        Outputs; observed is NaN where nothing was measured.
    times : array (n, M, 3)
        Onset, start of the steady part and end of every segment in s; NaN for no segment.
    candidates : array (n,)
        Whether each trajectory may be chosen.
    at_least : float
        The share of its values from 0 to 1 that must have been observed.

    Returns
    -------
    int or None
        Its index; None if there is no such trajectory.

    """
    seen = np.isfinite(observed)
    squares = np.where(seen, np.square(observed - nominal), 0.0).sum(axis=(1, 2))
    error = np.sqrt(squares / np.maximum(seen.sum(axis=(1, 2)), 1))
    known = (seen.mean(axis=(1, 2)) >= at_least) & np.isfinite(times).any(axis=(1, 2))
    known &= seen.any(axis=(1, 2))
    usable = np.flatnonzero(known & candidates)
    if not len(usable):
        return None
    return int(usable[np.argsort(error[usable], kind="stable")[(len(usable) - 1) // 2]])


def clearest_segment(
    nominal: NDArray, observed: NDArray, times: NDArray, rate: float
) -> SegmentError | None:
    """The segment and output with the largest offset relative to the range of the motion.

    Segments that move an output by less than half of its largest step are left out, and so is the
    first segment, since nothing precedes it.

    Parameters
    ----------
    nominal, observed : array (P, d)
        Outputs of one trajectory.
    times : array (M, 3)
        Onset, start of the steady part and end of every segment in s; NaN for no segment.
    rate : float
        Sample rate in Hz.

    Returns
    -------
    SegmentError or None
        None if no segment has a steady part before and after it.

    """
    both = nominal, observed
    time = np.arange(len(nominal)) / rate
    times = times[np.isfinite(times).all(axis=1)]
    steady = [(time >= settle) & (time < end) for _, settle, end in times]
    whole = [m for m in range(1, len(times)) if steady[m].sum() > 1 and steady[m - 1].sum() > 1]
    if not whole:
        return None
    before, after = (
        np.array([[values[steady[m - back]].mean(axis=0) for m in whole] for values in both])
        for back in (1, 0)
    )
    steps, offsets = after[0] - before[0], after[1] - after[0]
    inside = [(time >= times[m, 0]) & (time <= times[m, 2]) for m in whole]
    extent = np.array([np.ptp(nominal[part], axis=0) for part in inside])
    large = (np.abs(steps) >= 0.5 * np.abs(steps).max(axis=0)) & (extent > 0)
    relative = np.where(large, np.abs(offsets) / np.where(extent > 0, extent, 1), -1)
    row, output = map(int, np.unravel_index(np.argmax(relative), relative.shape))
    onset, settle, end = map(float, times[whole[row]])
    levels = (before + after)[:, row, output] / 2
    midpoints = [
        (_crossing(time[inside[row]], values[inside[row], output], level), float(level))
        for values, level in zip(both, levels, strict=True)
    ]
    return SegmentError(
        output, onset, settle, end, (midpoints[0], midpoints[1]), float(offsets[row, output])
    )


def _crossing(time: NDArray, values: NDArray, level: float) -> float:
    """The time at which the values first cross the level, interpolated linearly; NaN if never."""
    above = values >= level
    crossings = np.flatnonzero(above[1:] != above[:-1])
    if not len(crossings):
        return math.nan
    i = crossings[0]
    share = (level - values[i]) / (values[i + 1] - values[i])
    return float(time[i] + share * (time[i + 1] - time[i]))
