"""`TwinWrapper`: the base of twins that simulate by another twin and change what goes in or out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.data.trajectories import Channels, Trajectories
from retwin.twins.collected import SimulationError
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.faults.system_faults import without_sensor_faults
from retwin.twins.limits import Limits
from retwin.twins.twin import Chunk, Twin

INNER_TWIN = 1
"""The purpose of random numbers that is reserved for the seeds of the wrapped twin."""


class OfTwin:
    """What has the channels and the sample rate of its twin."""

    _field: ClassVar[str] = "twin"
    """The field of the subclass that is the twin."""

    @property
    def _inner(self) -> Twin:
        return getattr(self, self._field)

    @property
    def inputs(self) -> Channels:
        """Command channels."""
        return self._inner.inputs

    @property
    def outputs(self) -> Channels:
        """Output channels."""
        return self._inner.outputs

    @property
    def rate(self) -> float:
        """Sample rate in Hz."""
        return self._inner.rate


class TwinWrapper(OfTwin):
    """A twin with the channels, rate and limits of the twin that it wraps, its field `twin`."""

    @property
    def limits(self) -> Limits | None:
        """Range of the commands; None where the wrapped twin declares none."""
        return getattr(self._inner, "limits", None)

    @property
    def shiftable(self) -> tuple[str, ...]:
        """Parameters that can change during a simulation."""
        return getattr(self._inner, "shiftable", ())


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
    """Outputs that a wrapped twin gives for some trajectories of a chunk.

    A trajectory that fails is entered in `chunk.failed`, and its outputs are 0. One that ends early
    is entered in `chunk.known`.

    Parameters
    ----------
    twin : Twin
        The wrapped twin.
    chunk : Chunk
        The chunk that the wrapper simulates.
    rows : ndarray of int, shape (k,)
        Trajectories of the chunk, counted from 0.
    commands : ndarray, shape (k, T, d_u), optional
        By default the chunk's clean commands.
    faults : sequence of Fault or None, optional
        One per row; by default the chunk's.
    seed : int
        Seed of the whole simulation, from which the wrapped twin's own seed is derived.
    parameters : mapping of str to array_like, optional
        Values of the wrapped twin's parameters, each of shape () or (k,).

    Returns
    -------
    nominal, observed : ndarray, shape (k, T, d_y)
        Outputs in physical units.

    """
    commands = chunk.commands[rows] if commands is None else commands
    faults = [chunk.faults[i] for i in rows] if faults is None else faults
    faults = without_sensor_faults(faults)
    key = (INNER_TWIN, chunk.index.start + int(rows[0]))
    inner_seed = int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1)[0])
    options: dict[str, Any] = {"parameters": parameters} if parameters else {}
    try:
        simulated = twin.simulate(commands, faults=faults, seed=inner_seed, **options)
    except SimulationError as error:
        for i, reason in error.failed.items():
            chunk.failed[int(rows[i])] = reason
        nominal = np.zeros((*commands.shape[:2], len(twin.outputs)))
        observed = np.zeros_like(nominal)
        good = np.setdiff1d(np.arange(len(rows)), list(error.failed))
        nominal[good], observed[good] = error.finished.nominal, error.finished.observed
        _enter_known(chunk, rows[good], error.finished)
        return nominal, observed
    _enter_known(chunk, rows, simulated)
    return simulated.nominal, simulated.observed


def _enter_known(chunk: Chunk, rows: NDArray, simulated: Trajectories) -> None:
    """Enter the trajectories that ended early in `chunk.known`."""
    known = simulated.mask.any(axis=2).sum(axis=1)
    for i in np.flatnonzero(known < simulated.steps):
        chunk.known[int(rows[i])] = int(known[i])


def chunk_generator(seed: int, chunk: Chunk, purpose: int) -> np.random.Generator:
    """Random generator that depends on the seed, the chunk and a purpose alone.

    Parameters
    ----------
    seed : int
        Seed of the whole simulation.
    chunk : Chunk
        The chunk for which numbers are drawn.
    purpose : int
        A number of its own for everything that is drawn; 1 is reserved for the wrapped twin.

    Returns
    -------
    numpy.random.Generator
        Independent of the generators of other chunks and purposes.

    """
    key = (purpose, chunk.index.start)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
