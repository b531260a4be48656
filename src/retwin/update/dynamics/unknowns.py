"""What is estimated of state equations: shared parameters, and each trajectory's own start."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from retwin.checks import require
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.wrappers.parametric import Parameter, ParametricTwin
from retwin.update.dynamics.discrepancy.terms import WIDEST

__all__ = ["Unknowns", "coefficients_of", "state_names", "state_twin_of", "unknowns_of"]


@dataclass(frozen=True, eq=False)
class Unknowns:
    """What is estimated: k shared coordinates, and m starts of each trajectory.

    Attributes
    ----------
    names : tuple of str
        Names of the shared coordinates.
    offset, matrix : NDArray
        (q,) and (q, k): the parameters of the twin are offset + matrix @ coordinates.
    mean, deviation : NDArray
        (k,), of the Gaussian prior of the coordinates; infinite deviations for none.
    low, high : NDArray
        (k + m,), bounds of coordinates and starts.
    start : NDArray
        (d_x,), prior mean of the states at the first sample, at which known ones are fixed.
    free : NDArray
        (m,), indices of the states whose start is unknown.
    start_deviation : NDArray
        (m,), prior standard deviations of these.

    """

    names: tuple[str, ...]
    offset: NDArray
    matrix: NDArray
    mean: NDArray
    deviation: NDArray
    low: NDArray
    high: NDArray
    start: NDArray
    free: NDArray
    start_deviation: NDArray

    @property
    def count(self) -> int:
        """The number k of shared coordinates."""
        return len(self.mean)

    def with_coefficients(self, coefficients: Sequence[Parameter]) -> Unknowns:
        """The same and coefficients, further parameters with a normal prior of variance 1."""
        k, extra = self.count, len(coefficients)
        return replace(
            self,
            names=(*self.names, *(each.name for each in coefficients)),
            offset=np.pad(self.offset, (0, extra)),
            matrix=block_diag(self.matrix, np.eye(extra)),
            mean=np.append(self.mean, [float(each.start or 0.0) for each in coefficients]),
            deviation=np.pad(self.deviation, (0, extra), constant_values=1.0),
            low=np.insert(self.low, k, [each.low for each in coefficients]),
            high=np.insert(self.high, k, [each.high for each in coefficients]),
        )

    def only(self, kept: NDArray) -> Unknowns:
        """The same with some of the shared coordinates, the others held at their means."""
        held = np.setdiff1d(np.arange(self.count), kept)
        both = np.append(kept, np.arange(self.count, len(self.low)))
        return replace(
            self,
            names=tuple(self.names[i] for i in kept),
            offset=self.offset + self.matrix[:, held] @ self.mean[held],
            matrix=self.matrix[:, kept],
            mean=self.mean[kept],
            deviation=self.deviation[kept],
            low=self.low[both],
            high=self.high[both],
        )


def state_names(twin: object) -> tuple[str, ...]:
    """Names of the states of a `StateTwin`, or of a `ParametricTwin` of one; none of others."""
    inner = twin.twin if isinstance(twin, ParametricTwin) else twin
    return tuple(each.name for each in inner.states) if isinstance(inner, StateTwin) else ()


def state_twin_of(
    twin: StateTwin | ParametricTwin,
) -> tuple[StateTwin, Sequence[Parameter], dict[str, float]]:
    """The state twin, its free parameters, and the present values of all its parameters."""
    parametric = twin.parametric() if isinstance(twin, StateTwin) and twin.free else twin
    base = parametric.twin if isinstance(parametric, ParametricTwin) else parametric
    expected = "a StateTwin, or a ParametricTwin of one"
    got = type(base).__name__
    remedy = "write the state equations as a StateTwin, or learn them from simulations by "
    remedy += "fit_state_surrogate; other twins have output corrections"
    require(isinstance(base, StateTwin), "twin", expected=expected, got=got, remedy=remedy)
    assert isinstance(base, StateTwin)
    values = dict(zip(base.names, base.values(None, 1)[0].tolist(), strict=True))
    if not isinstance(parametric, ParametricTwin):
        return base, (), values
    now = dict(zip(parametric.names, parametric.values, strict=True))
    values |= {name: float(np.asarray(value)) for name, value in parametric.inner(now).items()}
    starts = tuple(replace(each, start=now[each.name]) for each in parametric.parameters)
    return base, starts, values


def unknowns_of(base: StateTwin, free: Sequence[Parameter], values: dict[str, float]) -> Unknowns:
    """The unknowns of a twin with free parameters, and with present values of all.

    A parameter that is the start of a state is no shared one: each trajectory has its own.
    """
    names = [each.name for each in base.parameters]
    starts = [f"start_{each.name}" for each in base.states]
    bounds = {
        start: (state.low, state.high)
        for start, state in zip(starts, base.states, strict=True)
        if state.low is not None
    }
    shared = []
    for each in free:
        own = [place for place in each.places if place in starts]
        bounds |= dict.fromkeys(own, (each.low, each.high))
        if not own:
            shared.append(each)
    matrix = np.zeros((len(names), len(shared)))
    for column, each in enumerate(shared):
        for place, factor in each.places.items():
            matrix[names.index(place), column] = factor
    offset = np.array([values[name] for name in names])
    offset[(matrix != 0).any(axis=1)] = 0.0
    unknown = [i for i, name in enumerate(starts) if name in bounds]
    ends = np.array([bounds[starts[i]] for i in unknown], dtype=float).reshape(-1, 2)
    limits = np.array([[each.low, each.high] for each in shared]).reshape(-1, 2)
    both = np.concatenate([limits, ends])
    return Unknowns(
        names=tuple(each.name for each in shared),
        offset=offset,
        matrix=matrix,
        mean=np.array([float(each.start or 0.0) for each in shared]),
        deviation=np.full(len(shared), np.inf),
        low=both[:, 0],
        high=both[:, 1],
        start=np.array([values[name] for name in starts]),
        free=np.array(unknown, dtype=int),
        start_deviation=(ends[:, 1] - ends[:, 0]) / 2,
    )


def coefficients_of(names: Iterable[str], values: NDArray) -> list[Parameter]:
    """The free parameters of a model, which have no unit and hardly a bound."""
    return [
        Parameter(name, "1", -WIDEST, WIDEST, value)
        for name, value in zip(names, values.ravel().tolist(), strict=True)
    ]
