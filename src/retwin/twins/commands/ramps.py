"""Ramps and holds: the commands of a system that goes from one level to the next."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from retwin.twins.compiled.commands import ramped

TRAJECTORIES_PER_BLOCK = 32
"""Number of trajectories that are computed together, so few that their samples stay in the
processor's cache."""


def ramps_and_holds(
    start: NDArray,
    levels: NDArray,
    spans: NDArray,
    onsets: NDArray,
    steps: int,
    *,
    dtype: type[np.floating] = np.float64,
) -> NDArray:
    """Commands that ramp linearly from level to level and hold.

    Parameters
    ----------
    start : ndarray, shape (n, d_u)
        Level before the first segment.
    levels : ndarray, shape (n, M, d_u)
        Level at the end of each segment's ramp.
    spans : ndarray, shape (n, M, d_u)
        Duration of each ramp in samples, above 0.
    onsets : ndarray, shape (n, M)
        Onset of each segment in samples, fractions allowed; NaN leaves the segment out.
    steps : int
        Samples per trajectory.
    dtype : type, default float64
        Type of the result; computations are in double precision.

    Returns
    -------
    ndarray, shape (n, steps, d_u)
        Commands in the unit of the levels.

    """
    if dtype is np.float32:
        made = ramped(start, levels, spans, onsets, steps)
        if made is not None:
            return made
    commands = np.empty((len(start), steps, start.shape[1]), dtype)
    for begin in range(0, len(start), TRAJECTORIES_PER_BLOCK):
        block = slice(begin, begin + TRAJECTORIES_PER_BLOCK)
        commands[block] = _ramp(start[block], levels[block], spans[block], onsets[block], steps)
    return commands


def _ramp(start: NDArray, levels: NDArray, spans: NDArray, onsets: NDArray, steps: int) -> NDArray:
    """`ramps_and_holds` of one block; ramps are only evaluated in the samples that they span."""
    exists = ~np.isnan(onsets)
    onsets = np.where(exists, onsets, np.inf)
    changes = np.diff(levels, axis=1, prepend=start[:, None]) * exists[..., None]
    first = onsets.min(axis=0)
    last = np.where(exists[..., None], onsets[..., None] + spans, 0).max(axis=(0, 2)) + 1
    windows = np.clip([np.floor(first), np.ceil(last)], 0, steps).astype(int).T.tolist()
    commands = np.empty((len(start), steps, start.shape[1]))
    time, level, done = np.arange(steps), start[:, None], 0
    for segment, (begin, end) in enumerate(windows):
        end = max(end, done)
        commands[:, done:end] = level
        elapsed = time[begin:end] - onsets[:, segment, None]
        fraction = np.clip(elapsed[..., None] / spans[:, None, segment], 0.0, 1.0)
        commands[:, begin:end] += changes[:, None, segment] * fraction
        level, done = level + changes[:, None, segment], end
    commands[:, done:] = level
    return commands


def draw_onsets(
    count: int, segments: int, period: float, *, rng: np.random.Generator, given: NDArray | None
) -> NDArray:
    """Draw the onsets of segments.

    Parameters
    ----------
    count : int
        Trajectories, n.
    segments : int
        Segments per trajectory, M.
    period : float
        Samples from one onset to the next.
    rng : numpy.random.Generator
        Source of the draw.
    given : ndarray, shape (k, m), optional
        Onsets in samples of k real trajectories, of which each trajectory gets one at random.
        Where that has no onset (NaN, or m below M), the segment begins a period after the segment
        before. Without it, onsets are evenly spaced from sample 0 on.

    Returns
    -------
    ndarray, shape (n, M)
        Onsets in samples.

    """
    if given is None or len(given) == 0:
        return np.tile(period * np.arange(segments, dtype=float), (count, 1))
    drawn = given[rng.integers(len(given), size=count), :segments]
    onsets = np.full((count, segments), np.nan)
    onsets[:, : drawn.shape[1]] = drawn
    for segment in range(segments):
        before = onsets[:, segment - 1] + period if segment else np.zeros(count)
        missing = np.isnan(onsets[:, segment])
        onsets[missing, segment] = before[missing]
    return onsets
