"""`CorrectedEquations`: a twin's state equations with a discrepancy in some of them.

    x' = f(x, u; theta) + delta(x, u; psi)

The discrepancy of an equation depends on the variables of that equation alone, so that the
structure of the twin, which is known, is kept. An equation without parameters, commands and
nonlinear operations, such as position' = velocity, is a definition, in which there is none.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import one_of, require
from retwin.twins.compiled.program import Node
from retwin.twins.parametric import Parameter
from retwin.twins.state_twin import StateTwin, with_parameters
from retwin.update.dynamics.library import Library, Term

__all__ = ["CorrectedEquations", "Domain"]

EXTRAPOLATED = 0.25
"""How far beyond its range in calibration, in widths of that, a variable of the discrepancy is
extrapolated. From there on it is held, since polynomials diverge."""
LINEAR = {"variable", "constant", "add", "sub", "neg"}
"""Operations of an equation that only defines a state."""
COMPARED = 5000
"""Number of samples at which terms are compared."""
DISTINCT = 1e-5
"""Norm of what a term of norm 1 has beyond others, below which it is a combination of them."""
WIDEST = 1e9
"""Bound of the coefficients of terms, which their prior keeps much smaller."""


@dataclass(frozen=True)
class Domain:
    """The range of states and commands in calibration, by which variables are scaled.

    Attributes
    ----------
    low, high : NDArray
        (d_x + d_u,), of the states and then the commands.
    mean : NDArray
        (d_x + d_u,), their means.
    speed : NDArray
        (d_x,), root mean square of the time derivatives of the states, or of their steps.

    """

    low: NDArray
    high: NDArray
    mean: NDArray
    speed: NDArray

    @classmethod
    def visited(cls, states: NDArray, commands: NDArray, speed: NDArray) -> Domain:
        """The domain of states (n, T, d_x) and commands (n, T, d_u)."""
        both = np.concatenate([states, commands], axis=2)
        low, high, mean = (make(both, axis=(0, 1)) for make in (np.min, np.max, np.mean))
        return cls(low, high, np.clip(mean, low, high), speed)

    @cached_property
    def centre(self) -> NDArray:
        """Centres (d_x + d_u,): 0 where a range lies about it, for terms that are then simpler."""
        middle, half = (self.low + self.high) / 2, (self.high - self.low) / 2
        return np.where(np.abs(middle) < half / 2, 0.0, middle)

    @cached_property
    def scale(self) -> NDArray:
        """Half widths (d_x + d_u,) about the centre; 1 for a constant."""
        half = np.maximum(self.high - self.centre, self.centre - self.low)
        return np.where(half > 0, half, 1.0)

    def scaled(self, variables: Sequence[Any]) -> list[Any]:
        """States and commands, tensors, as variables of the discrepancy."""
        beyond = EXTRAPOLATED * (self.high - self.low)
        ends = (
            (each - self.centre) / self.scale for each in (self.low - beyond, self.high + beyond)
        )
        columns = (self.centre.tolist(), self.scale.tolist(), *(each.tolist() for each in ends))
        return [
            ((each - centre) / scale).clamp(low, high)
            for each, centre, scale, low, high in zip(variables, *columns, strict=True)
        ]

    def excess(self, states: NDArray, commands: NDArray) -> NDArray:
        """How far states (n, T, d_x) and commands (n, T, d_u) leave the domain, in widths of it.

        (d_x + d_u,), the most of all trajectories; those with states that are not finite do not
        count.
        """
        finite = np.isfinite(states).all(axis=(1, 2))
        if not finite.any():
            return np.zeros(len(self.low))
        both = np.concatenate([states[finite], commands[finite]], axis=2)
        width = np.where(self.high > self.low, self.high - self.low, self.scale)
        beyond = np.maximum(both.max(axis=(0, 1)) - self.high, self.low - both.min(axis=(0, 1)))
        made: NDArray = np.maximum(beyond, 0.0) / width
        return made


@dataclass(frozen=True, eq=False)
class CorrectedEquations:
    """A twin with a discrepancy in some of its state equations.

    Attributes
    ----------
    twin : StateTwin
        The twin whose equations are corrected.
    library : Library
        Forms of the discrepancy.
    domain : Domain
        Scales of the variables.
    states : tuple of str
        The states whose equations are corrected.
    dropped : frozenset of str
        Names of coefficients that are left out.

    """

    twin: StateTwin
    library: Library
    domain: Domain
    states: tuple[str, ...]
    dropped: frozenset[str] = frozenset()

    @classmethod
    def distinct(
        cls,
        twin: StateTwin,
        library: Library,
        states: tuple[str, ...],
        visited: tuple[NDArray, NDArray],
        free: NDArray,
    ) -> CorrectedEquations:
        """The equations without the terms that are combinations of others or of theta's effects.

        Such a term would take from theta what theta explains, and neither could be identified.

        Parameters
        ----------
        twin, library, states
            See the attributes.
        visited : tuple of NDArray
            States (n, T, d_x) and commands (n, T, d_u) of the calibration record.
        free : NDArray
            (q, k), by which the parameters of the twin depend on the free ones.

        """
        x, u = visited
        steps = np.diff(x, axis=1) * (1.0 if twin.step else twin.rate)
        speed = np.sqrt(np.mean(steps**2, axis=(0, 1)))
        domain = Domain.visited(x, u, np.where(speed > 0, speed, 1.0))
        whole = cls(twin, library, domain, states)
        x, u = (each.reshape(-1, each.shape[2]) for each in visited)
        some = np.linspace(0, len(x) - 1, min(len(x), COMPARED)).astype(int)
        columns = whole.values(x[some], u[some])
        dropped, first = set(), 0
        for i, _, terms in whole.equations:
            own = columns[:, first : first + len(terms)]
            basis = np.linalg.qr(_scaled(_by_parameters(twin, i, x[some], u[some]) @ free))[0]
            for column, term in zip(_scaled(own).T, terms, strict=True):
                rest = column - basis @ (basis.T @ column)
                rest -= basis @ (basis.T @ rest)
                size = np.linalg.norm(rest)
                if size < DISTINCT:
                    dropped.add(f"{twin.states[i].name}: {term.name}")
                else:
                    basis = np.column_stack([basis, rest / size])
            first += len(terms)
        return replace(whole, dropped=frozenset(dropped))

    @cached_property
    def equations(self) -> list[tuple[int, list[int], list[Term]]]:
        """Per corrected state: its index, indices of its variables, and its terms."""
        names = [each.name for each in self.twin.states]
        # A command may have the name of a state.
        commands = [f"command {each}" if each in names else each for each in self.twin.inputs.names]
        made = []
        for state in self.states:
            i = names.index(state)
            used = variables_of(self.twin, i)
            places = sorted({i, *used})
            own = [[*names, *commands][place] for place in places]
            count = sum(place < len(names) for place in places)
            terms = [
                term
                for term in self.library.terms(own, count)
                if f"{state}: {term.name}" not in self.dropped
            ]
            made.append((i, places, terms))
        return made

    @property
    def names(self) -> list[str]:
        """Names of the coefficients psi: the state and the term."""
        return [
            f"{self.twin.states[i].name}: {term.name}"
            for i, _, terms in self.equations
            for term in terms
        ]

    @cached_property
    def corrected(self) -> StateTwin:
        """The twin with the coefficients psi as further parameters, 0 by default.

        A coefficient of 1 is a term that at the edge of the domain is as large as the root mean
        square of the state's time derivative.
        """
        twin, own = self.twin, len(self.twin.parameters)
        named = namedtuple("p", [each.name for each in twin.parameters], rename=True)  # type: ignore[misc]
        function, output = (
            with_parameters(each) for each in (twin.derivative or twin.step, twin.output)
        )

        def corrected(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
            variables = self.domain.scaled([*x, *u])
            slope = list(function(x, u, named(*p[:own])))
            coefficients = iter(p[own:])
            for i, places, terms in self.equations:
                v = [variables[j] for j in places]
                total = sum(next(coefficients) * term.value(v) for term in terms)
                slope[i] = slope[i] + float(self.domain.speed[i]) * total
            return tuple(slope)

        extra = (Parameter(name, "1", -WIDEST, WIDEST, 0.0) for name in self.names)
        own_equations = (
            replace(twin, step=corrected) if twin.step else replace(twin, derivative=corrected)
        )
        return replace(
            own_equations,
            output=lambda x, u, p: output(x, u, named(*p[:own])),
            parameters=(*twin.parameters, *extra),
        )

    def values(self, states: NDArray, commands: NDArray) -> NDArray:
        """The values (K, k) of all terms at states (K, d_x) and commands (K, d_u)."""
        import torch

        both = torch.as_tensor(np.concatenate([states, commands], axis=1))
        scaled = self.domain.scaled(both.unbind(1))
        columns = [
            term.value([scaled[j] for j in places]) * torch.ones_like(scaled[0])
            for _, places, terms in self.equations
            for term in terms
        ]
        return torch.stack(columns, 1).numpy() if columns else np.zeros((len(states), 0))


def _by_parameters(twin: StateTwin, equation: int, states: NDArray, commands: NDArray) -> NDArray:
    """Derivatives (K, q) of a state equation by the twin's parameters, at its present values."""
    import torch

    x, u = (list(torch.tensor(each).unbind(1)) for each in (states, commands))
    if not twin.parameters:
        return np.zeros((len(states), 0))
    values = twin.values(None, 1)[0, : len(twin.parameters)].tolist()
    p = [torch.full_like(x[0], value, requires_grad=True) for value in values]
    slope = twin.model.evaluate("slope", x, u, p)[equation]
    if not slope.requires_grad:
        return np.zeros((len(states), len(p)))
    found = torch.autograd.grad(slope.sum(), p, allow_unused=True)
    zero = torch.zeros_like(x[0])
    made: NDArray = torch.stack([zero if each is None else each for each in found], 1).numpy()
    return made


def _scaled(columns: NDArray) -> NDArray:
    """Columns of norm 1, without those that are 0."""
    size = np.linalg.norm(columns, axis=0)
    made: NDArray = np.divide(columns, size, out=np.zeros_like(columns), where=size > 0)
    return made


def variables_of(twin: StateTwin, equation: int) -> list[int]:
    """Indices of the states, and then the commands, on which a state equation depends."""
    used = {node.index for node in _nodes(twin, equation)}
    both = (*twin.model.variables["x"], *twin.model.variables["u"])
    return [i for i, node in enumerate(both) if node.index in used]


def correctable(twin: StateTwin, wanted: Sequence[str]) -> tuple[str, ...]:
    """The states whose equations are corrected: `wanted`, or all whose equation is no definition.

    Raises
    ------
    InputError
        An unknown state, or no equation that could be wrong.

    """
    names = tuple(each.name for each in twin.states)
    for name in wanted:
        one_of("states", name, names)
    found = tuple(wanted) or tuple(
        name for i, name in enumerate(names) if not _is_definition(twin, i)
    )
    require(
        found,
        "states",
        expected="a state equation that can be wrong",
        got="equations without parameters and commands",
        remedy="name the states whose equations are to be corrected",
    )
    return found


def _is_definition(twin: StateTwin, equation: int) -> bool:
    known = {node.index for letter in "up" for node in twin.model.variables[letter]}
    return all(node.op in LINEAR and node.index not in known for node in _nodes(twin, equation))


def _nodes(twin: StateTwin, equation: int) -> list[Node]:
    return twin.model.program.needed([twin.model.slope[equation]])
