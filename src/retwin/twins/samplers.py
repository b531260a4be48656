"""Commands for any twin: ramps, random holds, multisines within limits; or what was recorded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from retwin.errors import InputError

__all__ = [
    "CommandSampler",
    "HoldSampler",
    "MultisineSampler",
    "RampSampler",
    "RecordedSampler",
    "draw_onsets",
    "ramps_and_holds",
]

BLOCK = 32
"""Trajectories that are made together: their samples stay in the processor's cache."""


class CommandSampler(Protocol):
    """Draws commands as an operator would give them."""

    @property
    def steps(self) -> int:
        """Samples per trajectory, T."""
        ...

    def sample(
        self, count: int, *, rng: np.random.Generator, timing: NDArray | None = None
    ) -> NDArray:
        """Commands (count, T, d_u).

        `timing` (k, M): onsets in samples seen in real trajectories, to draw from; NaN where a
        trajectory has fewer movements.
        """
        ...


@dataclass(frozen=True)
class RampSampler:
    """Commands that ramp to a random level, hold it, and ramp to the next; a command sampler.

    Parameters
    ----------
    low, high: the levels' limits, one per input channel, in its unit.
    movements: per trajectory, evenly spaced from sample 0 on.
    steps: samples per trajectory.
    ramps: lengths of a ramp in samples; each channel draws one for each movement.
    start: level before the first movement, per channel; empty takes the middle of the limits.

    Raises
    ------
    InputError: limits that are not finite or not in order, a start outside them, fewer than one
        movement or two samples, ramps that are not whole or that a movement has no time for.

    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    movements: int = 5
    steps: int = 1000
    ramps: tuple[int, ...] = (60, 80, 100)
    start: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        low, high = _checked_limits(self.low, self.high)
        rest = np.array(self.rest)
        if rest.shape != low.shape or not ((low <= rest) & (rest <= high)).all():
            raise InputError(
                "start",
                expected=f"one level within the limits per input channel, {len(low)}",
                got=str(self.start),
                remedy="leave start out to begin in the middle of the limits",
            )
        if self.movements < 1 or self.steps < 2:
            raise InputError(
                "movements",
                expected="at least one movement and two samples",
                got=f"{self.movements} movements in {self.steps} samples",
                remedy="give more",
            )
        longest = self.steps // self.movements
        if not self.ramps or not all(1 <= ramp <= longest for ramp in self.ramps):
            raise InputError(
                "ramps",
                expected=f"lengths from 1 to {longest} samples, the time of a movement",
                got=str(self.ramps),
                remedy="give shorter ramps, fewer movements or more samples",
            )

    @property
    def rest(self) -> tuple[float, ...]:
        """The level per channel before the first movement."""
        middle = (0.5 * (a + b) for a, b in zip(self.low, self.high, strict=True))
        return self.start or tuple(middle)

    def sample(
        self, count: int, *, rng: np.random.Generator, timing: NDArray | None = None
    ) -> NDArray:
        """Commands (count, steps, d_u), float32.

        `timing` (k, M): onsets in samples to draw from, a row per trajectory; where a row has no
        onset (NaN, or fewer than `movements`), the movement comes a period after the one before.
        """
        shape = (count, self.movements, len(self.low))
        levels = rng.uniform(self.low, self.high, size=shape)
        ramps = rng.choice(self.ramps, size=shape)
        period = self.steps / self.movements
        onsets = draw_onsets(count, self.movements, period, rng=rng, timing=timing)
        rest = np.broadcast_to(np.array(self.rest), (count, len(self.low)))
        commands = ramps_and_holds(rest, levels, ramps, onsets, self.steps)
        # Sums round; and movements that are timed more closely than their ramps overshoot.
        return np.clip(commands, self.low, self.high).astype(np.float32)


@dataclass(frozen=True)
class HoldSampler:
    """Random levels, each held for a random time, every channel for itself; a command sampler.

    The field's name is amplitude-modulated pseudo-random binary signal (APRBS): steps of all sizes
    and of many lengths, which excite what is slow and what is nonlinear.

    Parameters
    ----------
    low, high: the levels' limits, one per input channel, in its unit.
    steps: samples per trajectory.
    hold: least and greatest number of samples that a level is held for.

    Raises
    ------
    InputError: limits that are not finite or not in order, fewer than two samples, holds below one
        sample or out of order.

    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    steps: int = 1000
    hold: tuple[int, int] = (20, 200)

    def __post_init__(self) -> None:
        _checked_limits(self.low, self.high)
        _check_steps(self.steps)
        if not (len(self.hold) == 2 and 1 <= self.hold[0] <= self.hold[1]):
            raise InputError(
                "hold",
                expected="a pair (least, greatest) of samples, at least 1 and in order",
                got=str(self.hold),
                remedy="hold for longer than the slowest state takes, at times",
            )

    def sample(
        self, count: int, *, rng: np.random.Generator, timing: NDArray | None = None
    ) -> NDArray:
        """Commands (count, steps, d_u), float32; there are no movements, `timing` is not used."""
        least, greatest = self.hold
        shape = (count, len(self.low), 1 + self.steps // least)
        ends = rng.integers(least, greatest, size=shape, endpoint=True).cumsum(axis=2)
        levels = rng.uniform(self.low, self.high, size=(count, shape[2], len(self.low)))
        changes = np.zeros((count, self.steps, len(self.low)), dtype=int)
        row, channel, hold = np.nonzero(ends < self.steps)
        changes[row, ends[row, channel, hold], channel] = 1
        return np.take_along_axis(levels, changes.cumsum(axis=1), axis=1).astype(np.float32)


@dataclass(frozen=True)
class MultisineSampler:
    """Sines of random phases about a mean, every channel for itself; a command sampler.

    Parameters
    ----------
    low, high: limits of each input channel, in its unit; what goes beyond is cut off.
    steps: samples per trajectory.
    period: samples of one period of the slowest sine.
    mean, deviation: of each channel; by default the middle of its limits and a sixth of the way
        between them.
    slow, fast: number of sines at full strength, and of all; frequencies are evenly spaced.
    weak: amplitude of the faster ones against the slow ones'.

    Raises
    ------
    InputError: limits that are not finite or not in order, fewer than two samples, a mean outside
        the limits, a negative deviation, numbers of sines out of order.

    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    steps: int = 1000
    period: int = 1000
    mean: tuple[float, ...] = ()
    deviation: tuple[float, ...] = ()
    slow: int = 20
    fast: int = 60
    weak: float = 0.1

    def __post_init__(self) -> None:
        low, high = _checked_limits(self.low, self.high)
        _check_steps(self.steps)
        mean, deviation = self.mean or (low + high) / 2, self.deviation or (high - low) / 6
        fits = np.shape(mean) == np.shape(deviation) == low.shape
        if not (fits and ((low <= mean) & (mean <= high) & (np.array(deviation) >= 0)).all()):
            raise InputError(
                "mean",
                expected=f"{len(low)} means within the limits, and as many deviations from 0",
                got=f"mean {self.mean}, deviation {self.deviation}",
                remedy="leave them out for the middle of the limits and a sixth of their distance",
            )
        if not (self.period >= 2 and 1 <= self.slow <= self.fast and self.weak >= 0):
            raise InputError(
                "slow",
                expected="slow from 1, fast from slow on, weak from 0, a period from 2 samples on",
                got=f"slow {self.slow}, fast {self.fast}, weak {self.weak}, period {self.period}",
                remedy="leave them out for the default",
            )
        object.__setattr__(self, "mean", tuple(map(float, mean)))
        object.__setattr__(self, "deviation", tuple(map(float, deviation)))

    def sample(
        self, count: int, *, rng: np.random.Generator, timing: NDArray | None = None
    ) -> NDArray:
        """Commands (count, steps, d_u), float32; there are no movements, `timing` is not used."""
        number = np.arange(1, self.fast + 1)
        share = np.where(number <= self.slow, 1.0, self.weak)
        share = share * np.sqrt(2 / np.sum(share**2))
        phases = rng.uniform(0, 2 * np.pi, size=(count, self.fast, len(self.low)))
        turns = 2 * np.pi * number[:, None] * np.arange(self.steps) / self.period
        commands = np.empty((count, self.steps, len(self.low)), np.float32)
        for made, phase in zip(commands, phases, strict=True):  # one by one: waves take memory
            for channel, (mean, deviation) in enumerate(
                zip(self.mean, self.deviation, strict=True)
            ):
                waves = np.cos(turns + phase[:, channel, None])
                made[:, channel] = mean + deviation * (share @ waves)
        return commands.clip(*np.array([self.low, self.high], np.float32))


@dataclass(frozen=True, eq=False)
class RecordedSampler:
    """Recorded commands, or pieces of them, drawn with replacement; a command sampler.

    Parameters
    ----------
    commands: (k, T, d_u), recorded.
    length: samples of a piece, which begins anywhere; 0 takes whole records.

    Raises
    ------
    InputError: commands of another shape, none, or not finite; a length beyond the records'.

    """

    commands: NDArray
    length: int = 0

    def __post_init__(self) -> None:
        shape = np.shape(self.commands)
        if len(shape) != 3 or 0 in shape or not np.isfinite(self.commands).all():
            raise InputError(
                "commands",
                expected="finite numbers of shape (records, samples, channels), none of them 0",
                got=f"shape {shape}" if len(shape) != 3 or 0 in shape else "NaN or infinite ones",
                remedy="give Trajectories.commands of a set that has some",
            )
        if not 0 <= self.length <= shape[1]:
            raise InputError(
                "length",
                expected=f"from 1 to {shape[1]} samples, as the records have, or 0 for all",
                got=repr(self.length),
                remedy="give shorter pieces",
            )

    @property
    def steps(self) -> int:
        """Samples per trajectory."""
        return self.length or self.commands.shape[1]

    def sample(
        self, count: int, *, rng: np.random.Generator, timing: NDArray | None = None
    ) -> NDArray:
        """Commands (count, steps, d_u), float32; their timing is the records' own."""
        records, samples, _ = self.commands.shape
        row = rng.integers(records, size=(count, 1))
        begin = rng.integers(samples - self.steps, size=(count, 1), endpoint=True)
        return self.commands[row, begin + np.arange(self.steps)].astype(np.float32)


def ramps_and_holds(
    start: NDArray,
    levels: NDArray,
    spans: NDArray,
    onsets: NDArray,
    steps: int,
    *,
    dtype: type[np.floating] = np.float64,
) -> NDArray:
    """Commands (n, steps, d_u) that ramp linearly from level to level and hold.

    Parameters
    ----------
    start: (n, d_u) before the first movement.
    levels, spans: (n, M, d_u) level that each movement reaches, and length of its ramp in samples.
    onsets: (n, M) sample at which a movement starts, fractions allowed; NaN leaves it out.
    steps: samples per trajectory.
    dtype: of the commands; they are computed in double precision.

    """
    commands = np.empty((len(start), steps, start.shape[1]), dtype)
    for begin in range(0, len(start), BLOCK):
        part = slice(begin, begin + BLOCK)
        commands[part] = _ramped(start[part], levels[part], spans[part], onsets[part], steps)
    return commands


def _ramped(
    start: NDArray, levels: NDArray, spans: NDArray, onsets: NDArray, steps: int
) -> NDArray:
    """The same of a few trajectories; shares are only computed where one of them is on a ramp."""
    there = ~np.isnan(onsets)
    onsets = np.where(there, onsets, np.inf)
    ways = np.diff(levels, axis=1, prepend=start[:, None]) * there[..., None]
    first = onsets.min(axis=0)
    last = np.where(there[..., None], onsets[..., None] + spans, 0).max(axis=(0, 2)) + 1
    windows = np.clip([np.floor(first), np.ceil(last)], 0, steps).astype(int).T.tolist()
    commands = np.empty((len(start), steps, start.shape[1]))
    time, level, done = np.arange(steps), start[:, None], 0
    for movement, (begin, end) in enumerate(windows):
        end = max(end, done)
        commands[:, done:end] = level
        since = time[begin:end] - onsets[:, movement, None]
        share = np.clip(since[..., None] / spans[:, None, movement], 0.0, 1.0)
        commands[:, begin:end] += ways[:, None, movement] * share
        level, done = level + ways[:, None, movement], end
    commands[:, done:] = level
    return commands


def draw_onsets(
    count: int,
    movements: int,
    period: float,
    *,
    rng: np.random.Generator,
    timing: NDArray | None = None,
) -> NDArray:
    """Onsets (count, movements) in samples, one every `period` samples from sample 0 on.

    With `timing` (k, M), in samples, every row of onsets is one of its rows, drawn at random; where
    that has none (NaN, or fewer than `movements`), the movement comes a period after the one
    before.
    """
    if timing is None or len(timing) == 0:
        return np.tile(period * np.arange(movements, dtype=float), (count, 1))
    drawn = timing[rng.integers(len(timing), size=count), :movements]
    onsets = np.full((count, movements), np.nan)
    onsets[:, : drawn.shape[1]] = drawn
    for movement in range(movements):
        before = onsets[:, movement - 1] + period if movement else np.zeros(count)
        gap = np.isnan(onsets[:, movement])
        onsets[gap, movement] = before[gap]
    return onsets


def _checked_limits(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[NDArray, NDArray]:
    """Both as arrays (d_u,), finite and in order."""
    least, greatest = np.array(low, float), np.array(high, float)
    alike = least.ndim == 1 and least.shape == greatest.shape
    if not (
        alike and len(least) and np.isfinite([least, greatest]).all() and (least < greatest).all()
    ):
        raise InputError(
            "limits",
            expected="a finite low and a greater finite high per input channel",
            got=f"low {low}, high {high}",
            remedy="say between which levels commands may be drawn",
        )
    return least, greatest


def _check_steps(steps: int) -> None:
    if steps < 2:
        raise InputError(
            "steps", expected="at least two samples", got=repr(steps), remedy="give more"
        )
