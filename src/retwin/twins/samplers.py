"""Samplers of commands: ramps, random holds, multisines, and pieces of recorded commands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.twins.ramps import draw_onsets, ramps_and_holds

__all__ = [
    "CommandSampler",
    "HoldSampler",
    "MultisineSampler",
    "RampSampler",
    "RecordedSampler",
]


class CommandSampler(Protocol):
    """A distribution of commands such as an operator gives."""

    @property
    def steps(self) -> int:
        """Samples per trajectory, T."""
        ...

    def sample(
        self, count: int, *, rng: np.random.Generator, timing: NDArray | None = None
    ) -> NDArray:
        """Draw commands.

        Parameters
        ----------
        count : int
            Trajectories to draw, n.
        rng : numpy.random.Generator
            Source of the draw.
        timing : ndarray, shape (k, M), optional
            Onsets of k real trajectories in samples, NaN where one has fewer segments; onsets of
            the commands are drawn from them. A sampler without segments ignores it.

        Returns
        -------
        ndarray, shape (n, T, d_u)
            Commands in the units of the input channels.

        """
        ...


@dataclass(frozen=True)
class RampSampler:
    """Commands that ramp to a random level, hold it, and ramp to the next.

    Parameters
    ----------
    low, high : tuple of float
        Range of the levels of each input channel, in its unit.
    segments : int, default 5
        Segments per trajectory, at least 1; onsets are evenly spaced from sample 0 on.
    steps : int, default 1000
        Samples per trajectory, at least 2.
    ramps : tuple of int
        Possible durations of a ramp in samples, from 1 to the spacing of the onsets. Each channel
        draws one in each segment.
    start : tuple of float, optional
        Level of each channel before the first segment, within its range; by default the middle.

    Raises
    ------
    InputError
        Limits that are not finite or not in order, a start outside them, fewer than one segment
        or two samples, ramps that are longer than a segment.

    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    segments: int = 5
    steps: int = 1000
    ramps: tuple[int, ...] = (60, 80, 100)
    start: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        low, high = _checked_limits(self.low, self.high)
        rest = np.array(self.rest)
        require(
            rest.shape == low.shape and bool(((low <= rest) & (rest <= high)).all()),
            "start",
            expected=f"one level within the limits per input channel, {len(low)}",
            got=self.start,
            remedy="leave start out to begin in the middle of the limits",
        )
        require(
            self.segments >= 1 and self.steps >= 2,
            "segments",
            expected="at least one segment and two samples",
            got=f"{self.segments} segments in {self.steps} samples",
            remedy="give more",
        )
        longest = self.steps // self.segments
        require(
            self.ramps and all(1 <= ramp <= longest for ramp in self.ramps),
            "ramps",
            expected=f"durations from 1 to {longest} samples, the duration of a segment",
            got=self.ramps,
            remedy="give shorter ramps, fewer segments or more samples",
        )

    @property
    def rest(self) -> tuple[float, ...]:
        """Level of each channel before the first segment."""
        middle = (0.5 * (a + b) for a, b in zip(self.low, self.high, strict=True))
        return self.start or tuple(middle)

    def sample(
        self, count: int, *, rng: np.random.Generator, timing: NDArray | None = None
    ) -> NDArray:
        """Draw commands (count, steps, d_u), float32; see `CommandSampler.sample`.

        Where a row of `timing` has no onset, the segment begins one mean spacing after the
        segment before.
        """
        shape = (count, self.segments, len(self.low))
        levels = rng.uniform(self.low, self.high, size=shape)
        ramps = rng.choice(self.ramps, size=shape)
        period = self.steps / self.segments
        onsets = draw_onsets(count, self.segments, period, rng=rng, timing=timing)
        rest = np.broadcast_to(np.array(self.rest), (count, len(self.low)))
        commands = ramps_and_holds(rest, levels, ramps, onsets, self.steps)
        # Sums round, and segments that are shorter than their ramps overshoot.
        return np.clip(commands, self.low, self.high).astype(np.float32)


@dataclass(frozen=True)
class HoldSampler:
    """Random levels, each held for a random time, independently in every channel.

    This is an amplitude-modulated pseudo-random binary signal (APRBS): steps of all sizes and of
    many durations, which excite slow and nonlinear dynamics.

    Parameters
    ----------
    low, high : tuple of float
        Range of the levels of each input channel, in its unit.
    steps : int, default 1000
        Samples per trajectory, at least 2.
    hold : (int, int), default (20, 200)
        Shortest and longest hold in samples, at least 1.

    Raises
    ------
    InputError
        Limits that are not finite or not in order, fewer than two samples, holds below one sample
        or out of order.

    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    steps: int = 1000
    hold: tuple[int, int] = (20, 200)

    def __post_init__(self) -> None:
        _checked_limits(self.low, self.high)
        _check_steps(self.steps)
        require(
            len(self.hold) == 2 and 1 <= self.hold[0] <= self.hold[1],
            "hold",
            expected="a pair (shortest, longest) of samples, at least 1 and in order",
            got=self.hold,
            remedy="make the longest hold longer than the slowest state takes to settle",
        )

    def sample(
        self, count: int, *, rng: np.random.Generator, timing: NDArray | None = None
    ) -> NDArray:
        """Draw commands, float32, without use of `timing`; see `CommandSampler.sample`."""
        shortest, longest = self.hold
        shape = (count, len(self.low), 1 + self.steps // shortest)
        ends = rng.integers(shortest, longest, size=shape, endpoint=True).cumsum(axis=2)
        levels = rng.uniform(self.low, self.high, size=(count, shape[2], len(self.low)))
        changes = np.zeros((count, self.steps, len(self.low)), dtype=int)
        row, channel, hold = np.nonzero(ends < self.steps)
        changes[row, ends[row, channel, hold], channel] = 1
        return np.take_along_axis(levels, changes.cumsum(axis=1), axis=1).astype(np.float32)


@dataclass(frozen=True)
class MultisineSampler:
    """Multisines of random phases about a mean, independently in every channel.

    Parameters
    ----------
    low, high : tuple of float
        Range of each input channel, in its unit; the signal is clipped to it.
    steps : int, default 1000
        Samples per trajectory, at least 2.
    period : int, default 1000
        Period of the slowest sine in samples, at least 2.
    mean : tuple of float, optional
        Mean of each channel; by default the middle of its range.
    deviation : tuple of float, optional
        Standard deviation of each channel, at least 0; by default a sixth of its range.
    slow : int, default 20
        Number of sines of full amplitude, at least 1; they are the slowest.
    fast : int, default 60
        Number of all sines, at least `slow`; their frequencies are evenly spaced.
    weak : float, default 0.1
        Ratio of the amplitude of the other sines to the full amplitude, at least 0.

    Raises
    ------
    InputError
        Limits that are not finite or not in order, fewer than two samples, a mean outside the
        limits, a negative deviation, numbers of sines out of order.

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
        require(
            fits and ((low <= mean) & (mean <= high) & (np.array(deviation) >= 0)).all(),
            "mean",
            expected=f"{len(low)} means within the limits, and as many deviations from 0",
            got=f"mean {self.mean}, deviation {self.deviation}",
            remedy="leave them out for the middle of the limits and a sixth of their distance",
        )
        require(
            self.period >= 2 and 1 <= self.slow <= self.fast and self.weak >= 0,
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
        """Draw commands, float32, without use of `timing`; see `CommandSampler.sample`."""
        number = np.arange(1, self.fast + 1)
        amplitude = np.where(number <= self.slow, 1.0, self.weak)
        amplitude = amplitude * np.sqrt(2 / np.sum(amplitude**2))
        phases = rng.uniform(0, 2 * np.pi, size=(count, self.fast, len(self.low)))
        angle = 2 * np.pi * number[:, None] * np.arange(self.steps) / self.period
        commands = np.empty((count, self.steps, len(self.low)), np.float32)
        # One trajectory at a time: all sines of all trajectories would take much memory.
        for trajectory, phase in zip(commands, phases, strict=True):
            for channel, (mean, deviation) in enumerate(
                zip(self.mean, self.deviation, strict=True)
            ):
                sines = np.cos(angle + phase[:, channel, None])
                trajectory[:, channel] = mean + deviation * (amplitude @ sines)
        return commands.clip(*np.array([self.low, self.high], np.float32))


@dataclass(frozen=True, eq=False)
class RecordedSampler:
    """Recorded commands, or pieces of them, drawn with replacement.

    Parameters
    ----------
    commands : ndarray, shape (k, T, d_u)
        Recorded commands, finite.
    length : int, default 0
        Samples of a piece, which begins at a random sample, at most T; 0 takes whole records.

    Raises
    ------
    InputError
        Commands of another shape, none, or not finite; a length beyond that of the records.

    """

    commands: NDArray
    length: int = 0

    def __post_init__(self) -> None:
        shape = np.shape(self.commands)
        shaped = len(shape) == 3 and 0 not in shape
        require(
            shaped and np.isfinite(self.commands).all(),
            "commands",
            expected="finite numbers of shape (records, samples, channels), none of them 0",
            got="NaN or infinite ones" if shaped else f"shape {shape}",
            remedy="give Trajectories.commands of a set that has some",
        )
        require(
            0 <= self.length <= shape[1],
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
        """Draw commands, float32, without use of `timing`; see `CommandSampler.sample`."""
        records, samples, _ = self.commands.shape
        row = rng.integers(records, size=(count, 1))
        begin = rng.integers(samples - self.steps, size=(count, 1), endpoint=True)
        return self.commands[row, begin + np.arange(self.steps)].astype(np.float32)


def _checked_limits(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[NDArray, NDArray]:
    """Both as arrays (d_u,), finite and in order."""
    lower, upper = np.array(low, float), np.array(high, float)
    paired = lower.ndim == 1 and lower.shape == upper.shape and len(lower) > 0
    require(
        paired and np.isfinite([lower, upper]).all() and (lower < upper).all(),
        "limits",
        expected="a finite low and a greater finite high per input channel",
        got=f"low {low}, high {high}",
        remedy="give the range from which levels are drawn",
    )
    return lower, upper


def _check_steps(steps: int) -> None:
    """Refuse fewer than two samples."""
    require(
        steps >= 2, "steps", expected="at least two samples", got=repr(steps), remedy="give more"
    )
