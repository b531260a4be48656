"""Faults of actuators: their effect on the reference, and on the response.

A fault whose severity is open stands for a class of faults; `drawn` draws the severity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from retwin.checks import one_per, require
from retwin.data.segments import Segments
from retwin.errors import InputError

__all__ = [
    "ActuatorBias",
    "Fault",
    "Stuck",
    "draw_faults",
    "faulty_commands",
    "frozen_from",
    "frozen_response",
]


@runtime_checkable
class Fault(Protocol):
    """A fault that acts during one trajectory."""

    @property
    def label(self) -> str:
        """Class name of the fault."""
        ...

    def drawn(self, rng: np.random.Generator, *, steps: int, segments: int) -> Fault:
        """Draw every open severity.

        Parameters
        ----------
        rng : numpy.random.Generator
            Source of the severities.
        steps : int
            Samples of the trajectory.
        segments : int
            Segments of the trajectory.

        Returns
        -------
        Fault
            The same fault with fixed severities.

        """
        ...

    def command(self, commands: NDArray, segments: Segments) -> NDArray:
        """Reference that the actuators follow under the fault.

        Parameters
        ----------
        commands : ndarray, shape (T, d_u)
            Clean commands of one trajectory.
        segments : Segments
            Its segments.

        Returns
        -------
        ndarray, shape (T, d_u)
            Effective commands.

        """
        ...

    def response(self, response: NDArray) -> NDArray:
        """Response of the actuators under the fault.

        Parameters
        ----------
        response : ndarray, shape (T, d_u)
            Response to the effective commands, in command units.

        Returns
        -------
        ndarray, shape (T, d_u)
            The response with the fault.

        """
        ...


@dataclass(frozen=True)
class Stuck:
    """The actuator's response is held from an onset on.

    Parameters
    ----------
    actuator : int
        The actuator, counted from 0.
    onset : int or (int, int), default 49
        Sample, counted from 0, from which the response is held, at least 0. A pair (low, high) is
        the range of a uniform draw. The published protocol holds from sample 49 on.
    label : str
        Class name.

    Raises
    ------
    InputError
        An onset that is negative or not a whole number, or a pair out of order.

    """

    actuator: int
    onset: int | tuple[int, int] = 49
    label: str = "Stuck"

    def __post_init__(self) -> None:
        pair = isinstance(self.onset, Sequence)
        ends: Sequence = self.onset if isinstance(self.onset, Sequence) else (self.onset,) * 2
        whole = all(isinstance(end, int | np.integer) for end in ends)
        require(
            whole and len(ends) == 2 and 0 <= ends[0] <= ends[1],
            "onset",
            expected="a sample from 0 on, or a pair (low, high) of them, in order",
            got=repr(self.onset),
            remedy="count the samples from 0",
        )
        low, high = map(int, ends)
        object.__setattr__(self, "onset", (low, high) if pair else low)

    def drawn(self, rng: np.random.Generator, *, steps: int, segments: int) -> Stuck:
        """The same fault with its onset drawn; see `Fault.drawn`."""
        if isinstance(self.onset, int):
            return self
        low, high = (min(onset, steps - 1) for onset in self.onset)
        return replace(self, onset=int(rng.integers(low, high + 1)))

    def command(self, commands: NDArray, segments: Segments) -> NDArray:
        """The clean commands: the fault acts on the response. See `Fault.command`."""
        return commands

    def response(self, response: NDArray) -> NDArray:
        """The response, constant from the onset on; see `Fault.response`."""
        onset = self.onset
        if not isinstance(onset, int):
            raise _open(self)
        held = response.copy()
        held[onset:, self.actuator] = held[min(onset, len(held) - 1), self.actuator]
        return held


@dataclass(frozen=True)
class ActuatorBias:
    """A bias of the actuator's reference, one per segment: the paper's steady-state error (SSE).

    The bias builds up along the ramp of each segment: the reference goes from the old biased
    target to the new biased target, as in the published data. The actuator starts without bias.

    Parameters
    ----------
    actuator : int
        The actuator, counted from 0.
    size : (float, float), default (10.0, 50.0)
        Lowest and highest magnitude of a drawn bias, in command units, at least 0. The sign is
        positive or negative with equal probability.
    bias : tuple of float, optional
        One per segment, in command units; empty leaves the severity open.
    label : str
        Class name.

    Raises
    ------
    InputError
        Sizes that are negative, infinite or out of order.

    """

    actuator: int
    size: tuple[float, float] = (10.0, 50.0)
    bias: tuple[float, ...] = ()
    label: str = "Steady_state_error"

    def __post_init__(self) -> None:
        require(
            len(self.size) == 2 and 0 <= self.size[0] <= self.size[1] < np.inf,
            "size",
            expected="a pair (low, high) of magnitudes, at least 0 and in order",
            got=repr(self.size),
            remedy="leave the sign out, it is drawn",
        )

    def drawn(self, rng: np.random.Generator, *, steps: int, segments: int) -> ActuatorBias:
        """The same fault with one bias per segment drawn; see `Fault.drawn`."""
        if self.bias:
            return self
        count = max(segments, 1)
        drawn = rng.uniform(*self.size, size=count) * (2.0 * rng.integers(2, size=count) - 1.0)
        return replace(self, bias=tuple(drawn.tolist()))

    def command(self, commands: NDArray, segments: Segments) -> NDArray:
        """The commands with the biased reference of one actuator; see `Fault.command`."""
        if not self.bias:
            raise _open(self)
        valid = segments.valid[0]
        if not valid.any():
            bias: NDArray | float = self.bias[0]
        else:
            levels = np.resize(self.bias, valid.sum())
            clean = commands[:, self.actuator]
            bias = _along(clean, segments.start[0][valid], segments.settle[0][valid], levels)
        biased = commands.copy()
        biased[:, self.actuator] += bias
        return biased

    def response(self, response: NDArray) -> NDArray:
        """The response unchanged: it follows the biased reference. See `Fault.response`."""
        return response


def _along(clean: NDArray, start: NDArray, settle: NDArray, levels: NDArray) -> NDArray:
    """The bias (T,): it goes from level to level as the command (T,) goes to its target."""
    clean = clean.astype(np.float64)
    bias = np.zeros(len(clean))
    before = 0.0
    segments = (start, settle, _interpolated(clean, start), _interpolated(clean, settle), levels)
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


def _interpolated(values: NDArray, times: NDArray) -> NDArray:
    """Values (T,) at times in samples, linear between samples."""
    left = np.minimum(times.astype(int), len(values) - 2)
    fraction = np.minimum(times - left, 1.0)
    return values[left] + fraction * (values[left + 1] - values[left])


def _open(fault: Fault) -> InputError:
    """The error for a fault that must have a fixed severity and has none."""
    return InputError(
        "faults",
        expected="a severity that is fixed",
        got=repr(fault),
        remedy="call draw_faults first, or give the severity",
    )


def draw_faults(
    faults: Sequence[Fault | None], segments: Segments, seed: int
) -> list[Fault | None]:
    """Draw the severity of every fault.

    Parameters
    ----------
    faults : sequence of Fault or None
        One per trajectory, None for a healthy one.
    segments : Segments
        Segments of the n trajectories.
    seed : int
        The same seed gives the same severities with every twin, so that twins can be compared.

    Returns
    -------
    list of Fault or None
        The faults with fixed severities.

    Raises
    ------
    InputError
        Not one fault per trajectory.

    """
    remedy = "give None for a healthy trajectory"
    one_per("faults", faults, len(segments), "trajectory", remedy=remedy)
    rng = np.random.default_rng(seed)
    counts = segments.valid.sum(axis=1)
    return [
        None if fault is None else fault.drawn(rng, steps=segments.steps, segments=int(count))
        for fault, count in zip(faults, counts, strict=True)
    ]


def faulty_commands(
    commands: NDArray, faults: Sequence[Fault | None], segments: Segments
) -> NDArray:
    """Commands with the effect of every fault on the reference.

    Parameters
    ----------
    commands : ndarray, shape (n, T, d_u)
        Clean commands.
    faults : sequence of Fault or None
        One per trajectory, with fixed severities.
    segments : Segments
        Segments of the commands.

    Returns
    -------
    ndarray, shape (n, T, d_u)
        Effective commands.

    """
    out = commands.copy()
    for i, fault in enumerate(faults):
        if fault is not None:
            out[i] = fault.command(commands[i], segments[i : i + 1])
    return out


def frozen_response(response: NDArray, faults: Sequence[Fault | None]) -> NDArray:
    """Response of the actuators with the effect of every fault on it.

    A twin whose actuators cannot be accessed applies this to its commands, which are then held.

    Parameters
    ----------
    response : ndarray, shape (n, T, d_u)
        Response without faults, in command units.
    faults : sequence of Fault or None
        One per trajectory, with fixed severities.

    Returns
    -------
    ndarray, shape (n, T, d_u)
        The response with faults.

    """
    out = response.copy()
    for i, fault in enumerate(faults):
        if fault is not None:
            out[i] = fault.response(response[i])
    return out


def frozen_from(faults: Sequence[Fault | None], steps: int, actuators: int) -> NDArray:
    """Sample from which every actuator is held.

    For twins that integrate their dynamics and must hold an actuator meanwhile. The sample is
    found from the effect of the fault on a response that rises by one per sample.

    Parameters
    ----------
    faults : sequence of Fault or None
        One per trajectory, with fixed severities.
    steps : int
        Samples per trajectory, T.
    actuators : int
        The number of actuators, d_u.

    Returns
    -------
    ndarray of int, shape (n, d_u)
        Samples counted from 0; `steps` where an actuator is never held.

    Raises
    ------
    InputError
        A fault that neither holds the response nor leaves it unchanged.

    """
    rising = np.tile(np.arange(steps, dtype=float)[:, None], (1, actuators))
    onsets = np.full((len(faults), actuators), steps)
    for i, fault in enumerate(faults):
        if fault is None:
            continue
        response = fault.response(rising)
        if response is rising:
            continue
        onset = response[-1].astype(int)
        require(
            np.array_equal(response, np.minimum(rising, onset)),
            "faults",
            expected="faults that hold an actuator's response or leave it as it is",
            got=fault,
            remedy="use a twin that computes its actuators' response, or faults of the command",
        )
        onsets[i] = np.where(onset < steps - 1, onset, steps)
    return onsets
