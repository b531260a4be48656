"""What every twin offers: commands in, trajectories out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.arrays import check_finite, row_blocks
from retwin.data.segments import Segments
from retwin.data.trajectories import HEALTHY, Channels, Provenance, Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.twins.faults import Fault, draw_faults, faulty_commands, frozen_from, frozen_response

__all__ = [
    "Chunk",
    "Limits",
    "SimulationError",
    "Twin",
    "checked_commands",
    "checked_seed",
    "simulate_in_chunks",
]


class SimulationError(RuntimeError):
    """Some trajectories could not be simulated; the others are at hand.

    Attributes
    ----------
    failed: index of the trajectory to the reason.
    finished: the trajectories that were simulated; their ids are their indices.

    """

    def __init__(self, failed: Mapping[int, str], finished: Trajectories) -> None:
        self.failed = dict(failed)
        self.finished = finished
        named = "; ".join(f"trajectory {i}: {why}" for i, why in list(self.failed.items())[:5])
        more = "; …" if len(self.failed) > 5 else ""
        count = len(self.failed) + len(finished)
        super().__init__(f"{len(self.failed)} of {count} simulations failed: {named}{more}")

    def __reduce__(self) -> tuple:
        """Keep the parts when the error crosses a process border."""
        return SimulationError, (self.failed, self.finished)


@runtime_checkable
class Twin(Protocol):
    """A simulator: plain, learned or corrected, all look the same."""

    @property
    def inputs(self) -> Channels:
        """Command channels."""
        ...

    @property
    def outputs(self) -> Channels:
        """Output channels."""
        ...

    @property
    def rate(self) -> float:
        """Samples per second."""
        ...

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """Simulate `commands` (n, T, d_u), each with its fault, if any.

        `nominal` of the result is the ideal output for the clean commands, `observed` what the
        twin says happens, `labels` the label of each fault. The same seed gives the same bytes.

        A twin may also have `limits`, the `Limits` its commands must keep, and `fingerprint`, a
        text that tells it from others where its fields, and the files they name, do not.

        Raises
        ------
        InputError: commands of another width, NaN or infinite, or outside the twin's limits; not
            one fault per trajectory; a seed that is no whole number or below 0.
        SimulationError: some trajectories could not be simulated; it names them and holds the
            others.

        """
        ...


@dataclass(frozen=True)
class Limits:
    """The least and the greatest command of every input channel.

    Parameters
    ----------
    low, high: one per channel, in its unit; infinite where there is no limit.
    outside: what to do with commands beyond: "refuse" them, or "clip" them to the limit.

    Limits are for what an operator commands. A fault that pushes an effective command beyond them
    is none of the operator's: what then happens is up to the twin.

    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    outside: Literal["refuse", "clip"] = "refuse"

    def __post_init__(self) -> None:
        paired = len(self.low) == len(self.high)
        if not (paired and all(a < b for a, b in zip(self.low, self.high, strict=True))):
            raise InputError(
                "limits",
                expected="one low and one greater high per input channel",
                got=f"low {self.low}, high {self.high}",
                remedy="give -inf and inf where a channel has no limit",
            )
        if self.outside not in ("refuse", "clip"):
            raise InputError(
                "outside",
                expected="'refuse' or 'clip'",
                got=repr(self.outside),
                remedy="say what to do with commands beyond the limits",
            )

    def keep(self, commands: NDArray, inputs: Channels) -> NDArray:
        """`commands` (n, T, d_u) within the limits, clipped if that is asked for.

        Raises InputError when a command is outside and `outside` is "refuse", or when there are
        not as many limits as channels.
        """
        if len(self.low) != len(inputs):
            raise InputError(
                "limits",
                expected=f"{len(inputs)}, one per input channel",
                got=f"{len(self.low)}",
                remedy="give -inf and inf where a channel has no limit",
            )
        low = np.asarray(self.low, commands.dtype)
        high = np.asarray(self.high, commands.dtype)
        if self.outside == "clip":
            return np.clip(commands, low, high)
        for rows in row_blocks(commands):
            beyond = (commands[rows] < low) | (commands[rows] > high)
            if beyond.any():
                trajectory, sample, channel = np.argwhere(beyond)[0] + (rows.start, 0, 0)
                raise InputError(
                    "commands",
                    expected=f"{inputs.names[channel]} from {low[channel]:g} to {high[channel]:g} "
                    f"{inputs.units[channel]}",
                    got=f"{commands[trajectory, sample, channel]:g} in trajectory {trajectory}, "
                    f"sample {sample}",
                    remedy="keep the limits, or have commands clipped (outside='clip')",
                )
        return commands


def checked_commands(commands: ArrayLike, inputs: Channels) -> NDArray:
    """`commands` as a finite float array (n, T, d_u), or an InputError."""
    array = np.asarray(commands)
    if (
        array.ndim != 3
        or len(array) == 0
        or array.shape[1] < 2
        or array.shape[2] != len(inputs)
        or array.dtype.kind not in "fiu"
    ):
        raise InputError(
            "commands",
            expected=f"numbers of shape (n, T, {len(inputs)}), T at least 2",
            got=f"{array.dtype} of shape {array.shape}",
            remedy=f"give one column per input channel, {', '.join(inputs.names)}",
        )
    check_finite("commands", array)
    return array if array.dtype.kind == "f" else array.astype(np.float64)


def checked_seed(seed: int) -> int:
    """`seed` as a plain number, or an InputError."""
    if not (isinstance(seed, int | np.integer) and seed >= 0):
        raise InputError(
            "seed",
            expected="a whole number of at least 0",
            got=repr(seed),
            remedy="give one: the same seed gives the same result",
        )
    return int(seed)


def _check_actuators(faults: Sequence[Fault | None], inputs: Channels) -> None:
    """A fault on one actuator must name one that there is."""
    for fault in faults:
        actuator = getattr(fault, "actuator", 0)
        if not 0 <= actuator < len(inputs):
            raise InputError(
                "faults",
                expected=f"an actuator from 0 to {len(inputs) - 1}",
                got=repr(fault),
                remedy=f"count the command channels from 0: {', '.join(inputs.names)}",
            )


@dataclass(frozen=True, eq=False)
class Chunk:
    """A few trajectories that are simulated together.

    Attributes
    ----------
    index: which of all they are.
    commands: (n, T, d_u), clean.
    faulty_commands: (n, T, d_u), the commands with the effect of the faults on the reference.
    faults: drawn, one per trajectory.
    segments: movements of the clean commands.
    failed: for `run` to fill in: which trajectories of this chunk, counted from 0, could not be
        simulated, and why. Their outputs do not matter.

    """

    index: slice
    commands: NDArray
    faulty_commands: NDArray
    faults: Sequence[Fault | None]
    segments: Segments
    failed: dict[int, str] = field(default_factory=dict)

    @property
    def frozen(self) -> NDArray:
        """The sample (n, d_u) from which an actuator is held; T where it never is."""
        return frozen_from(self.faults, *self.commands.shape[1:])

    @property
    def held_commands(self) -> NDArray:
        """`faulty_commands`, held from the sample at which an actuator freezes.

        For twins whose actuators are not visible: a frozen response is a held command.
        """
        return frozen_response(self.faulty_commands, self.faults)


def simulate_in_chunks(
    twin: Twin,
    run: Callable[[Chunk], tuple[NDArray, NDArray]],
    commands: ArrayLike,
    faults: Sequence[Fault | None] | None,
    *,
    seed: int,
    progress: Progress | None,
    size: int = 128,
    emulated: bool = False,
) -> Trajectories:
    """What every twin's `simulate` does around its own simulation `run`.

    Checks all arguments, draws the severities of faults, tells progress, collects what `run` says
    of each chunk of at most `size` trajectories: nominal and observed outputs (n, T, d_y). One
    trajectory that fails, or gives outputs that are not finite, does not end the others.
    """
    commands = checked_commands(commands, twin.inputs)
    limits: Limits | None = getattr(twin, "limits", None)
    if limits is not None:
        commands = limits.keep(commands, twin.inputs)
    seed = checked_seed(seed)
    _check_actuators(faults or (), twin.inputs)
    segments = Segments.from_commands(commands)
    drawn = draw_faults([None] * len(commands) if faults is None else faults, segments, seed)
    nominal = np.empty((*commands.shape[:2], len(twin.outputs)), dtype=commands.dtype)
    observed = np.empty_like(nominal)
    failed: dict[int, str] = {}
    for begin in range(0, len(commands), size):
        index = slice(begin, begin + size)
        part, some, these = commands[index], drawn[index], segments[index]
        told = faulty_commands(part, some, these)
        chunk = Chunk(index, part, told, some, these)
        nominal[index], observed[index] = run(chunk)
        wrong = _not_finite(twin, nominal[index], observed[index]) | chunk.failed
        failed |= {begin + i: reason for i, reason in sorted(wrong.items())}
        if progress is not None:
            progress(min(1.0, (begin + size) / len(commands)))
    labels = np.array([HEALTHY if fault is None else fault.label for fault in drawn])
    good = np.setdiff1d(np.arange(len(commands)), list(failed)) if failed else slice(None)
    made = Trajectories(
        commands=commands[good].copy(),  # the caller's own are the caller's to change
        nominal=nominal[good],
        observed=observed[good],
        ids=np.array([f"{i:05d}" for i in range(len(commands))], dtype=np.str_)[good],
        labels=labels[good],
        rate=twin.rate,
        inputs=twin.inputs,
        outputs=twin.outputs,
        provenance=(Provenance(f"{type(twin).__name__} seed={seed}"),),
        emulated=emulated,
    )
    if failed:
        raise SimulationError(failed, made)
    return made


def _not_finite(twin: Twin, nominal: NDArray, observed: NDArray) -> dict[int, str]:
    """Which trajectories have outputs that are not finite, and where first."""
    wrong = {}
    for outputs in (observed, nominal):
        bad = ~np.isfinite(outputs)
        for i in np.flatnonzero(bad.any(axis=(1, 2))):
            sample, channel = np.argwhere(bad[i])[0]
            wrong[int(i)] = (
                f"{twin.outputs.names[channel]} is {outputs[i, sample, channel]} from sample "
                f"{sample} on"
            )
    return wrong
