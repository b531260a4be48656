"""What every twin offers: commands in, trajectories out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.errors import InputError
from retwin.faults import Fault, draw_faults, faulty_commands, frozen_response
from retwin.segments import Segments
from retwin.trajectories import Channels, Progress, Source, Trajectories

__all__ = ["HEALTHY", "Chunk", "Progress", "Twin", "checked_commands", "simulate_in_chunks"]

HEALTHY = "Healthy"


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

        Raises
        ------
        InputError: commands of another width, NaN or infinite; not one fault per trajectory.

        """
        ...


def checked_commands(commands: ArrayLike, inputs: Channels) -> NDArray:
    """`commands` as a finite float array (n, T, d_u), or an InputError."""
    array = np.asarray(commands)
    if (
        array.ndim != 3
        or len(array) == 0
        or array.shape[2] != len(inputs)
        or array.dtype.kind not in "fiu"
    ):
        raise InputError(
            "commands",
            expected=f"numbers of shape (n, T, {len(inputs)})",
            got=f"{array.dtype} of shape {array.shape}",
            remedy=f"give one column per input channel, {', '.join(inputs.names)}",
        )
    if not np.isfinite(array).all():
        raise InputError(
            "commands",
            expected="finite numbers",
            got="NaN or an infinite value",
            remedy="commands are known inputs: repair or drop that trajectory",
        )
    return array if array.dtype.kind == "f" else array.astype(np.float64)


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
    told: (n, T, d_u), with the faults' effect on the reference.
    faults: drawn, one per trajectory.
    segments: movements of the clean commands.

    """

    index: slice
    commands: NDArray
    told: NDArray
    faults: Sequence[Fault | None]
    segments: Segments

    @property
    def held(self) -> NDArray:
        """`told`, with the faults' effect on the response put on the commands themselves.

        For twins whose actuators are not visible: a frozen response is a held command.
        """
        return frozen_response(self.told, self.faults)


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

    Checks commands, draws the severities of faults, tells progress, and collects what `run` says
    of each chunk of at most `size` trajectories: nominal and observed outputs (n, T, d_y).
    """
    commands = checked_commands(commands, twin.inputs)
    _check_actuators(faults or (), twin.inputs)
    segments = Segments.from_commands(commands)
    drawn = draw_faults([None] * len(commands) if faults is None else faults, segments, seed)
    nominal = np.empty((*commands.shape[:2], len(twin.outputs)), dtype=commands.dtype)
    observed = np.empty_like(nominal)
    for begin in range(0, len(commands), size):
        index = slice(begin, begin + size)
        part, some, these = commands[index], drawn[index], segments[index]
        told = faulty_commands(part, some, these)
        nominal[index], observed[index] = run(Chunk(index, part, told, some, these))
        if progress is not None:
            progress(min(1.0, (begin + size) / len(commands)))
    return Trajectories(
        commands=commands,
        nominal=nominal,
        observed=observed,
        labels=np.array([HEALTHY if fault is None else fault.label for fault in drawn]),
        rate=twin.rate,
        inputs=twin.inputs,
        outputs=twin.outputs,
        provenance=(Source(f"{type(twin).__name__} seed={seed}"),),
        emulated=emulated,
    )
