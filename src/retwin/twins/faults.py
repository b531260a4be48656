"""Faults: each turns commands, or the actuators' response, into what a faulty actuator does.

A fault with an open severity is a class of faults; `drawn` fixes the severity from a seed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

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
    """What goes wrong in one trajectory."""

    @property
    def label(self) -> str:
        """The class name of this fault."""
        ...

    def drawn(self, rng: np.random.Generator, *, steps: int, movements: int) -> Fault:
        """The same fault with every open severity fixed."""
        ...

    def command(self, commands: NDArray, segments: Segments) -> NDArray:
        """What the actuators are effectively told: (T, d_u) in and out; `segments` of one."""
        ...

    def response(self, response: NDArray) -> NDArray:
        """What the actuators effectively do: (T, d_u) in and out."""
        ...


@dataclass(frozen=True)
class Stuck:
    """The actuator's response is held from sample `onset` on.

    Parameters
    ----------
    actuator: which, counted from 0.
    onset: 0-based sample from which the response stays as it is; a pair (low, high) is drawn
        uniformly. The published protocol freezes at sample 49.
    label: class name.

    Raises
    ------
    InputError: an onset below 0 or no whole number, a pair out of order.

    """

    actuator: int
    onset: int | tuple[int, int] = 49
    label: str = "Stuck"

    def __post_init__(self) -> None:
        pair = isinstance(self.onset, Sequence)
        ends: Sequence = self.onset if isinstance(self.onset, Sequence) else (self.onset,) * 2
        whole = all(isinstance(end, int | np.integer) for end in ends)
        if not (whole and len(ends) == 2 and 0 <= ends[0] <= ends[1]):
            raise InputError(
                "onset",
                expected="a sample from 0 on, or a pair (low, high) of them, in order",
                got=repr(self.onset),
                remedy="count the samples from 0",
            )
        low, high = map(int, ends)
        object.__setattr__(self, "onset", (low, high) if pair else low)

    def drawn(self, rng: np.random.Generator, *, steps: int, movements: int) -> Stuck:
        """The same fault with its onset fixed."""
        if isinstance(self.onset, int):
            return self
        low, high = (min(onset, steps - 1) for onset in self.onset)
        return replace(self, onset=int(rng.integers(low, high + 1)))

    def command(self, commands: NDArray, segments: Segments) -> NDArray:
        """Commands are not touched: the actuator does not follow them."""
        return commands

    def response(self, response: NDArray) -> NDArray:
        """The response with the actuator held from the onset on."""
        onset = self.onset
        if not isinstance(onset, int):
            raise _open(self)
        held = response.copy()
        held[onset:, self.actuator] = held[min(onset, len(held) - 1), self.actuator]
        return held


@dataclass(frozen=True)
class ActuatorBias:
    """A bias on the actuator's reference, one per movement.

    The bias is reached along the movement's ramp: the reference goes from the biased old target to
    the biased new one, as in the published data. The actuator starts at rest, without bias.

    Parameters
    ----------
    actuator: which, counted from 0.
    size: least and greatest size of a drawn bias, in units of the command; its sign is random.
    bias: one per movement; empty leaves it open.
    label: class name.

    Raises
    ------
    InputError: sizes that are negative, infinite or out of order.

    """

    actuator: int
    size: tuple[float, float] = (10.0, 50.0)
    bias: tuple[float, ...] = ()
    label: str = "Steady_state_error"

    def __post_init__(self) -> None:
        if not (len(self.size) == 2 and 0 <= self.size[0] <= self.size[1] < np.inf):
            raise InputError(
                "size",
                expected="a pair (least, greatest) of sizes, at least 0 and in order",
                got=repr(self.size),
                remedy="leave the sign out, it is drawn",
            )

    def drawn(self, rng: np.random.Generator, *, steps: int, movements: int) -> ActuatorBias:
        """The same fault with one bias per movement."""
        if self.bias:
            return self
        count = max(movements, 1)
        drawn = rng.uniform(*self.size, size=count) * (2.0 * rng.integers(2, size=count) - 1.0)
        return replace(self, bias=tuple(drawn.tolist()))

    def command(self, commands: NDArray, segments: Segments) -> NDArray:
        """The commands with the biased reference of one actuator."""
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
        """The actuator follows its (biased) reference."""
        return response


def _along(clean: NDArray, start: NDArray, settle: NDArray, levels: NDArray) -> NDArray:
    """The bias over time: it moves from level to level as the command moves to its target."""
    clean = clean.astype(np.float64)
    bias = np.zeros(len(clean))
    before = 0.0
    movements = (start, settle, _between(clean, start), _between(clean, settle), levels)
    # Plain numbers: numpy's own cost more than what is done with them.
    for begin, end, first, last, level in zip(*(each.tolist() for each in movements), strict=True):
        if first != last:
            moves = slice(math.ceil(begin), math.ceil(end))
            share = (clean[moves] - first) / (last - first)
        else:
            length = max(end - begin, 1.0)
            moves = slice(math.ceil(begin), math.ceil(begin + length))
            share = (np.arange(len(bias), dtype=float)[moves] - begin) / length
        bias[moves] = before + (level - before) * np.minimum(np.maximum(share, 0.0), 1.0)
        bias[moves.stop :] = before + (level - before)
        before = level
    return bias


def _between(values: NDArray, when: NDArray) -> NDArray:
    """Values (T,) at times in samples, fractions allowed."""
    left = np.minimum(when.astype(int), len(values) - 2)
    share = np.minimum(when - left, 1.0)
    return values[left] + share * (values[left + 1] - values[left])


def _open(fault: Fault) -> InputError:
    return InputError(
        "faults",
        expected="a severity that is fixed",
        got=repr(fault),
        remedy="call draw_faults first, or give the severity",
    )


def draw_faults(
    faults: Sequence[Fault | None], segments: Segments, seed: int
) -> list[Fault | None]:
    """Fix the severity of every fault, one per trajectory (None: healthy).

    The same seed gives the same severities whatever the twin, so twins can be compared on them.
    """
    if len(faults) != len(segments):
        raise InputError(
            "faults",
            expected=f"one per trajectory, {len(segments)}",
            got=f"{len(faults)}",
            remedy="give None for a healthy trajectory",
        )
    rng = np.random.default_rng(seed)
    counts = segments.valid.sum(axis=1)
    return [
        None if fault is None else fault.drawn(rng, steps=segments.steps, movements=int(count))
        for fault, count in zip(faults, counts, strict=True)
    ]


def faulty_commands(
    commands: NDArray, faults: Sequence[Fault | None], segments: Segments
) -> NDArray:
    """Commands (n, T, d_u) with every fault's effect on the reference."""
    out = commands.copy()
    for i, fault in enumerate(faults):
        if fault is not None:
            out[i] = fault.command(commands[i], segments[i : i + 1])
    return out


def frozen_response(response: NDArray, faults: Sequence[Fault | None]) -> NDArray:
    """Response (n, T, d_u) of the actuators with every fault's effect on it.

    A twin whose actuators are not visible applies this to its commands: the command is then held.
    """
    out = response.copy()
    for i, fault in enumerate(faults):
        if fault is not None:
            out[i] = fault.response(response[i])
    return out


def frozen_from(faults: Sequence[Fault | None], steps: int, actuators: int) -> NDArray:
    """The sample (n, d_u) from which every actuator is held; `steps` where it never is.

    For twins that integrate their dynamics and must hold an actuator while they do. Asked of the
    faults themselves: what they do to a response that rises by one per sample.

    Raises InputError for a fault that does something else to the response than hold it.
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
        if not np.array_equal(response, np.minimum(rising, onset)):
            raise InputError(
                "faults",
                expected="faults that hold an actuator's response or leave it as it is",
                got=repr(fault),
                remedy="use a twin whose actuators' response is visible, such as KinematicTwin",
            )
        onsets[i] = np.where(onset < steps - 1, onset, steps)
    return onsets
