"""Faults of actuators: their effect on the reference, and on the response.

A fault whose severity is open stands for a class of faults; `drawn` draws the severity. A fault
holds times in seconds, and gets the sample rate of the arrays that it changes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from numbers import Real
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.segments import Segments
from retwin.errors import InputError
from retwin.times import to_samples


@runtime_checkable
class Fault(Protocol):
    """A fault that acts during one trajectory."""

    @property
    def label(self) -> str:
        """Class name of the fault."""

    def drawn(self, rng: np.random.Generator, *, steps: int, segments: int, rate: float) -> Fault:
        """Draw every open severity.

        Parameters
        ----------
        rng : numpy.random.Generator
            Source of the severities.
        steps : int
            Samples of the trajectory.
        segments : int
            Segments of the trajectory.
        rate : float
            Sample rate in Hz.

        Returns
        -------
        Fault
            The same fault with fixed severities.

        """

    def command(self, commands: NDArray, segments: Segments, rate: float) -> NDArray:
        """Reference that the actuators follow under the fault.

        Parameters
        ----------
        commands : ndarray, shape (T, d_u)
            Clean commands of one trajectory.
        segments : Segments
            Its segments.
        rate : float
            Sample rate in Hz.

        Returns
        -------
        ndarray, shape (T, d_u)
            Effective commands; by default the clean ones.

        """
        return commands

    def response(self, response: NDArray, rate: float) -> NDArray:
        """Response of the actuators under the fault.

        Parameters
        ----------
        response : ndarray, shape (T, d_u)
            Response to the effective commands, in command units.
        rate : float
            Sample rate in Hz.

        Returns
        -------
        ndarray, shape (T, d_u)
            The response with the fault; by default the same.

        """
        return response


Faults = Sequence[Fault | None]
"""One per trajectory, None for a healthy one."""


def ends_of(value: Any) -> tuple[float, float]:
    """Ends of what is a number or a pair (low, high) of them; NaN for anything else."""
    ends = value if isinstance(value, Sequence) else (value,) * 2
    numbers = len(ends) == 2 and all(isinstance(end, Real) for end in ends)
    return (float(ends[0]), float(ends[1])) if numbers else (math.nan, math.nan)


def checked_onset(onset: float | tuple[float, float]) -> tuple[float, float]:
    """Earliest and latest onset in s; InputError for anything but times from 0 on, in order."""
    low, high = ends_of(onset)
    expected = "a time in s from 0 on, or a pair (low, high) of them, in order"
    remedy = "count the seconds from the first sample"
    require(0 <= low <= high < math.inf, "onset", expected=expected, got=repr(onset), remedy=remedy)
    return low, high


def onset_samples(onset: float | tuple[float, float], steps: int, rate: float) -> tuple[int, int]:
    """First and last sample of an onset, in a trajectory of so many samples.

    Raises InputError if the earliest onset is after the end.
    """
    low, high = (to_samples(each, rate) for each in ends_of(onset))
    expected = f"a time in s within the trajectory, which lasts {steps / rate:g} s"
    remedy = "give an earlier one, in seconds and not in samples"
    require(low < steps, "onset", expected=expected, got=f"{ends_of(onset)[0]:g} s", remedy=remedy)
    return low, min(high, steps - 1)


_onset_samples = lru_cache(maxsize=1024)(onset_samples)


@dataclass(frozen=True)
class Stuck(Fault):
    """The actuator's response is held from an onset on.

    Parameters
    ----------
    actuator : int
        The actuator, counted from 0.
    onset : float or (float, float), default 0.49
        Time in s from which the response is held, at least 0. A pair (low, high) is the range of a
        uniform draw of whole samples. The published protocol holds from 0.49 s on.
    label : str
        Class name.

    Raises
    ------
    InputError
        An onset that is negative, infinite or no number, or a pair out of order. When drawn: an
        onset after the end of the trajectory.

    """

    actuator: int
    onset: float | tuple[float, float] = 0.49
    label: str = "Stuck"

    def __post_init__(self) -> None:
        low, high = checked_onset(self.onset)
        onset = (low, high) if isinstance(self.onset, Sequence) else low
        object.__setattr__(self, "onset", onset)

    def onset_range(self, steps: int, rate: float) -> tuple[int, int]:
        """First and last sample at which it can begin in a trajectory of so many samples.

        Raises InputError if the earliest onset is after the end.
        """
        return _onset_samples(self.onset, steps, rate)

    def drawn(self, rng: np.random.Generator, *, steps: int, segments: int, rate: float) -> Stuck:
        """The same fault with its onset drawn; see `Fault.drawn`."""
        low, high = self.onset_range(steps, rate)
        if not isinstance(self.onset, tuple):
            return self
        return replace(self, onset=int(rng.integers(low, high + 1)) / rate)

    def response(self, response: NDArray, rate: float) -> NDArray:
        """The response, constant from the onset on; see `Fault.response`."""
        if isinstance(self.onset, tuple):
            raise _open(self)
        onset = to_samples(self.onset, rate)
        held = response.copy()
        held[onset:, self.actuator] = held[min(onset, len(held) - 1), self.actuator]
        return held


@dataclass(frozen=True)
class ActuatorBias(Fault):
    """A bias of the actuator's reference, one per segment: the paper's steady-state error (SSE).

    The bias builds up along the ramp of each segment: the reference goes from the old biased
    target to the new biased target, as in the published data. The actuator starts without bias.

    Parameters
    ----------
    actuator : int
        The actuator, counted from 0.
    size : (float, float)
        Lowest and highest magnitude of a drawn bias, in command units, at least 0. The sign is
        positive or negative with equal probability. It may be left out where `bias` is given.
    bias : tuple of float, optional
        One per segment, in command units; empty leaves the severity open.
    label : str
        Class name.

    Raises
    ------
    InputError
        Neither sizes nor biases, or sizes that are negative, infinite or out of order.

    """

    actuator: int
    size: tuple[float, float] | tuple[()] = ()
    bias: tuple[float, ...] = ()
    label: str = "Steady_state_error"

    def __post_init__(self) -> None:
        drawn = len(self.size) == 2 and 0 <= self.size[0] <= self.size[1] < np.inf
        require(
            drawn or (self.bias and not self.size),
            "size",
            expected="a pair (low, high) of magnitudes in command units, at least 0 and in order",
            got=repr(self.size) if self.size else "none",
            remedy="give the sizes of real errors; the sign is drawn",
        )

    def drawn(
        self, rng: np.random.Generator, *, steps: int, segments: int, rate: float
    ) -> ActuatorBias:
        """The same fault with one bias per segment drawn; see `Fault.drawn`."""
        if self.bias:
            return self
        assert self.size, "checked, since no bias is given"
        count = max(segments, 1)
        drawn = rng.uniform(*self.size, size=count) * (2.0 * rng.integers(2, size=count) - 1.0)
        return replace(self, bias=tuple(drawn.tolist()))

    def levels(self, count: int) -> tuple[float, ...]:
        """The bias of each of so many segments; those given repeat. Raises where it is open."""
        if not self.bias:
            raise _open(self)
        return (self.bias * -(-count // len(self.bias)))[:count]

    def command(self, commands: NDArray, segments: Segments, rate: float) -> NDArray:
        """The commands with the biased reference of one actuator; see `Fault.command`."""
        if not self.bias:
            raise _open(self)
        valid = segments.valid[0]
        if not valid.any():
            bias: NDArray | float = self.bias[0]
        else:
            levels = np.array(self.levels(int(valid.sum())))
            clean = commands[:, self.actuator]
            bias = _along(clean, segments.start[0][valid], segments.settle[0][valid], levels)
        biased = commands.copy()
        biased[:, self.actuator] += bias
        return biased


def _along(clean: NDArray, start: NDArray, settle: NDArray, levels: NDArray) -> NDArray:
    """The bias (T,): it goes from level to level as the command (T,) goes to its target."""
    clean = clean.astype(np.float64)
    bias = np.zeros(len(clean))
    before = 0.0
    ends = (np.interp(each, np.arange(len(clean)), clean) for each in (start, settle))
    segments = (start, settle, *ends, levels)
    # Python numbers: for single values they are faster than numpy's.
    for begin, end, first, last, level in zip(*(each.tolist() for each in segments), strict=True):
        if first != last:
            moving = slice(math.ceil(begin), math.ceil(end))
            fraction = (clean[moving] - first) / (last - first)
        else:
            length = max(end - begin, 1.0)
            moving = slice(math.ceil(begin), math.ceil(begin + length))
            fraction = (np.arange(len(bias), dtype=float)[moving] - begin) / length
        bias[moving] = before + (level - before) * np.minimum(np.maximum(fraction, 0.0), 1.0)
        bias[moving.stop :] = before + (level - before)
        before = level
    return bias


def _open(fault: Fault) -> InputError:
    """The error for a fault that must have a fixed severity and has none."""
    return InputError(
        "faults",
        expected="a severity that is fixed",
        got=repr(fault),
        remedy="call draw_faults first, or give the severity",
    )
