"""Samplers of commands: ramps, random holds, multisines, and pieces of recorded commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require, whole
from retwin.times import sample_rate, to_samples
from retwin.twins.commands.ramps import draw_onsets, ramps_and_holds
from retwin.twins.time_step import Timed

RAMP_SHARES = (0.3, 0.4, 0.5)
"""Default durations of ramps, as shares of a segment: half of it and more is left to settle."""
HOLD_SHARES = (0.02, 0.2)
"""Shortest and longest default hold, as shares of a trajectory, which has ten levels or so."""


class CommandSampler(Protocol):
    """A distribution of commands such as an operator gives."""

    @property
    def rate(self) -> float:
        """Sample rate in Hz."""

    @property
    def steps(self) -> int:
        """Samples per trajectory, T."""

    def sample(
        self, count: int, *, rng: np.random.Generator, onsets: NDArray | None = None
    ) -> NDArray:
        """Draw commands.

        Parameters
        ----------
        count : int
            Trajectories to draw, n.
        rng : numpy.random.Generator
            Source of the draw.
        onsets : ndarray, shape (k, M), optional
            Onsets of k real trajectories in s, NaN where one has fewer segments; onsets of the
            commands are drawn from them. A sampler without segments ignores it.

        Returns
        -------
        ndarray, shape (n, T, d_u)
            Commands in the units of the input channels.

        """


@dataclass(frozen=True)
class BoundedSampler(Timed):
    """The base of samplers of levels between two limits of each input channel."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    rate: float
    duration: float

    def __post_init__(self) -> None:
        low, high = self._bounds
        paired = low.ndim == 1 and low.shape == high.shape and len(low) > 0
        fits = paired and np.isfinite([low, high]).all() and (low < high).all()
        expected = "a finite low and a greater finite high per input channel"
        got = f"low {self.low}, high {self.high}"
        remedy = "give the range from which levels are drawn"
        require(fits, "limits", expected=expected, got=got, remedy=remedy)
        self.check_steps()

    @property
    def _bounds(self) -> tuple[NDArray, NDArray]:
        """Both limits as arrays (d_u,)."""
        return np.array(self.low, float), np.array(self.high, float)


@dataclass(frozen=True)
class RampSampler(BoundedSampler):
    """Commands that ramp to a random level, hold it, and ramp to the next.

    Parameters
    ----------
    low, high : tuple of float
        Range of the levels of each input channel, in its unit.
    rate : float
        Sample rate in Hz.
    duration : float
        Duration of a trajectory in s, at least two samples.
    segments : int
        Segments per trajectory, at least 1; onsets are evenly spaced from 0 s on.
    ramp_durations : tuple of float, optional
        Possible durations of a ramp in s, from one sample to the spacing of the onsets; by default
        0.3, 0.4 and 0.5 of that spacing. Each channel draws one in each segment.
    start : tuple of float, optional
        Level of each channel before the first segment, within its range; by default the middle.

    Raises
    ------
    InputError
        Limits that are not finite or not in order, a start outside them, fewer than one segment
        or two samples, ramps that are longer than a segment.

    """

    segments: int
    ramp_durations: tuple[float, ...] = ()
    start: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        rest, (low, high) = np.array(self.rest), self._bounds
        fits = rest.shape == low.shape and bool(((low <= rest) & (rest <= high)).all())
        expected = f"one level within the limits per input channel, {len(low)}"
        remedy = "leave start out to begin in the middle of the limits"
        require(fits, "start", expected=expected, got=self.start, remedy=remedy)
        remedy = "give the number of levels that a trajectory goes to, a sample or more each"
        whole("segments", self.segments, at_least=1, at_most=self.steps, remedy=remedy)
        longest = self.steps // self.segments
        fits = bool(np.isfinite(self.ramp_durations).all())
        fits = fits and all(1 <= ramp <= longest for ramp in self._ramps)
        expected = f"from {1 / self.rate:g} s, a sample, to {longest / self.rate:g} s, a segment"
        remedy = "give shorter ramps in seconds, fewer segments or a longer duration"
        got = self.ramp_durations
        require(fits, "ramp_durations", expected=expected, got=got, remedy=remedy)

    @property
    def _ramps(self) -> list[int]:
        """Possible durations of a ramp in samples."""
        segment = self.duration / self.segments
        return _in_samples(self.ramp_durations, RAMP_SHARES, segment, self.rate)

    @property
    def rest(self) -> tuple[float, ...]:
        """Level of each channel before the first segment."""
        middle = (0.5 * (a + b) for a, b in zip(self.low, self.high, strict=True))
        return self.start or tuple(middle)

    def sample(
        self, count: int, *, rng: np.random.Generator, onsets: NDArray | None = None
    ) -> NDArray:
        """Draw commands (count, steps, d_u), float32; see `CommandSampler.sample`.

        Where a row of `onsets` has no onset, the segment begins one mean spacing after the
        segment before.
        """
        shape = (count, self.segments, len(self.low))
        levels = rng.uniform(self.low, self.high, size=shape)
        ramps = rng.choice(self._ramps, size=shape)
        period = self.steps / self.segments
        given = None if onsets is None else onsets * self.rate
        begins = draw_onsets(count, self.segments, period, rng=rng, given=given)
        rest = np.broadcast_to(np.array(self.rest), (count, len(self.low)))
        commands = ramps_and_holds(rest, levels, ramps, begins, self.steps)
        # Sums round, and segments that are shorter than their ramps overshoot.
        return np.clip(commands, self.low, self.high).astype(np.float32)


@dataclass(frozen=True)
class HoldSampler(BoundedSampler):
    """Random levels, each held for a random time, independently in every channel.

    This is an amplitude-modulated pseudo-random binary signal (APRBS): steps of all sizes and of
    many durations, which excite slow and nonlinear dynamics.

    Parameters
    ----------
    low, high : tuple of float
        Range of the levels of each input channel, in its unit.
    rate : float
        Sample rate in Hz.
    duration : float
        Duration of a trajectory in s, at least two samples.
    hold_durations : (float, float), optional
        Shortest and longest hold in s, at least one sample; by default 1/50 and 1/5 of the
        duration of a trajectory.

    Raises
    ------
    InputError
        Limits that are not finite or not in order, fewer than two samples, holds below one sample
        or out of order.

    """

    hold_durations: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        fits = np.isfinite(self.hold_durations).all() and len(self._hold) == 2
        fits = fits and 1 <= self._hold[0] <= self._hold[1]
        expected = "a pair (shortest, longest) in s, at least a sample and in order"
        remedy = "make the longest hold longer than the slowest state takes to settle"
        got = self.hold_durations
        require(fits, "hold_durations", expected=expected, got=got, remedy=remedy)

    @property
    def _hold(self) -> list[int]:
        """Shortest and longest hold in samples."""
        return _in_samples(self.hold_durations, HOLD_SHARES, self.duration, self.rate)

    def sample(
        self, count: int, *, rng: np.random.Generator, onsets: NDArray | None = None
    ) -> NDArray:
        """Draw commands, float32, without use of `onsets`; see `CommandSampler.sample`."""
        shortest, longest = self._hold
        shape = (count, len(self.low), 1 + self.steps // shortest)
        ends = rng.integers(shortest, longest, size=shape, endpoint=True).cumsum(axis=2)
        levels = rng.uniform(self.low, self.high, size=(count, shape[2], len(self.low)))
        changes = np.zeros((count, self.steps, len(self.low)), dtype=int)
        row, channel, hold = np.nonzero(ends < self.steps)
        changes[row, ends[row, channel, hold], channel] = 1
        return np.take_along_axis(levels, changes.cumsum(axis=1), axis=1).astype(np.float32)


@dataclass(frozen=True)
class MultisineSampler(BoundedSampler):
    """Multisines of random phases about a mean, independently in every channel.

    Parameters
    ----------
    low, high : tuple of float
        Range of each input channel, in its unit; the signal is clipped to it.
    rate : float
        Sample rate in Hz.
    duration : float
        Duration of a trajectory in s, at least two samples.
    band : (float, float)
        Lowest and highest frequency in Hz, at most half the rate. There is a sine at each multiple
        of the lowest, which the signal repeats with.
    corner : float, optional
        Highest frequency of full amplitude in Hz, within the band; by default the highest of all.
    weak : float, default 0.1
        Ratio of the amplitude of the sines above `corner` to the full amplitude, at least 0.
    mean : tuple of float, optional
        Mean of each channel; by default the middle of its range.
    deviation : tuple of float, optional
        Standard deviation of each channel, at least 0; by default a sixth of its range.

    Raises
    ------
    InputError
        Limits that are not finite or not in order, fewer than two samples, a mean outside the
        limits, a negative deviation, frequencies out of order or above half the rate.

    """

    band: tuple[float, float]
    corner: float | None = None
    weak: float = 0.1
    mean: tuple[float, ...] = ()
    deviation: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self._bounds
        mean, deviation = self.mean or (low + high) / 2, self.deviation or (high - low) / 6
        shaped = np.shape(mean) == np.shape(deviation) == low.shape
        within = shaped and (low <= mean) & (mean <= high) & (np.array(deviation) >= 0)
        fits = bool(np.all(within))
        expected = f"{len(low)} means within the limits, and as many deviations from 0"
        got = f"mean {self.mean}, deviation {self.deviation}"
        remedy = "leave them out for the middle of the limits and a sixth of their distance"
        require(fits, "mean", expected=expected, got=got, remedy=remedy)
        fits = len(self.band) == 2 and 0 < self.band[0] <= self.band[1] <= self.rate / 2
        expected = f"a pair (lowest, highest) in Hz, above 0, in order, to {self.rate / 2:g} Hz"
        remedy = "give the frequencies that real commands have"
        require(fits, "band", expected=expected, got=self.band, remedy=remedy)
        corner = self.band[1] if self.corner is None else self.corner
        fits = self.band[0] <= corner <= self.band[1] and self.weak >= 0
        expected = f"from {self.band[0]:g} to {self.band[1]:g} Hz, and weak from 0"
        got, remedy = f"corner {self.corner}, weak {self.weak}", "leave them out for the default"
        require(fits, "corner", expected=expected, got=got, remedy=remedy)
        object.__setattr__(self, "corner", corner)
        object.__setattr__(self, "mean", tuple(map(float, mean)))
        object.__setattr__(self, "deviation", tuple(map(float, deviation)))

    def sample(
        self, count: int, *, rng: np.random.Generator, onsets: NDArray | None = None
    ) -> NDArray:
        """Draw commands, float32, without use of `onsets`; see `CommandSampler.sample`."""
        assert self.corner is not None
        # Rounding must not lose a sine at the end of the band.
        sines, full = (int(each / self.band[0] + 1e-6) for each in (self.band[1], self.corner))
        number = np.arange(1, sines + 1)
        amplitude = np.where(number <= full, 1.0, self.weak)
        amplitude = amplitude * np.sqrt(2 / np.sum(amplitude**2))
        phases = rng.uniform(0, 2 * np.pi, size=(count, sines, len(self.low)))
        angle = 2 * np.pi * number[:, None] * np.arange(self.steps) / (self.rate / self.band[0])
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
class RecordedSampler(Timed):
    """Recorded commands, or pieces of them, drawn with replacement.

    Parameters
    ----------
    commands : ndarray, shape (k, T, d_u)
        Recorded commands, finite.
    rate : float
        Sample rate in Hz.
    duration : float, optional
        Duration of a piece in s, which begins at a random sample; by default whole records.

    Raises
    ------
    InputError
        Commands of another shape, none, or not finite; a duration beyond that of the records.

    """

    commands: NDArray
    rate: float
    duration: float = 0.0

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
        longest = shape[1] / sample_rate("rate", self.rate)
        object.__setattr__(self, "duration", float(self.duration or longest))
        self.check_steps()
        expected = f"at most {longest:g} s, the duration of the records"
        got = f"{self.duration:g} s"
        remedy = "give shorter pieces"
        require(self.steps <= shape[1], "duration", expected=expected, got=got, remedy=remedy)

    def sample(
        self, count: int, *, rng: np.random.Generator, onsets: NDArray | None = None
    ) -> NDArray:
        """Draw commands, float32, without use of `onsets`; see `CommandSampler.sample`."""
        records, samples, _ = self.commands.shape
        row = rng.integers(records, size=(count, 1))
        begin = rng.integers(samples - self.steps, size=(count, 1), endpoint=True)
        return self.commands[row, begin + np.arange(self.steps)].astype(np.float32)


def _in_samples(
    given: Sequence[float], shares: Sequence[float], total: float, rate: float
) -> list[int]:
    """Durations in samples: those given in s, or shares of a `total` that last one at least."""
    if given:
        return [to_samples(each, rate) for each in given]
    return [max(1, to_samples(share * total, rate)) for share in shares]
