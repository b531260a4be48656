"""`CommandSide`: any twin whose commands arrive late and shifted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.data.segments import Segments
from retwin.data.trajectories import Channels, Trajectories
from retwin.progress import Progress
from retwin.twins.faults import Fault
from retwin.twins.parametric import TRAJECTORIES_PER_CHUNK, Parameter, values_per_simulation
from retwin.twins.twin import (
    Chunk,
    Twin,
    checked_commands,
    nominal_outputs,
    simulate_in_chunks,
)
from retwin.twins.wrapper import TwinWrapper, simulate_chunk

__all__ = ["CommandSide", "command_side_parameters"]

DELAY = "delay"
OFFSET = "offset"


@dataclass(frozen=True)
class CommandSide(TwinWrapper):
    """Any twin whose commands arrive late and shifted: parameters `delay` and `offset.CHANNEL`.

    A transport delay in samples (fractions allowed, all actuators alike) and for every actuator an
    offset in its command unit, constant from the first sample on. They act after faults on the
    command and before a stuck actuator is held. What then lies beyond the twin's limits saturates.
    Other parameters go to the twin inside.

    Parameters
    ----------
    twin: the twin inside.
    nominal: the ideal output (n, T, d_y) for clean commands (n, T, d_u); by default what the twin
        inside says, which costs a second simulation.

    """

    twin: Twin
    nominal: Callable[[NDArray], NDArray] | None = None

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
    ) -> Trajectories:
        """See `TakesParameters.simulate`."""
        commands = checked_commands(commands, self.inputs)
        count = len(commands)
        offsets = tuple(f"{OFFSET}.{name}" for name in self.inputs.names)
        given = dict(parameters or {})
        own = {name: given.pop(name) for name in (DELAY, *offsets) if name in given}
        mine = values_per_simulation(own, (DELAY, *offsets), count)
        theirs = values_per_simulation(given, tuple(given), count)
        delay = mine.get(DELAY, np.zeros(count))
        offset = np.stack([mine.get(name, np.zeros(count)) for name in offsets], axis=-1)

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            rows = np.arange(len(chunk.commands))
            options = {name: each[chunk.index] for name, each in theirs.items()}
            late = (
                _delayed(chunk.faulty_commands, delay[chunk.index]) + offset[chunk.index][:, None]
            )
            held: list[Fault | None] = [
                None if fault is None else _ResponseOnly(fault) for fault in chunk.faults
            ]
            ask = partial(simulate_chunk, self.twin, chunk, rows, seed=seed, parameters=options)
            _, observed = ask(self._kept(late), held)
            if self.nominal is not None:
                return nominal_outputs(self.nominal, chunk.commands, len(self.outputs)), observed
            healthy: list[Fault | None] = [None] * len(rows)
            nominal, _ = ask(chunk.commands, healthy)
            return nominal, observed

        return simulate_in_chunks(
            self, run, commands, faults, seed=seed, progress=progress, size=TRAJECTORIES_PER_CHUNK
        )

    def _kept(self, commands: NDArray) -> NDArray:
        """An actuator goes no further than its limits."""
        if self.limits is None:
            return commands
        return np.clip(commands, self.limits.low, self.limits.high)


def command_side_parameters(
    inputs: Channels, *, delay: tuple[float, float], offset: float
) -> tuple[Parameter, ...]:
    """The parameters of `CommandSide`: `delay` (low, high) in samples, offsets within ±`offset`."""
    offsets = (
        Parameter(f"{OFFSET}.{name}", unit, -offset, offset, 0.0)
        for name, unit in zip(inputs.names, inputs.units, strict=True)
    )
    start = min(max(0.0, delay[0]), delay[1])
    return Parameter(DELAY, "samples", *delay, start), *offsets


@dataclass(frozen=True)
class _ResponseOnly:
    """A fault whose effect on the command is already there."""

    fault: Fault

    @property
    def label(self) -> str:
        return self.fault.label

    def drawn(self, rng: np.random.Generator, *, steps: int, movements: int) -> _ResponseOnly:
        return self

    def command(self, commands: NDArray, segments: Segments) -> NDArray:
        return commands

    def response(self, response: NDArray) -> NDArray:
        return self.fault.response(response)


def _delayed(commands: NDArray, delay: NDArray) -> NDArray:
    """Commands (n, T, d_u) late by `delay` (n,) samples, linear between samples."""
    last = commands.shape[1] - 1
    when = np.clip(np.arange(last + 1) - delay[:, None], 0, last)
    below = np.minimum(when.astype(int), last - 1)
    share = (when - below)[..., None]
    row = np.arange(len(commands))[:, None]
    return (1 - share) * commands[row, below] + share * commands[row, below + 1]
