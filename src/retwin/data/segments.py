"""`Segments`: the movements of each trajectory, a motion part and then a steady part.

Found from command events; for twins without events, from the speed of the nominal path; or given
by the user. Onsets jitter and may fall between samples: nothing here assumes a fixed period.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.errors import InputError

__all__ = ["Segments"]

BLOCK = 32
"""Trajectories that are looked at together: their samples stay in the processor's cache."""


@dataclass(frozen=True, eq=False)
class Segments:
    """Movements of n trajectories, at most M each, in samples (fractions allowed).

    Attributes
    ----------
    start: (n, M), onset of the motion part.
    settle: (n, M), end of the motion part and begin of the steady part.
    stop: (n, M), end of the steady part: the next onset, or the end of the trajectory.
    valid: (n, M) bool; where False, start = settle = stop = steps and nothing moves.
    steps: samples per trajectory.

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
            raise InputError(
                "segments",
                expected="start <= settle <= stop <= next start in every trajectory",
                got=f"trajectory {int(np.argmin(ordered.all(1)))} out of order",
                remedy="sort the segments by time and let none overlap",
            )

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, index: slice | ArrayLike) -> Segments:
        """The segments of the trajectories at `index`."""
        index = index if isinstance(index, slice) else np.atleast_1d(np.asarray(index))
        part = object.__new__(Segments)  # of what is in order, a part need not be checked again
        for name in ("start", "settle", "stop", "valid"):
            part.__dict__[name] = getattr(self, name)[index]
        part.__dict__["steps"] = self.steps
        return part

    @property
    def most(self) -> int:
        """The largest number of movements in one trajectory, M."""
        return self.start.shape[1]

    def until(self, ends: ArrayLike) -> Segments:
        """The same in trajectories that end after `ends` (n,) samples; what follows is padding."""
        ends = np.asarray(ends, dtype=float)[:, None]
        stop = np.minimum(self.stop, np.maximum(self.settle, ends))
        return replace(self, stop=stop)

    @classmethod
    def given(cls, start: ArrayLike, settle: ArrayLike, *, steps: int) -> Segments:
        """Segments the user names: `start` and `settle` (n, M) in samples, NaN where there is none.

        The steady part lasts until the next start. Raises InputError when they are out of order or
        beyond `steps`.
        """
        start = np.atleast_2d(np.asarray(start, dtype=float))
        settle = np.atleast_2d(np.asarray(settle, dtype=float))
        if start.shape != settle.shape:
            raise InputError(
                "segments",
                expected=f"as many settle times as starts, {start.shape}",
                got=str(settle.shape),
                remedy="give both for every movement",
            )
        valid = np.isfinite(start) & np.isfinite(settle)
        outside = valid & ((start < 0) | (settle > steps))
        if outside.any():
            raise InputError(
                "segments",
                expected=f"times between 0 and {steps} samples",
                got=f"{start[outside][0]:g} to {settle[outside][0]:g}",
                remedy="give onsets and settle times in samples, not seconds",
            )
        start = np.where(valid, start, steps)
        settle = np.where(valid, settle, steps)
        stop = np.concatenate([start[:, 1:], np.full((len(start), 1), float(steps))], axis=1)
        return cls(start, settle, np.maximum(stop, settle), valid, steps)

    @classmethod
    def from_commands(cls, commands: NDArray, *, tolerance: float = 1e-6) -> Segments:
        """Movements where any command changes: (n, T, d_u) in, sub-sample onsets out.

        A change below `tolerance` times the range of that command is none. On a ramp, the first
        step that is a part of the following one tells the fraction of a sample at which it began.
        """
        # One axis after the other: so numpy's inner loop is over a whole trajectory.
        highest, lowest = commands.max(axis=0).max(axis=0), commands.min(axis=0).min(axis=0)
        extent = highest - lowest
        least = (tolerance * np.where(extent > 0, extent, 1)).astype(commands.dtype)
        moving = np.empty((len(commands), commands.shape[1] - 1), dtype=bool)
        for begin in range(0, len(commands), BLOCK):
            some = commands[begin : begin + BLOCK]
            change = np.abs(some[:, 1:] - some[:, :-1]) > least
            none = np.zeros(change.shape[:2], dtype=bool)  # a twin may have no inputs
            moving[begin : begin + BLOCK] = reduce(np.logical_or, np.moveaxis(change, 2, 0), none)

        def speed(row: NDArray, step: NDArray) -> NDArray:
            after, before = (commands[row, step + late].astype(np.float64) for late in (1, 0))
            return np.abs(after - before).sum(axis=1)

        return cls._from_moving(moving, speed)

    @classmethod
    def from_path(cls, nominal: NDArray, *, threshold: float = 0.01) -> Segments:
        """Movements where the nominal path (n, T, d_y) is faster than `threshold` × its top speed.

        For twins whose commands have no events. Channels are scaled by their ranges first.
        """
        extent = np.ptp(nominal, axis=(0, 1)).astype(np.float64)
        step = np.diff(nominal.astype(np.float64), axis=1) / np.where(extent > 0, extent, 1)
        speed = np.linalg.norm(step, axis=2)
        moving = speed > threshold * speed.max(initial=0.0)
        return cls._from_moving(moving, lambda row, step: speed[row, step])

    @classmethod
    def _from_moving(
        cls, moving: NDArray, speed: Callable[[NDArray, NDArray], NDArray]
    ) -> Segments:
        """Movements where `moving` (n, T - 1); `speed` tells how fast a row is in a step."""
        n, steps = moving.shape[0], moving.shape[1] + 1
        padded = np.pad(moving, ((0, 0), (1, 1)))
        # padded[:, i] tells whether step i - 1 -> i moves: edges are first and last such steps.
        row, first = np.nonzero(padded[:, 1:] & ~padded[:, :-1])
        _, last = np.nonzero(padded[:, :-1] & ~padded[:, 1:])
        order = np.arange(len(row)) - np.searchsorted(row, row)
        most = int(order.max(initial=-1)) + 1
        start = np.full((n, most), float(steps))
        settle = np.full((n, most), float(steps))
        valid = np.zeros((n, most), dtype=bool)
        start[row, order] = first + _late(speed, row, steps - 1, first, first + 1)
        settle[row, order] = last - _late(speed, row, steps - 1, last - 1, last - 2)
        settle = np.maximum(settle, start)
        valid[row, order] = True
        stop = np.concatenate([start[:, 1:], np.full((n, 1), float(steps))], axis=1)[:, :most]
        return cls(start, np.minimum(settle, stop), stop, valid, steps)


def _late(
    speed: Callable[[NDArray, NDArray], NDArray],
    row: NDArray,
    steps: int,
    edge: NDArray,
    inner: NDArray,
) -> NDArray:
    """Fraction of the step `edge` that was still at rest, if `inner` is a full step (0 … 1)."""
    inside = (inner >= 0) & (inner < steps)
    full = speed(row, np.clip(inner, 0, steps - 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.where(inside & (full > 0), speed(row, edge) / full, 1.0)
    return 1.0 - np.clip(part, 0.0, 1.0)
