"""Twins with parameters: names, units and bounds, and one value per simulation (Eq. 2, 3).

A `TakesParameters` is a twin whose `simulate` takes values of its parameters: `MuJoCoTwin` and
`FMUTwin` do, and `RebuiltTwin` and `CommandSide` add them to any other twin. `ParametricTwin`
declares which parameters are free to be updated, and holds their present values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from inspect import signature
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import nothing, require
from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.twin import Twin
from retwin.twins.wrappers.parameter_values import RebuiltTwin
from retwin.twins.wrappers.wrapper import TwinWrapper


class TakesParameters(Twin, Protocol):
    """A twin whose parameters can differ between simulations."""

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
    ) -> Trajectories:
        """Simulate with given values of the parameters.

        Parameters
        ----------
        commands, faults, seed, progress
            See `Twin.simulate`.
        parameters : mapping of str to array_like, optional
            Values by name, each () for all trajectories or (n,); other parameters keep their
            default.

        Returns
        -------
        Trajectories
            See `Twin.simulate`.

        Raises
        ------
        InputError
            As `Twin.simulate`, and for unknown parameters and values that are not finite.

        """


def takes_parameters(twin: Twin) -> bool:
    """Whether the `simulate` of a twin takes values of parameters."""
    accepted = signature(twin.simulate).parameters.values()
    return any(each.name == "parameters" or each.kind == each.VAR_KEYWORD for each in accepted)


@dataclass(frozen=True)
class Parameter:
    """A number of a twin that is not known exactly.

    Parameters
    ----------
    name : str
        Name of the parameter.
    unit : str
        Unit of its values.
    low, high : float
        Lowest and highest plausible value; the prior is uniform between them.
    start : float, optional
        Value before any update, within the bounds; by default their middle.
    places : mapping of str to float, optional
        Parameters of the wrapped twin that are set, each to its factor times the value. So one
        stiffness can determine several numbers. By default the wrapped twin's parameter of the
        same name, with factor 1.

    Raises
    ------
    InputError
        Bounds that are not finite or out of order, or a start outside them.

    """

    name: str
    unit: str
    low: float
    high: float
    start: float | None = None
    places: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        start = (self.low + self.high) / 2 if self.start is None else self.start
        fits = np.isfinite([self.low, self.high]).all() and self.low < self.high
        expected = "finite bounds, low below high"
        got = f"low {self.low}, high {self.high}"
        remedy = f"give the plausible range in {self.unit}"
        require(fits, f"parameter {self.name!r}", expected=expected, got=got, remedy=remedy)
        fits = self.low <= start <= self.high
        expected = f"a start from {self.low:g} to {self.high:g} {self.unit}"
        got = f"{start:g}"
        remedy = "widen the bounds or leave start out"
        require(fits, f"parameter {self.name!r}", expected=expected, got=got, remedy=remedy)
        object.__setattr__(self, "start", float(start))
        object.__setattr__(self, "places", dict(self.places or {self.name: 1.0}))

    def with_start(self, value: float) -> Parameter:
        """The same parameter at another start, by which its bounds are widened if it is outside."""
        return replace(self, start=value, low=min(self.low, value), high=max(self.high, value))


@dataclass(frozen=True)
class ParametricTwin(TwinWrapper):
    """A twin at certain values of its free parameters; it satisfies `Twin`.

    Parameters
    ----------
    twin : TakesParameters
        The wrapped twin.
    parameters : tuple of Parameter
        The k free parameters, one at least.
    values : tuple of float, optional
        One finite value per parameter; by default their starts. The bounds constrain updates, not
        these values.
    held : mapping of str to float, optional
        Values of other parameters of the wrapped twin.

    Raises
    ------
    InputError
        No parameter, a repeated name, or not one finite value per parameter.

    """

    twin: TakesParameters
    parameters: tuple[Parameter, ...]
    values: tuple[float, ...] = ()
    held: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        fits = takes_parameters(self.twin)
        expected = "one whose simulate takes values of its parameters"
        remedy = "give ParametricTwin.built a function from values by name to a twin"
        require(fits, "twin", expected=expected, got=type(self.twin).__name__, remedy=remedy)
        names = [each.name for each in self.parameters]
        fits = 0 < len(names) == len(set(names))
        expected = "at least one, no name twice"
        remedy = "give each parameter a name of its own"
        require(fits, "parameters", expected=expected, got=names, remedy=remedy)
        starts = tuple(float(each.start or 0.0) for each in self.parameters)
        values = tuple(map(float, self.values)) or starts
        fits = len(values) == len(names) and bool(np.isfinite(values).all())
        expected = f"{len(names)} finite numbers, one per parameter"
        remedy = f"the parameters are {', '.join(names)}"
        require(fits, "values", expected=expected, got=values, remedy=remedy)
        object.__setattr__(self, "parameters", tuple(self.parameters))
        object.__setattr__(self, "values", values)

    @classmethod
    def built(
        cls, build: Callable[[Mapping[str, float]], Twin], parameters: Sequence[Parameter]
    ) -> ParametricTwin:
        """Declare the parameters of a function that builds a twin.

        Parameters
        ----------
        build : callable
            From values by name to a twin, see `RebuiltTwin`.
        parameters : sequence of Parameter
            The free parameters.

        Returns
        -------
        ParametricTwin
            The twin at the parameters' starts.

        """
        starts = {each.name: float(each.start or 0.0) for each in parameters}
        return cls(RebuiltTwin(build, starts), tuple(parameters))

    @property
    def nominal(self) -> Callable[[NDArray], NDArray] | None:
        """Ideal output for clean commands; None where it depends on the parameters."""
        return getattr(self.twin, "nominal", None)

    @property
    def deterministic(self) -> bool:
        """Whether the wrapped twin declares that its outputs depend on no seed."""
        return getattr(self.twin, "deterministic", False)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(each.name for each in self.parameters)

    @property
    def bounds(self) -> tuple[NDArray, NDArray]:
        """Lowest and highest value of the free parameters, each (k,)."""
        low, high = zip(*((each.low, each.high) for each in self.parameters), strict=True)
        return np.array(low, dtype=float), np.array(high, dtype=float)

    @property
    def shiftable(self) -> tuple[str, ...]:
        """Parameters of the wrapped twin that can change during a simulation."""
        return getattr(self.twin, "shiftable", ())

    def with_values(self, values: ArrayLike | Mapping[str, float]) -> ParametricTwin:
        """The same twin at other values.

        Parameters
        ----------
        values : array_like, shape (k,), or mapping of str to float
            One per free parameter, or some of them by name.

        Returns
        -------
        ParametricTwin
            The twin at these values.

        Raises
        ------
        InputError
            An unknown name, or anything but finite numbers.

        """
        if isinstance(values, Mapping):
            self._check_known(values)
            now = dict(zip(self.names, self.values, strict=True)) | dict(values)
            return replace(self, values=tuple(now[name] for name in self.names))
        return replace(self, values=tuple(np.asarray(values, dtype=float).tolist()))

    def holding(self, *names: str) -> ParametricTwin:
        """The same twin with some parameters held at their present values.

        Parameters
        ----------
        *names : str
            Free parameters.

        Returns
        -------
        ParametricTwin
            The twin whose free parameters are the others.

        Raises
        ------
        InputError
            An unknown name, or no parameter is left free.

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

    def freed(self, parameters: Sequence[Parameter]) -> ParametricTwin:
        """The same twin with these parameters free, and all others held at their present values.

        Parameters
        ----------
        parameters : sequence of Parameter
            Some of its free parameters, with other ranges and starts, or further parameters of the
            wrapped twin. Of one that is free already, the places are kept.

        Returns
        -------
        ParametricTwin
            The twin at the starts of these parameters.

        """
        declared = {each.name: each.places for each in self.parameters}
        made = [
            replace(each, places=declared.get(each.name, dict(each.places))) for each in parameters
        ]
        now = self.inner(dict(zip(self.names, self.values, strict=True)))
        places = {place for each in made for place in each.places}
        held = {place: float(value) for place, value in now.items() if place not in places}  # type: ignore[arg-type]
        return ParametricTwin(self.twin, tuple(made), (), held)

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
    ) -> Trajectories:
        """See `TakesParameters.simulate`; `parameters` replace present values.

        Raises
        ------
        InputError
            As `TakesParameters.simulate`, and for parameters that are not free.

        """
        self._check_known(parameters or {})
        now: dict[str, ArrayLike] = dict(zip(self.names, self.values, strict=True))
        inner_values = self.inner(now | dict(parameters or {}))
        return self.twin.simulate(
            commands, faults=faults, seed=seed, progress=progress, parameters=inner_values
        )

    def sensitivities(self, commands: NDArray, values: NDArray) -> NDArray | None:
        """Derivatives of the nominal outputs by the free parameters.

        Parameters
        ----------
        commands : ndarray, shape (n, T, d_u)
            Commands.
        values : ndarray, shape (k,)
            The point, in place of the present values.

        Returns
        -------
        ndarray, shape (n, T, d_y, k), or None
            The derivatives, not finite where the simulation diverges; None where the wrapped twin
            has no `sensitivities`, as `StateTwin` has.

        """
        differentiated = getattr(self.twin, "sensitivities", None)
        if differentiated is None:
            return None
        inner = self.inner(dict(zip(self.names, values, strict=True)))
        with np.errstate(invalid="ignore", over="ignore"):
            return differentiated(commands, inner)[1] @ self.mixing

    @property
    def mixing(self) -> NDArray:
        """Derivatives (q, k) of the parameters `names` of a `StateTwin` by the free ones."""
        names: tuple[str, ...] = self.twin.names  # type: ignore[attr-defined]
        made = np.zeros((len(names), len(self.parameters)))
        for column, each in enumerate(self.parameters):
            for place, factor in each.places.items():
                made[names.index(place), column] = factor
        return made

    def inner(self, now: Mapping[str, ArrayLike]) -> dict[str, ArrayLike]:
        """Values of the wrapped twin's parameters, for those of the free ones."""
        values: dict[str, ArrayLike] = dict(self.held)
        return values | {
            place: factor * np.asarray(now[each.name], dtype=float)
            for each in self.parameters
            for place, factor in each.places.items()
        }

    def _check_known(self, names: Mapping[str, Any]) -> None:
        """Refuse names of parameters that are not free."""
        unknown = sorted(set(names) - set(self.names))
        remedy = "check the spelling, or declare it with a Parameter"
        nothing("parameters", unknown, f"some of {', '.join(self.names)}", remedy=remedy)
