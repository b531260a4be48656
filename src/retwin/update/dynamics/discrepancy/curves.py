"""`Curve`: what the discrepancy of a state equation is, over one of its variables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from retwin.checks import one_of
from retwin.twins.equations.state_twin import StateTwin
from retwin.update.dynamics.discrepancy.domain import EXTRAPOLATED, Domain
from retwin.update.dynamics.discrepancy.equations import differentiate, variable_names, variables_of

__all__ = ["Curve", "axes_of", "curve_of"]

POINTS = 121
"""Places at which a curve is evaluated."""


@dataclass(frozen=True, eq=False)
class Curve:
    """The discrepancy of a state equation over one variable, the others at their means.

    Attributes
    ----------
    equation, variable : str
        The state whose equation it is, and the state or command on the axis.
    units : (str, str)
        Of the variable, and of the discrepancy.
    values : NDArray
        (K,), of the variable: over the domain, and a quarter of its width beyond either end.
    discrepancy, deviation : NDArray
        (K,), the most probable one and its posterior standard deviation.
    low, high : float
        Ends of the domain, the range of the variable in calibration.

    """

    equation: str
    variable: str
    units: tuple[str, str]
    values: NDArray
    discrepancy: NDArray
    deviation: NDArray
    low: float
    high: float

    @property
    def inside(self) -> NDArray:
        """Whether each value is in the domain (K,)."""
        return (self.low <= self.values) & (self.values <= self.high)

    def band(self, level: float = 0.9) -> tuple[NDArray, NDArray]:
        """Ends (K,) of the central interval of that probability, at each value by itself."""
        half = ndtri((1 + level) / 2) * self.deviation
        return self.discrepancy - half, self.discrepancy + half


def axes_of(equations: StateTwin, corrected: tuple[str, ...]) -> list[tuple[str, str]]:
    """The corrected equations with each variable on which they depend."""
    states, names = [each.name for each in equations.states], variable_names(equations)
    return [
        (state, names[i])
        for state in corrected
        for i in variables_of(equations, states.index(state))
    ]


def curve_of(
    equations: StateTwin,
    posterior: tuple[NDArray, NDArray],
    domain: Domain,
    corrected: tuple[str, ...],
    axes: tuple[str, str],
    relative_to: Mapping[str, float] | None,
) -> Curve:
    """The curve of corrected equations, see `DynamicsTwin.curve`.

    Parameters
    ----------
    equations, domain, corrected
        See `DynamicsTwin`.
    posterior : tuple of NDArray
        `values` (q,) and `factor` (q, r) of the parameters.
    axes : (str, str)
        Equation and variable.
    relative_to : mapping of str to float, optional
        Parameters of the twin without discrepancy.

    """
    equation, variable = axes
    one_of("equation", equation, corrected)
    one_of("variable", variable, [name for _, name in axes_of(equations, (equation,))])
    states = [each.name for each in equations.states]
    index, place = states.index(equation), variable_names(equations).index(variable)
    parameters = [each.name for each in equations.parameters]
    learned = np.array([n.startswith(tuple(f"{s}: " for s in corrected)) for n in parameters], bool)
    own = [name for name, each in zip(parameters, learned, strict=True) if not each]
    values, factor = posterior
    before = np.where(learned, 0.0, values)
    for name, value in (relative_to or {}).items():
        before[parameters.index(one_of("relative_to", name, own))] = value

    low, high = float(domain.low[place]), float(domain.high[place])
    beyond = EXTRAPOLATED * (high - low)
    grid = np.linspace(low - beyond, high + beyond, POINTS)
    both = np.tile(domain.mean, (POINTS, 1))
    both[:, place] = grid
    x, u = np.split(both, [len(states)], axis=1)
    after, by_all = differentiate(equations, index, (x, u), values)
    uncertain = by_all if relative_to is not None else by_all * learned
    unit = equations.states[index].unit
    return Curve(
        equation,
        variable,
        (
            [*(each.unit for each in equations.states), *equations.inputs.units][place],
            unit if equations.step else f"{unit}/s",
        ),
        grid,
        after - differentiate(equations, index, (x, u), before)[0],
        np.linalg.norm(uncertain @ factor, axis=1),
        low,
        high,
    )
