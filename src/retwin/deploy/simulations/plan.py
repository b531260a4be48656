"""`SimulationPlan`: what is simulated, and the simulation of one chunk of it.

The bytes of a chunk depend on the plan and the chunk's number alone.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from retwin.arrays import is_finite
from retwin.checks import agree, at_least, one_of, require, whole
from retwin.data.io.header import CHUNKED_NAMES, FAILED
from retwin.data.trajectories import HEALTHY, Channels, Provenance, Trajectories
from retwin.errors import InputError, place_of
from retwin.progress import Progress
from retwin.twins.collected import SimulationError
from retwin.twins.commands.range import part_of
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.limits import Limits
from retwin.twins.twin import Twin, checked_commands

if TYPE_CHECKING:  # a worker that simulates without torch need not load it
    from retwin.twins.commands.samplers import CommandSampler

MAX_CHUNK = 2**31 - 1
"""Greatest number of trajectories in a chunk; the memory allows fewer of any length."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """Given commands, as opposed to a sampler that draws them.

    Attributes
    ----------
    source : ndarray or Path
        Commands of shape (k, T, d_u), or an NPY file with them that is memory-mapped.

    """

    source: NDArray | Path

    @property
    def array(self) -> NDArray:
        """The commands (k, T, d_u); only the used part of a file is read."""
        return self.source if isinstance(self.source, np.ndarray) else np.load(self.source, "r")

    @property
    def steps(self) -> int:
        """Samples per trajectory, T."""
        return int(self.array.shape[1])


@dataclass(frozen=True, eq=False)
class SimulationPlan:
    """What is simulated, and with which seed; the same plan gives the same bytes on one machine.

    Parameters
    ----------
    twin : Twin
        The twin. A corrected twin has `onsets` (k, M) in s, which the sampler gets.
    commands : CommandSampler, Trajectories or ndarray
        A sampler; or commands of shape (k, T, d_u), or trajectories with such commands, where
        trajectory i gets row i mod k.
    seed : int
        Seed of commands and simulations, at least 0.
    n : int, optional
        Number of trajectories; by default one for each row of given commands.
    faults : mapping of str to Fault or None
        Fault of each class, None for the healthy one. Trajectory i is of class i mod (number of
        classes), so the faults of a case give a balanced set.
    clip : bool
        Whether commands outside the twin's limits are clipped, which the twin may refuse otherwise.
    chunk : int
        Trajectories that are simulated and written together, at least 1. An interruption loses at
        most one chunk per worker.
    dtype : {"float32", "float64"}
        Type of the stored numbers; the twin gets the commands as they are stored.

    Raises
    ------
    InputError
        If commands are not finite, outside the limits, or have other channels or another rate than
        the twin; if `n` is missing; if a number is outside its range; or if there is no class.

    """

    twin: Twin
    commands: CommandSampler | Trajectories | NDArray | Recorded
    seed: int
    n: int | None = None
    faults: Mapping[str, Fault | None] = field(default_factory=lambda: {HEALTHY: None})
    clip: bool = False
    chunk: int = 256
    dtype: Literal["float32", "float64"] = "float32"

    def __post_init__(self) -> None:
        one_of("dtype", self.dtype, ("float32", "float64"))
        whose = "that of the twin"
        if not isinstance(self.commands, np.ndarray | Recorded):
            remedy = "give commands at its rate, or have it run at theirs"
            agree("commands", self.commands, self.twin, whose, names=("rate",), remedy=remedy)
        if isinstance(self.commands, Trajectories):
            # Channels without names of their own are those of the twin.
            if self.commands.inputs != Channels.numbered("u", len(self.twin.inputs)):
                remedy = "give commands for this twin; a file without commands needs its case"
                agree("commands", self.commands, self.twin, whose, names=("inputs",), remedy=remedy)
            object.__setattr__(self, "commands", self.commands.commands)
        if isinstance(self.commands, np.ndarray):
            array = self._within(checked_commands(self.commands, self.twin.inputs))
            object.__setattr__(self, "commands", Recorded(array.astype(self.dtype, copy=False)))
        if self.n is None and isinstance(self.commands, Recorded):
            object.__setattr__(self, "n", len(self.commands.array))
        whole(
            "n", self.n, at_least=1, remedy="give the number of trajectories that are to be drawn"
        )
        whole("chunk", self.chunk, at_least=1, at_most=MAX_CHUNK)
        whole("seed", self.seed)
        remedy = f"give {{'{HEALTHY}': None}} for healthy trajectories only"
        at_least("faults", self.faults, 1, "class", remedy=remedy)

    @property
    def count(self) -> int:
        """Trajectories, n."""
        assert self.n is not None
        return int(self.n)

    @property
    def steps(self) -> int:
        """Samples per trajectory, T."""
        assert not isinstance(self.commands, Trajectories | np.ndarray)
        return self.commands.steps

    @property
    def trajectory_bytes(self) -> int:
        """Size of a trajectory in bytes, as it is stored before it is packed."""
        outputs = len(self.twin.outputs)
        numbers = np.dtype(self.dtype).itemsize * (len(self.twin.inputs) + 2 * outputs)
        return self.steps * (numbers + outputs)

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return -(-self.count // self.chunk)

    def rows(self, number: int) -> NDArray:
        """Indices of the trajectories in a chunk."""
        begin = number * self.chunk
        return np.arange(begin, min(begin + self.chunk, self.count))

    def empty(self, *, emulated: bool = False) -> Trajectories:
        """An empty set with the channels, rate and provenance of the trajectories."""
        outputs = np.empty((0, self.steps, len(self.twin.outputs)), self.dtype)
        return Trajectories(
            commands=np.empty((0, self.steps, len(self.twin.inputs)), self.dtype),
            nominal=outputs,
            observed=outputs,
            rate=self.twin.rate,
            inputs=self.twin.inputs,
            outputs=self.twin.outputs,
            provenance=(Provenance(f"{type(self.twin).__name__} seed={self.seed}"),),
            emulated=emulated,
        )

    def drawn(self, rows: NDArray, rng: np.random.Generator) -> NDArray:
        """Commands (n, T, d_u) of the trajectories `rows`, as they are stored."""
        if isinstance(self.commands, Recorded):
            given = self.commands.array
            return np.ascontiguousarray(given[rows % len(given)])
        assert not isinstance(self.commands, Trajectories | np.ndarray)
        onsets = getattr(self.twin, "onsets", None)
        drawn = self.commands.sample(len(rows), rng=rng, onsets=onsets)
        drawn = checked_commands(drawn, self.twin.inputs)
        fits = drawn.shape[:2] == (len(rows), self.steps)
        expected = f"{len(rows)} trajectories of {self.steps} samples from the sampler"
        remedy = "have `sample` return the requested number of trajectories, of `steps` samples"
        require(fits, "commands", expected=expected, got=f"shape {drawn.shape}", remedy=remedy)
        return self._within(drawn).astype(self.dtype, copy=False)

    def _within(self, commands: NDArray) -> NDArray:
        limits: Limits | None = getattr(self.twin, "limits", None)
        if limits is None:
            return commands
        limits = replace(limits, outside="clip") if self.clip else limits
        return limits.keep(commands, self.twin.inputs)


@dataclass(frozen=True, eq=False)
class SimulatedChunk:
    """One simulated chunk.

    Attributes
    ----------
    arrays : mapping of str to ndarray
        Arrays as they are stored, in the order of `CHUNKED_NAMES`.
    failed : mapping of int to str
        Index and reason of every trajectory that failed.
    emulated : bool
        Whether the twin emulates a real system.

    """

    arrays: Mapping[str, NDArray]
    failed: Mapping[int, str]
    emulated: bool


def simulate_chunk(
    plan: SimulationPlan, number: int, progress: Progress | None = None
) -> SimulatedChunk:
    """Simulate one chunk of a plan.

    A trajectory that failed keeps its commands; its outputs are 0 with the mask False.

    Parameters
    ----------
    plan : SimulationPlan
        The plan.
    number : int
        Number of the chunk, from 0.
    progress : callable, optional
        Called with the share of the chunk that is done.

    Returns
    -------
    SimulatedChunk
        The same bytes wherever and in whatever order chunks are simulated.

    Raises
    ------
    InputError
        If the twin refuses commands or faults, or returns other shapes.
    SimulationError
        If every trajectory of the first chunk failed, so that all others would.
    Exception
        Whatever else the twin raises, with a note of the line and the trajectories.

    """
    rows = plan.rows(number)
    try:
        return _simulated(plan, number, rows, progress)
    except InputError as error:
        raise _renumbered(error, int(rows[0])) from error
    except SimulationError:
        raise
    except Exception as error:
        # The note holds the line, since a worker process does not return its traceback.
        at = ", ".join(filter(None, (place_of(error), f"in trajectories {rows[0]} to {rows[-1]}")))
        error.add_note(at)
        raise


def _renumbered(error: InputError, begin: int) -> InputError:
    """The error with a trajectory's index in the plan instead of that in its chunk."""

    def counted(found: re.Match[str]) -> str:
        return f"trajectory {begin + int(found[1])}"

    return error.with_parts(got=re.sub(r"\btrajectory (\d+)\b", counted, error.got))


def _simulated(
    plan: SimulationPlan, number: int, rows: NDArray, progress: Progress | None
) -> SimulatedChunk:
    for_commands, for_twin = np.random.SeedSequence(plan.seed, spawn_key=(number,)).spawn(2)
    faults = list(plan.faults.values())
    # With more threads sums would have another order, hence other bytes, and workers would compete.
    with threadpool_limits(limits=1), part_of(plan.count):
        commands = plan.drawn(rows, np.random.default_rng(for_commands))
        try:
            made = plan.twin.simulate(
                commands,
                faults=[faults[row % len(faults)] for row in rows],
                seed=int(for_twin.generate_state(1)[0]),
                progress=progress,
            )
            failed, good = {}, np.arange(len(rows))
        except SimulationError as error:
            if number == 0 and len(error.finished) == 0:
                raise
            made, failed = error.finished, dict(error.failed)
            good = np.array([int(each) for each in made.ids], dtype=int)
    classes, width = rows % len(plan.faults), len(plan.twin.outputs)
    fits = made.observed.shape == (len(good), plan.steps, width)
    expected = f"outputs of shape {(len(good), plan.steps, width)}"
    remedy = "have `simulate` return one trajectory per command, on the commands' time grid"
    require(fits, "twin", expected=expected, got=made.observed.shape, remedy=remedy)
    given = {name: getattr(made, name) for name in ("commands", "nominal", "observed")}
    with np.errstate(over="ignore"):
        given = {name: array.astype(plan.dtype, copy=False) for name, array in given.items()}
    given["mask"] = made.mask
    if not failed and all(map(is_finite, given.values())):
        return SimulatedChunk(given | {"labels": classes.astype(np.int16)}, {}, made.emulated)
    finite = np.all([np.isfinite(array).all(axis=(1, 2)) for array in given.values()], axis=0)
    failed |= {int(i): f"a value is too large for {plan.dtype}" for i in good[~finite]}
    sound = good[finite]
    given["labels"] = classes[good].astype(np.int16)
    arrays = {
        name: np.zeros((len(classes), *each.shape[1:]), each.dtype) for name, each in given.items()
    }
    arrays["commands"][:], arrays["labels"][:] = commands, FAILED
    for name, values in given.items():
        arrays[name][sound] = values[finite]
    assert tuple(arrays) == CHUNKED_NAMES
    # Greatest number of characters of a failure's reason; a header holds up to a million of them.
    reasons = {int(rows[0]) + i: " ".join(failed[i].split())[:200] for i in sorted(failed)}
    return SimulatedChunk(arrays, reasons, made.emulated)
