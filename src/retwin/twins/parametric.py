"""Twins with parameters: names, units and bounds, and one value per simulation.

What can be updated (Eq. 2 and 3) is declared here. A `TakesParameters` is a twin whose `simulate`
takes `parameters`, one value for all trajectories or one each: `MuJoCoTwin` and `FMUTwin` are, and
`RebuiltTwin` and `CommandSide` make one of any other. `ParametricTwin` says which of its parameters
are free, and holds their present values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.twins.faults import Fault
from retwin.twins.twin import Chunk, Twin, checked_commands, simulate_in_chunks
from retwin.twins.wrapper import TwinWrapper, simulate_chunk

__all__ = [
    "Parameter",
    "ParametricTwin",
    "RebuiltTwin",
    "TakesParameters",
    "values_per_simulation",
]

TRAJECTORIES_PER_CHUNK = 512
"""Trajectories that are handed on at once."""


class TakesParameters(Twin, Protocol):
    """A twin that can be given values of its parameters, one for all trajectories or one each."""

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`; `parameters` by name, each () or (n,)."""
        ...


@dataclass(frozen=True)
class Parameter:
    """One number of a twin that is not known exactly.

    Parameters
    ----------
    name: of the parameter.
    unit: of its values.
    low, high: least and greatest value that is plausible; the prior is uniform between them.
    start: the value before any updating; by default the middle.
    places: what of the twin is set, with the factor that each is times the value; by default the
        twin's own parameter of that name. So one stiffness can stand behind several numbers.

    Raises
    ------
    InputError: bounds that are not finite or out of order, a start outside them.

    """

    name: str
    unit: str
    low: float
    high: float
    start: float | None = None
    places: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        start = (self.low + self.high) / 2 if self.start is None else self.start
        if not (np.isfinite([self.low, self.high]).all() and self.low < self.high):
            raise InputError(
                f"parameter {self.name!r}",
                expected="finite bounds, low below high",
                got=f"low {self.low}, high {self.high}",
                remedy=f"give the plausible range in {self.unit}",
            )
        if not self.low <= start <= self.high:
            raise InputError(
                f"parameter {self.name!r}",
                expected=f"a start from {self.low:g} to {self.high:g} {self.unit}",
                got=f"{start:g}",
                remedy="widen the bounds or leave start out",
            )
        object.__setattr__(self, "start", float(start))
        object.__setattr__(self, "places", dict(self.places or {self.name: 1.0}))


@dataclass(frozen=True)
class ParametricTwin(TwinWrapper):
    """A twin at certain values of its free parameters; satisfies `Twin` as it is.

    Parameters
    ----------
    twin: takes `parameters`.
    parameters: which are free.
    values: one per parameter; by default their starts. Values outside the bounds are allowed here:
        bounds are for updating.
    held: other parameters of the twin inside, and their values.

    Raises
    ------
    InputError: no parameter, a name that repeats, not one finite value per parameter.

    """

    twin: TakesParameters
    parameters: tuple[Parameter, ...]
    values: tuple[float, ...] = ()
    held: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [each.name for each in self.parameters]
        if not names or len(set(names)) != len(names):
            raise InputError(
                "parameters",
                expected="at least one, no name twice",
                got=str(names),
                remedy="give each parameter a name of its own",
            )
        starts = tuple(float(each.start or 0.0) for each in self.parameters)
        values = tuple(map(float, self.values)) or starts
        if len(values) != len(names) or not np.isfinite(values).all():
            raise InputError(
                "values",
                expected=f"{len(names)} finite numbers, one per parameter",
                got=str(values),
                remedy=f"the parameters are {', '.join(names)}",
            )
        object.__setattr__(self, "parameters", tuple(self.parameters))
        object.__setattr__(self, "values", values)

    @classmethod
    def built(
        cls, build: Callable[[Mapping[str, float]], Twin], parameters: Sequence[Parameter]
    ) -> ParametricTwin:
        """Of a function from values by name to a twin; see `RebuiltTwin`."""
        starts = {each.name: float(each.start or 0.0) for each in parameters}
        return cls(RebuiltTwin(build, starts), tuple(parameters))

    @property
    def nominal(self) -> Callable[[NDArray], NDArray] | None:
        """The ideal output for clean commands, where it does not depend on the parameters."""
        return getattr(self.twin, "nominal", None)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(each.name for each in self.parameters)

    @property
    def bounds(self) -> tuple[NDArray, NDArray]:
        """Low and high of every parameter, each (k,)."""
        low, high = zip(*((each.low, each.high) for each in self.parameters), strict=True)
        return np.array(low, dtype=float), np.array(high, dtype=float)

    def with_values(self, values: ArrayLike | Mapping[str, float]) -> ParametricTwin:
        """The same twin at other values: one per parameter (k,), or some of them by name.

        Raises InputError for unknown names and for anything but finite numbers.
        """
        if isinstance(values, Mapping):
            self._check_known(values)
            now = dict(zip(self.names, self.values, strict=True)) | dict(values)
            return replace(self, values=tuple(now[name] for name in self.names))
        return replace(self, values=tuple(np.asarray(values, dtype=float).tolist()))

    def holding(self, *names: str) -> ParametricTwin:
        """The same twin with those parameters held at their present values, no longer free.

        Raises InputError for unknown names, and when none is left free.
        """
        self._check_known(dict.fromkeys(names))
        pairs = list(zip(self.parameters, self.values, strict=True))
        free = [pair for pair in pairs if pair[0].name not in names]
        held = {
            place: factor * value
            for each, value in pairs
            if each.name in names
            for place, factor in each.places.items()
        }
        parameters, values = zip(*free, strict=True) if free else ((), ())
        return ParametricTwin(self.twin, parameters, values, dict(self.held) | held)

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`; `parameters` replace present values, for all (), or each (n,).

        Raises InputError too for parameters that are not free.
        """
        self._check_known(parameters or {})
        now: dict[str, ArrayLike] = dict(zip(self.names, self.values, strict=True))
        now |= parameters or {}
        told: dict[str, ArrayLike] = dict(self.held)
        told |= {
            place: factor * np.asarray(now[each.name], dtype=float)
            for each in self.parameters
            for place, factor in each.places.items()
        }
        return self.twin.simulate(
            commands, faults=faults, seed=seed, progress=progress, parameters=told
        )

    def _check_known(self, names: Mapping[str, Any]) -> None:
        unknown = sorted(set(names) - set(self.names))
        if unknown:
            raise InputError(
                "parameters",
                expected=f"some of {', '.join(self.names)}",
                got=", ".join(map(repr, unknown)),
                remedy="check the spelling, or declare it with a Parameter",
            )


@dataclass(frozen=True)
class RebuiltTwin(TwinWrapper):
    """Takes parameters by being built anew for every value; those that share one go together.

    Parameters
    ----------
    build: from values by name to a twin; channels, rate and limits must not depend on them. Define
        it in a module, so that other processes can import it.
    defaults: values of all parameters.

    """

    build: Callable[[Mapping[str, float]], Twin]
    defaults: Mapping[str, float]

    @cached_property
    def twin(self) -> Twin:
        """The twin at the defaults. Raises InputError when `build` makes no twin."""
        made = self.build(dict(self.defaults))
        if not isinstance(made, Twin):
            raise InputError(
                "build",
                expected="a function that returns a twin",
                got=type(made).__name__,
                remedy="return a FunctionTwin, or any object that satisfies Twin",
            )
        return made

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
        names = tuple(self.defaults)
        values = values_per_simulation(parameters, names, len(commands))
        table = np.stack(
            [values.get(n, np.full(len(commands), self.defaults[n])) for n in names], 1
        )

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            nominal = np.zeros((*chunk.commands.shape[:2], len(self.outputs)))
            observed = np.zeros_like(nominal)
            distinct, group = np.unique(table[chunk.index], axis=0, return_inverse=True)
            for i, theta in enumerate(distinct):
                rows = np.flatnonzero(group.ravel() == i)
                twin = self.build(dict(zip(names, theta.tolist(), strict=True)))
                nominal[rows], observed[rows] = simulate_chunk(twin, chunk, rows, seed=seed)
            return nominal, observed

        return simulate_in_chunks(
            self, run, commands, faults, seed=seed, progress=progress, size=TRAJECTORIES_PER_CHUNK
        )


def values_per_simulation(
    parameters: Mapping[str, ArrayLike] | None, known: Sequence[str], count: int
) -> dict[str, NDArray]:
    """The values of each parameter, (count,).

    Raises InputError for unknown names, and for anything but finite numbers, one for all or each.
    """
    own = {}
    for name, given in (parameters or {}).items():
        array = np.asarray(given)
        numbers = array.dtype.kind in "biuf" and bool(np.isfinite(array).all())
        if name not in known or not numbers or array.shape not in ((), (count,)):
            raise InputError(
                "parameters",
                expected=f"finite numbers for {', '.join(known)}: one for all, or {count}",
                got=f"{name}: {array.dtype} of shape {array.shape}",
                remedy="check the spelling; give as many values as there are trajectories",
            )
        own[name] = np.broadcast_to(array.astype(float), count)
    return own
