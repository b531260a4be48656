"""`SimulationPlan`: what is to be simulated. The plan alone decides the bytes, chunk by chunk."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from retwin.data.io.header import CHUNKED_NAMES, FAILED
from retwin.data.trajectories import HEALTHY, Channels, Provenance, Trajectories
from retwin.errors import InputError, place_of
from retwin.progress import Progress
from retwin.twins.faults import Fault
from retwin.twins.limits import Limits
from retwin.twins.twin import SimulationError, Twin, checked_commands

if TYPE_CHECKING:  # a worker that simulates without torch need not load it
    from retwin.twins.samplers import CommandSampler

__all__ = ["Made", "Recorded", "SimulationPlan", "make_chunk"]

LONGEST_REASON = 200
"""Characters kept of why a trajectory failed: a million of them must fit a header."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """Commands (k, T, d_u) that are at hand: in memory, or in a file *.npy that is mapped."""

    held: NDArray | Path

    @property
    def array(self) -> NDArray:
        """The commands; from a file only what is used is read."""
        return self.held if isinstance(self.held, np.ndarray) else np.load(self.held, "r")

    @property
    def steps(self) -> int:
        """Samples per trajectory, T."""
        return int(self.array.shape[1])


@dataclass(frozen=True, eq=False)
class SimulationPlan:
    """What is to be simulated, and with which seed.

    Parameters
    ----------
    twin: any twin. One with `timing` (k, M) in samples, as a corrected twin has, hands it to the
        sampler.
    commands: a sampler that draws them; or the commands themselves, (k, T, d_u) or the
        trajectories that hold them, taken in turn: trajectory i gets row i mod k.
    seed: same plan, same bytes on the same machine.
    n: trajectories; by default one for every row of commands.
    faults: class name to fault, `None` for healthy, dealt in turn: trajectory i is of class
        i mod (number of classes). The faults of a case give a balanced set.
    clip: whether commands outside the twin's limits are put on the limit, where the twin itself
        would refuse them.
    chunk: trajectories that are simulated, written and, after an interruption, repeated together.
    dtype: of the numbers that are stored. The twin gets the commands as they are stored.

    Raises
    ------
    InputError: commands of another width, rate or channels than the twin's, not finite, or outside
        its limits; no n where there is no row to count; numbers that are not positive; no class.

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
        if self.dtype not in ("float32", "float64"):
            raise InputError(
                "dtype",
                expected="'float32' or 'float64'",
                got=repr(self.dtype),
                remedy="say how numbers are to be stored",
            )
        if isinstance(self.commands, Trajectories):
            _check_kin(self.commands, self.twin)
            object.__setattr__(self, "commands", self.commands.commands)
        if isinstance(self.commands, np.ndarray):
            array = self._within(checked_commands(self.commands, self.twin.inputs))
            object.__setattr__(self, "commands", Recorded(array.astype(self.dtype, copy=False)))
        if self.n is None and isinstance(self.commands, Recorded):
            object.__setattr__(self, "n", len(self.commands.array))
        for name, least in (("n", 1), ("chunk", 1), ("seed", 0)):
            value = getattr(self, name)
            if not (isinstance(value, int | np.integer) and value >= least):
                raise InputError(
                    name,
                    expected=f"a whole number of at least {least}",
                    got=repr(value),
                    remedy="give one; a sampler does not say how many trajectories it is to draw",
                )
        if not self.faults:
            raise InputError(
                "faults",
                expected="at least one class",
                got="none",
                remedy=f"give {{'{HEALTHY}': None}} for healthy trajectories only",
            )

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
    def chunks(self) -> int:
        """How many chunks there are."""
        return -(-self.count // self.chunk)

    def rows(self, number: int) -> NDArray:
        """The indices of the trajectories in a chunk."""
        begin = number * self.chunk
        return np.arange(begin, min(begin + self.chunk, self.count))

    def empty(self, *, emulated: bool = False) -> Trajectories:
        """None of the trajectories, but what they have in common."""
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
        """The commands (n, T, d_u) of the trajectories `rows`, as they are stored."""
        if isinstance(self.commands, Recorded):
            held = self.commands.array
            return np.ascontiguousarray(held[rows % len(held)])
        assert not isinstance(self.commands, Trajectories | np.ndarray)
        timing = getattr(self.twin, "timing", None)
        drawn = self.commands.sample(len(rows), rng=rng, timing=timing)
        drawn = checked_commands(drawn, self.twin.inputs)
        if drawn.shape[:2] != (len(rows), self.steps):
            raise InputError(
                "commands",
                expected=f"{len(rows)} trajectories of {self.steps} samples from the sampler",
                got=f"shape {drawn.shape}",
                remedy="have `sample` draw as many as it is asked for, of `steps` samples",
            )
        return self._within(drawn).astype(self.dtype, copy=False)

    def _within(self, commands: NDArray) -> NDArray:
        limits: Limits | None = getattr(self.twin, "limits", None)
        if limits is None:
            return commands
        limits = replace(limits, outside="clip") if self.clip else limits
        return limits.keep(commands, self.twin.inputs)


@dataclass(frozen=True, eq=False)
class Made:
    """One chunk: its arrays by name, as they are stored, which trajectories failed and why."""

    arrays: Mapping[str, NDArray]
    failed: Mapping[int, str]
    emulated: bool


def make_chunk(plan: SimulationPlan, number: int, progress: Progress | None = None) -> Made:
    """Simulate one chunk of the plan; the same bytes wherever and in whatever order it is done.

    A trajectory that failed keeps its commands; its outputs are 0 with the mask False.

    Raises
    ------
    InputError: the twin refuses the commands or faults, or returns other shapes.
    SimulationError: every trajectory of the very first chunk failed, so all others would.
    Exception: whatever else the twin raises, with a note of where and of which trajectories.

    """
    rows = plan.rows(number)
    try:
        return _made(plan, number, rows, progress)
    except InputError as error:
        raise _of_the_whole(error, int(rows[0])) from error
    except SimulationError:
        raise
    except Exception as error:
        # The line goes into the note, for a traceback does not come out of a worker process.
        at = ", ".join(filter(None, (place_of(error), f"in trajectories {rows[0]} to {rows[-1]}")))
        error.add_note(at)
        raise


def _of_the_whole(error: InputError, begin: int) -> InputError:
    """The error with the number that a trajectory has in the plan: the twin counts in its chunk."""

    def counted(found: re.Match[str]) -> str:
        return f"trajectory {begin + int(found[1])}"

    got = re.sub(r"\btrajectory (\d+)\b", counted, error.got)
    return InputError(error.argument, expected=error.expected, got=got, remedy=error.remedy)


def _made(plan: SimulationPlan, number: int, rows: NDArray, progress: Progress | None) -> Made:
    for_commands, for_twin = np.random.SeedSequence(plan.seed, spawn_key=(number,)).spawn(2)
    classes = rows % len(plan.faults)
    faults = list(plan.faults.values())
    # More threads than one would not only crowd the cores: they sum in another order.
    with threadpool_limits(limits=1):
        commands = plan.drawn(rows, np.random.default_rng(for_commands))
        try:
            made = plan.twin.simulate(
                commands,
                faults=[faults[each] for each in classes],
                seed=int(for_twin.generate_state(1)[0]),
                progress=progress,
            )
            failed, good = {}, np.arange(len(rows))
        except SimulationError as error:
            if number == 0 and len(error.finished) == 0:
                raise
            made, failed = error.finished, dict(error.failed)
            good = np.array([int(each) for each in made.ids], dtype=int)
    return _stored(plan, made, good, failed, commands=commands, classes=classes, begin=rows[0])


def _stored(
    plan: SimulationPlan,
    made: Trajectories,
    good: NDArray,
    failed: dict[int, str],
    *,
    commands: NDArray,
    classes: NDArray,
    begin: int,
) -> Made:
    width = len(plan.twin.outputs)
    if made.observed.shape != (len(good), plan.steps, width):
        raise InputError(
            "twin",
            expected=f"outputs of shape {(len(good), plan.steps, width)}",
            got=str(made.observed.shape),
            remedy="have `simulate` return one trajectory per command, on the commands' time grid",
        )
    given = {name: getattr(made, name) for name in ("commands", "nominal", "observed")}
    with np.errstate(over="ignore"):
        given = {name: array.astype(plan.dtype) for name, array in given.items()}
    finite = np.all([np.isfinite(array).all(axis=(1, 2)) for array in given.values()], axis=0)
    failed |= {int(i): f"a value is too large for {plan.dtype}" for i in good[~finite]}
    arrays = {
        "commands": commands.copy(),
        "nominal": np.zeros((len(commands), plan.steps, width), plan.dtype),
        "observed": np.zeros((len(commands), plan.steps, width), plan.dtype),
        "mask": np.zeros((len(commands), plan.steps, width), dtype=bool),
        "labels": np.full(len(commands), FAILED, np.int16),
    }
    for name, values in (given | {"mask": made.mask}).items():
        arrays[name][good[finite]] = values[finite]
    arrays["labels"][good[finite]] = classes[good[finite]]
    assert tuple(arrays) == CHUNKED_NAMES
    told = {int(begin) + i: " ".join(failed[i].split())[:LONGEST_REASON] for i in sorted(failed)}
    return Made(arrays, told, made.emulated)


def _check_kin(trajectories: Trajectories, twin: Twin) -> None:
    """Refuse commands that were recorded at another rate or on other channels than the twin's."""
    if trajectories.rate != twin.rate:
        raise InputError(
            "commands",
            expected=f"the rate of the twin, {twin.rate:g} Hz",
            got=f"{trajectories.rate:g} Hz",
            remedy="resample them, or have the twin run at their rate",
        )
    # A set whose channels nobody has named may be named now.
    if trajectories.inputs not in (twin.inputs, Channels.numbered("u", len(twin.inputs))):
        raise InputError(
            "commands",
            expected=f"the inputs of the twin, {_named(twin.inputs)}",
            got=_named(trajectories.inputs),
            remedy="give commands for this twin; a file without commands needs its case",
        )


def _named(channels: Channels) -> str:
    pairs = zip(channels.names, channels.units, strict=True)
    return ", ".join(f"{name} [{unit}]" for name, unit in pairs) or "none"
