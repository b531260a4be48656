"""`Segments`: the segments of each trajectory, a motion part and then a steady part.

They are found from changes of the commands, from the speed of the nominal outputs if commands do
not change by steps, or given by the user. No period is assumed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import require
from retwin.errors import InputError
from retwin.times import sample_rate
from retwin.workers.threads import in_threads

Speed = Callable[[NDArray, NDArray], NDArray]
"""From trajectories and steps, each (k,), to the speed (k,) of the commands in these steps."""
TRAJECTORIES_PER_BLOCK = 32
"""Trajectories per pass over the commands, few enough that their samples fit the cache."""


@dataclass(frozen=True, eq=False)
class Segments:
    """Segments of n trajectories, at most M each.

    Positions are in samples, counted from 0, and may be fractions: divided by the sample rate they
    are times in seconds. `given` makes them from times in seconds.

    Attributes
    ----------
    start : (n, M) array
        The onset of the motion part.
    settle : (n, M) array
        The end of the motion part and the beginning of the steady part.
    stop : (n, M) array
        The end of the steady part: the next onset, or the end of the trajectory.
    valid : (n, M) array of bool
        False where a trajectory has fewer than M segments; there start = settle = stop = steps.
    steps : int
        Samples per trajectory, T.

    Raises
    ------
    InputError
        Segments overlap or are out of order.

    """

    start: NDArray
    settle: NDArray
    stop: NDArray
    valid: NDArray
    steps: int

    def __post_init__(self) -> None:
        ordered = (self.start <= self.settle) & (self.settle <= self.stop)
        following = self.stop[:, :-1] <= self.start[:, 1:]
        if not (ordered.all() and following.all()):
            wrong = ~(ordered.all(axis=1) & following.all(axis=1))
            expected = "start <= settle <= stop <= next start in every trajectory"
            got = f"trajectory {int(np.argmax(wrong))} out of order"
            remedy = "sort the segments by time and let none overlap"
            raise InputError("segments", expected=expected, got=got, remedy=remedy)

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, index: slice | ArrayLike) -> Segments:
        """The segments of the trajectories at `index`."""
        index = index if isinstance(index, slice) else np.atleast_1d(np.asarray(index))
        part = object.__new__(Segments)  # a subset of checked segments needs no check
        for name in ("start", "settle", "stop", "valid"):
            part.__dict__[name] = getattr(self, name)[index]
        part.__dict__["steps"] = self.steps
        return part

    @property
    def max_count(self) -> int:
        """The largest number of segments in one trajectory, M."""
        return self.start.shape[1]

    def until(self, ends: ArrayLike) -> Segments:
        """The same for trajectories whose padding begins after `ends` (n,) samples."""
        ends = np.asarray(ends, dtype=float)[:, None]
        stop = np.minimum(self.stop, np.maximum(self.settle, ends))
        return replace(self, stop=stop)

    @classmethod
    def given(cls, start: ArrayLike, settle: ArrayLike, *, steps: int, rate: float) -> Segments:
        """Segments that the user gives; each steady part lasts until the next start.

        Parameters
        ----------
        start, settle : (n, M) array
            Onsets and settle times in s, NaN where there is no segment.
        steps : int
            Samples per trajectory.
        rate : float
            Sample rate in Hz.

        Raises
        ------
        InputError
            Shapes differ, or times are out of order, before 0 or after the end.

        """
        rate = sample_rate("rate", rate)
        start = np.atleast_2d(np.asarray(start, dtype=float)) * rate
        settle = np.atleast_2d(np.asarray(settle, dtype=float)) * rate
        expected = f"as many settle times as starts, {start.shape}"
        got = str(settle.shape)
        remedy = "give both for every segment"
        require(start.shape == settle.shape, "segments", expected=expected, got=got, remedy=remedy)
        valid = np.isfinite(start) & np.isfinite(settle)
        outside = valid & ((start < 0) | (settle > steps))
        if outside.any():
            expected = f"times between 0 and {steps / rate:g} s"
            got = f"{start[outside][0] / rate:g} to {settle[outside][0] / rate:g} s"
            remedy = "give onsets and settle times in seconds, not samples"
            raise InputError("segments", expected=expected, got=got, remedy=remedy)
        start = np.where(valid, start, steps)
        settle = np.where(valid, settle, steps)
        stop = np.concatenate([start[:, 1:], np.full((len(start), 1), float(steps))], axis=1)
        return cls(start, settle, np.maximum(stop, settle), valid, steps)

    @classmethod
    def from_commands(cls, commands: NDArray, *, tolerance: float = 1e-6) -> Segments:
        """Segments whose motion part is where any command changes.

        If the first change of a ramp is smaller than the next one, their ratio gives the onset as a
        fraction of a sample.

        Parameters
        ----------
        commands : (n, T, d_u) array
            Commands in any unit.
        tolerance : float
            The largest difference of two samples that counts as constant, as a share of the range
            of that command.

        """
        blocks = [
            slice(begin, begin + TRAJECTORIES_PER_BLOCK)
            for begin in range(0, len(commands), TRAJECTORIES_PER_BLOCK)
        ]

        def ends(rows: slice) -> tuple[NDArray, NDArray]:
            # One axis after the other, so that numpy's inner loop is over a whole trajectory.
            some = commands[rows]
            return some.max(axis=0).max(axis=0), some.min(axis=0).min(axis=0)

        highest, lowest = zip(*in_threads(ends, blocks), strict=True)
        extent = np.max(highest, axis=0) - np.min(lowest, axis=0)
        smallest = (tolerance * np.where(extent > 0, extent, 1)).astype(commands.dtype)
        moving = np.empty((len(commands), commands.shape[1] - 1), dtype=bool)

        def mark(rows: slice) -> None:
            some = commands[rows]
            change = np.abs(some[:, 1:] - some[:, :-1]) > smallest
            still = np.zeros(change.shape[:2], dtype=bool)  # a twin may have no inputs
            channels = np.moveaxis(change, 2, 0)
            moving[rows] = reduce(np.logical_or, channels, still)

        for _ in in_threads(mark, blocks):
            pass

        def speed(row: NDArray, step: NDArray) -> NDArray:
            after, before = (commands[row, step + i].astype(np.float64) for i in (1, 0))
            return np.abs(after - before).sum(axis=1)

        return cls._from_moving(moving, speed)

    @classmethod
    def from_path(cls, nominal: NDArray, *, threshold: float = 0.01) -> Segments:
        """Segments whose motion part is where the nominal outputs change fast.

        For systems whose commands change all the time.

        Parameters
        ----------
        nominal : (n, T, d_y) array
            Nominal outputs; each channel is divided by its range.
        threshold : float
            The smallest speed of a motion part, as a share of the highest speed.

        """
        extent = np.ptp(nominal, axis=(0, 1)).astype(np.float64)
        step = np.diff(nominal.astype(np.float64), axis=1) / np.where(extent > 0, extent, 1)
        speed = np.linalg.norm(step, axis=2)
        moving = speed > threshold * speed.max(initial=0.0)
        return cls._from_moving(moving, lambda row, step: speed[row, step])

    @classmethod
    def _from_moving(cls, moving: NDArray, speed: Speed) -> Segments:
        """Segments whose motion part is where `moving` (n, T - 1) is True.

        `speed` gives the speeds of trajectories in steps, for arrays of their indices.
        """
        padded = np.pad(moving, ((0, 0), (1, 1)))
        # padded[:, i] is True if step i - 1 -> i moves.
        row, edge = np.nonzero(padded[:, 1:] != padded[:, :-1])
        return cls.from_edges(len(moving), moving.shape[1] + 1, row, edge, speed)

    @classmethod
    def from_edges(cls, n: int, steps: int, row: NDArray, edge: NDArray, speed: Speed) -> Segments:
        """Segments of n trajectories from the samples at which they begin and cease to move.

        Parameters
        ----------
        n, steps : int
            Trajectories, and samples of each.
        row, edge : (k,) array of int
            Trajectories in order, and samples of each in order: where a motion begins, then where
            it ends, in turn.
        speed : callable
            From arrays of trajectories and of samples to the speeds from each sample to the next.

        """
        row, first, last = row[::2], edge[::2], edge[1::2]
        order = np.arange(len(row)) - np.searchsorted(row, row)
        count = int(order.max(initial=-1)) + 1
        start = np.full((n, count), float(steps))
        settle = np.full((n, count), float(steps))
        valid = np.zeros((n, count), dtype=bool)
        start[row, order] = first + _rest(speed, row, steps - 1, first, first + 1)
        settle[row, order] = last - _rest(speed, row, steps - 1, last - 1, last - 2)
        settle = np.maximum(settle, start)
        valid[row, order] = True
        stop = np.concatenate([start[:, 1:], np.full((n, 1), float(steps))], axis=1)[:, :count]
        return cls(start, np.minimum(settle, stop), stop, valid, steps)


def _rest(speed: Speed, row: NDArray, steps: int, edge: NDArray, inner: NDArray) -> NDArray:
    """The fraction (0 … 1) of the step `edge` at rest, given that `inner` moves all the time."""
    inside = (inner >= 0) & (inner < steps)
    full = speed(row, np.clip(inner, 0, steps - 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.where(inside & (full > 0), speed(row, edge) / full, 1.0)
    return 1.0 - np.clip(part, 0.0, 1.0)
