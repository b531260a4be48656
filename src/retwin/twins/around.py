"""What twins share that are built around another one: its channels, and how it is asked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.data.trajectories import Channels
from retwin.twins.faults import Fault
from retwin.twins.twin import Chunk, Limits, SimulationError, Twin

__all__ = ["Around", "generator_of", "simulate_chunk"]


class Around:
    """A twin around another one has its channels, rate and limits."""

    if TYPE_CHECKING:

        @property
        def twin(self) -> Twin:
            """The twin inside."""

    @property
    def inputs(self) -> Channels:
        """Command channels."""
        return self.twin.inputs

    @property
    def outputs(self) -> Channels:
        """Output channels."""
        return self.twin.outputs

    @property
    def rate(self) -> float:
        """Samples per second."""
        return self.twin.rate

    @property
    def limits(self) -> Limits | None:
        """What commands must keep."""
        return getattr(self.twin, "limits", None)


def simulate_chunk(
    twin: Twin,
    chunk: Chunk,
    rows: NDArray,
    commands: NDArray | None = None,
    faults: Sequence[Fault | None] | None = None,
    *,
    seed: int,
    parameters: Mapping[str, ArrayLike] | None = None,
) -> tuple[NDArray, NDArray]:
    """Nominal and observed outputs of those rows of a chunk, by a twin inside another one.

    `commands` and `faults`, one per row, are by default the chunk's. What could not be simulated is
    noted in the chunk, and its outputs are 0.
    """
    commands = chunk.commands[rows] if commands is None else commands
    faults = [chunk.faults[i] for i in rows] if faults is None else faults
    key = (1, chunk.index.start + int(rows[0]))
    own = int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1)[0])
    options: dict[str, Any] = {"parameters": parameters} if parameters else {}
    try:
        made = twin.simulate(commands, faults=faults, seed=own, **options)
    except SimulationError as error:
        for i, why in error.failed.items():
            chunk.failed[int(rows[i])] = why
        nominal = np.zeros((*commands.shape[:2], len(twin.outputs)))
        observed = np.zeros_like(nominal)
        good = np.setdiff1d(np.arange(len(rows)), list(error.failed))
        nominal[good], observed[good] = error.finished.nominal, error.finished.observed
        return nominal, observed
    return made.nominal, made.observed


def generator_of(seed: int, chunk: Chunk, purpose: int) -> np.random.Generator:
    """A generator of one chunk's own; a twin inside draws from another one, of purpose 1."""
    key = (purpose, chunk.index.start)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
