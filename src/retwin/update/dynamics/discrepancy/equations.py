"""`CorrectedEquations`: a twin's state equations with a discrepancy in some of them.

    x' = f(x, u; theta) + delta(x, u; psi)

The discrepancy of an equation depends on the variables of that equation alone, so that the
structure of the twin, which is known, is kept, unless the equations are opened. An equation without
parameters, commands and nonlinear operations, such as position' = velocity, is a definition, in
which there is none.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import one_of, require
from retwin.twins.compiled.model import with_parameters
from retwin.twins.compiled.program import Node
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.wrappers.parametric import Parameter
from retwin.update.dynamics.discrepancy.domain import Domain
from retwin.update.dynamics.discrepancy.library import Library
from retwin.update.dynamics.discrepancy.network import TanhNetwork
from retwin.update.dynamics.discrepancy.terms import Term
from retwin.update.dynamics.settings import Dynamics

__all__ = ["CorrectedEquations", "correctable", "differentiate", "variable_names", "variables_of"]

LINEAR = {"variable", "constant", "add", "sub", "neg"}
"""Operations of an equation that only defines a state."""
DISTINCT = 1e-5
"""Norm of what a term of norm 1 has beyond others, below which it is a combination of them."""
ABSORBED = 1e-3
"""Standard deviation of what a discrepancy has in common with the effects of parameters, in the
root mean square of the states' time derivatives: so small that it is theirs."""
SHARED = 1.0
"""The same for equations with a known sign, whose discrepancy may be impossible without any: as
much as a coefficient's."""


@dataclass(frozen=True, eq=False)
class Equation:
    """A corrected state equation.

    Attributes
    ----------
    index : int
        The index of its state.
    places : sequence of int
        Indices of the variables of its discrepancy among the states, the commands, and the time
        derivatives that the twin gives.
    terms : sequence of Term
        The terms of its discrepancy.
    zero : float, optional
        The scaled state where it is 0, for a passive equation: terms are 0 there.
    common : float
        Standard deviation of what the discrepancy has in common with the effects of parameters:
        `ABSORBED`, or `SHARED` with a known sign, since passive friction always has some damping.

    """

    index: int
    places: Sequence[int]
    terms: Sequence[Term]
    zero: float | None
    common: float

    def values(self, variables: Sequence[Any], inner: Sequence[Sequence[Any]]) -> list[Any]:
        """The values of the terms at all scaled variables, with the inner coefficients of each."""
        import torch

        v = [variables[place] for place in self.places]
        made = [term.value(v, *own) for term, own in zip(self.terms, inner, strict=True)]
        if self.zero is None:
            return made
        v[self.places.index(self.index)] = torch.tensor(self.zero, dtype=torch.float64)
        at_rest = [term.value(v, *own) for term, own in zip(self.terms, inner, strict=True)]
        return [one - other for one, other in zip(made, at_rest, strict=True)]


@dataclass(frozen=True, eq=False)
class CorrectedEquations:
    """A twin with a discrepancy in some of its state equations.

    The coefficients psi are, term by term, its weight and then its inner coefficients.

    Attributes
    ----------
    twin : StateTwin
        The twin whose equations are corrected.
    form : Library or TanhNetwork
        The form of the discrepancy.
    settings : Dynamics
        What is known of it.
    domain : Domain
        Scales of the variables.
    visited : tuple of NDArray
        States (K, d_x) and commands (K, d_u) of the calibration record, some of the samples.
    free : NDArray
        (q, k), by which the parameters of the twin depend on the free ones.
    dropped : frozenset of str
        Names of terms that are left out.
    opened : bool
        Whether each equation may depend on all states and commands.

    """

    twin: StateTwin
    form: Library | TanhNetwork
    settings: Dynamics
    domain: Domain
    visited: tuple[NDArray, NDArray]
    free: NDArray
    dropped: frozenset[str] = frozenset()
    opened: bool = False

    @classmethod
    def distinct(
        cls,
        twin: StateTwin,
        form: Library | TanhNetwork,
        settings: Dynamics,
        visited: tuple[NDArray, NDArray],
        free: NDArray,
        *,
        opened: bool = False,
    ) -> CorrectedEquations:
        """The equations without the terms that are combinations of others or of theta's effects.

        Such a term would take from theta what theta explains, and neither could be identified.

        Parameters
        ----------
        twin, form, settings, free, opened
            See the attributes.
        visited : tuple of NDArray
            States (n, T, d_x) and commands (n, T, d_u) of the calibration record.

        """
        x, u = visited
        steps = np.diff(x, axis=1) * (1.0 if twin.step else twin.rate)
        speed = np.sqrt(np.mean(steps**2, axis=(0, 1)))
        domain = Domain.visited(x, u, np.where(speed > 0, speed, 1.0))
        x, u = _some(*visited)
        whole = cls(twin, form, settings, domain, (x, u), free, opened=opened)
        columns = whole.values(x, u)
        dropped, first = set(), 0
        for equation in whole.equations:
            i, terms = equation.index, equation.terms
            own = columns[:, first : first + len(terms)]
            basis = np.linalg.qr(_scaled(differentiate(twin, i, (x, u))[1] @ free))[0]
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

    def alike(self, other: CorrectedEquations) -> bool:
        """Whether the discrepancy of other equations has the same form."""
        return (self.form, self.opened) == (other.form, other.opened)

    def visiting(self, states: NDArray, commands: NDArray) -> CorrectedEquations:
        """The same with other states (n, T, d_x) and commands (n, T, d_u) that are visited."""
        return replace(self, visited=_some(states, commands))

    @cached_property
    def equations(self) -> list[Equation]:
        """The corrected state equations."""
        import torch

        twin, settings = self.twin, self.settings
        names, everything = [each.name for each in twin.states], variable_names(twin)
        for setting in ("depends", "monotone", "passive"):
            for state in getattr(settings, setting):
                one_of(setting, state, self.states)
        rest = self.domain.scaled(torch.zeros(len(everything), dtype=torch.float64).unbind())
        made = []
        for state in self.states:
            i = names.index(state)
            given = settings.depends.get(state)
            for name in given or ():
                one_of("depends", name, everything)
            used = [everything.index(each) for each in given] if given else variables_of(twin, i)
            used = list(range(len(everything))) if self.opened else used
            places = sorted({*used} if given else {i, *used})
            own = [everything[place] for place in places]
            signs = settings.signs(state, own)
            zeros = [float(rest[place]) for place in places]
            count = sum(place < len(names) for place in places)
            terms = list(self.form.terms(own, count, signs, zeros))
            known = given or any(signs) or state in settings.passive or twin.learned
            if not (known or self.opened or _is_rate(twin, i)) and isinstance(self.form, Library):
                terms += self.form.dead_zone(f"{state}'", len(own))
                places.append(len(everything) + i)
            terms = [each for each in terms if f"{state}: {each.name}" not in self.dropped]
            zero = float(rest[i]) if state in settings.passive else None
            common = SHARED if any(signs) else ABSORBED
            made.append(Equation(i, places, terms, zero, common))
        return made

    @cached_property
    def states(self) -> tuple[str, ...]:
        """The states whose equations are corrected."""
        return correctable(self.twin, self.settings.states)

    @cached_property
    def coefficients(self) -> list[Parameter]:
        """The coefficients psi, named by the state and the term; their starts are prior means."""
        return [
            replace(each, name=f"{self.twin.states[equation.index].name}: {each.name}")
            for equation in self.equations
            for term in equation.terms
            for each in (term.weight, *term.inner)
        ]

    @cached_property
    def corrected(self) -> StateTwin:
        """The twin with the coefficients psi as further parameters, with which delta is 0.

        A weight of 1 is a term that, where it is 1, is as large as the root mean square of the
        state's time derivative.
        """
        twin, own = self.twin, len(self.twin.parameters)
        named = namedtuple("p", [each.name for each in twin.parameters], rename=True)  # type: ignore[misc]
        function, output = (
            with_parameters(each) for each in (twin.derivative or twin.step, twin.output)
        )

        def corrected(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
            returned = function(x, u, named(*p[:own]))
            slope = [returned] if getattr(returned, "ndim", 1) == 0 else list(returned)
            variables = [*self.domain.scaled([*x, *u]), *self._rates(x, slope)]
            found = self.discrepancies(variables, p[own:])
            for equation, each in zip(self.equations, found, strict=True):
                i = equation.index
                slope[i] = slope[i] + float(self.domain.speed[i]) * each
            return tuple(slope)

        own_equations = (
            replace(twin, step=corrected) if twin.step else replace(twin, derivative=corrected)
        )
        return replace(
            own_equations,
            output=lambda x, u, p: output(x, u, named(*p[:own])),
            parameters=(*twin.parameters, *self.coefficients),
        )

    def discrepancies(self, variables: Sequence[Any], coefficients: Sequence[Any]) -> list[Any]:
        """Per equation, the discrepancy over the speed of its state, at its variables."""
        made = []
        for equation, weights, inner in self._split(coefficients):
            values = equation.values(variables, inner)
            made.append(sum(own * each for own, each in zip(weights, values, strict=True)))
        return made

    def values(
        self, states: NDArray, commands: NDArray, coefficients: NDArray | None = None
    ) -> NDArray:
        """The values (K, k) of all terms at states (K, d_x) and commands (K, d_u).

        `coefficients` are those of psi, by default the starts; weights do not matter.
        """
        scaled = self._scaled(states, commands)
        starts = [each.start for each in self.coefficients]
        columns = []
        for equation, _, inner in self._split(starts if coefficients is None else coefficients):
            columns += equation.values(scaled, inner)
        zero = 0.0 * scaled[0]
        made: NDArray = np.stack([(zero + each).numpy() for each in columns] or [[]] * len(zero), 1)
        return made.reshape(len(zero), -1)

    def _split(self, coefficients: Iterable[Any]) -> Iterator[tuple[Equation, list, list[list]]]:
        """Per equation, the weights of its terms, and the inner coefficients of each."""
        left = iter(coefficients)
        for equation in self.equations:
            parts = [(next(left), [next(left) for _ in term.inner]) for term in equation.terms]
            yield equation, [weight for weight, _ in parts], [inner for _, inner in parts]

    @property
    def weights(self) -> NDArray:
        """The places (t,) of the weights among the coefficients."""
        found = self._split(range(len(self.coefficients)))
        return np.array([each for _, own, _ in found for each in own], dtype=int)

    def absorbed(self, coefficients: NDArray) -> tuple[NDArray, NDArray]:
        """What the parameters could explain of the discrepancy, (r,), and its derivatives (r, k).

        It is the component of each discrepancy in the span of the effects of the parameters on all
        state equations, over the visited states, in the standard deviation that it may have.
        Nothing (0,) for a library over the states of a model, whose terms have a meaning of their
        own. Those over learned states have none: together they imitate the parameters' effects.
        """
        import torch

        named = isinstance(self.form, Library) and not self.twin.learned
        if named or not self._effects.size:
            return np.zeros(0), np.zeros((0, len(coefficients)))
        psi = torch.tensor(coefficients, requires_grad=True)
        scaled, basis = self._scaled(*self.visited), torch.tensor(self._effects)
        found = self.discrepancies(scaled, psi.unbind())
        groups: dict[float, Any] = {}
        for own, each in zip(self.equations, found, strict=True):
            part = basis[:, own.index] @ (0.0 * scaled[0] + each) / len(scaled[0]) ** 0.5
            groups[own.common] = groups.get(own.common, 0.0) + part / own.common
        errors = torch.cat(list(groups.values()))
        slope = [torch.autograd.grad(each, psi, retain_graph=True)[0] for each in errors.unbind()]
        return errors.detach().numpy(), torch.stack(slope).numpy()

    @cached_property
    def _effects(self) -> NDArray:
        """An orthonormal basis (r, d_x, K) of the effects of the free parameters."""
        count = len(self.twin.states)
        by_all = [differentiate(self.twin, i, self.visited)[1] @ self.free for i in range(count)]
        columns = np.stack(by_all) / self.domain.speed[:, None, None]
        if not columns.shape[2]:
            return np.zeros((0, *columns.shape[:2]))
        basis, size, _ = np.linalg.svd(_scaled(columns.reshape(-1, columns.shape[2])), False)
        return basis[:, size > DISTINCT].T.reshape(-1, count, len(self.visited[0]))

    def _scaled(self, states: NDArray, commands: NDArray) -> list[Any]:
        """The scaled variables of all equations, see `Equation.places`."""
        import torch

        x, u = (list(torch.as_tensor(each).unbind(1)) for each in (states, commands))
        values = self.twin.values(None, 1)[0, : len(self.twin.parameters)]
        p = [torch.full_like(x[0], each) for each in values.tolist()]
        slope = self.twin.model.evaluate("slope", x, u, p)
        return [*self.domain.scaled([*x, *u]), *self._rates(x, slope)]

    def _rates(self, x: Sequence[Any], slope: Sequence[Any]) -> list[Any]:
        """Time derivatives that the twin gives, over the speeds of the states."""
        steps = [b - a for a, b in zip(x, slope, strict=True)] if self.twin.step else slope
        return [each / float(own) for each, own in zip(steps, self.domain.speed, strict=True)]


def _some(states: NDArray, commands: NDArray) -> tuple[NDArray, NDArray]:
    """At most so many samples (K, d_x) and (K, d_u) of states and commands."""
    x, u = (each.reshape(np.prod(each.shape[:2]), each.shape[2]) for each in (states, commands))
    # Number of samples at which terms are compared.
    some = np.linspace(0, len(x) - 1, min(len(x), 5000)).astype(int)
    return x[some], u[some]


def differentiate(
    twin: StateTwin, equation: int, visited: tuple[NDArray, NDArray], values: NDArray | None = None
) -> tuple[NDArray, NDArray]:
    """A state equation (K,) and its derivatives (K, q) by the twin's parameters.

    Parameters
    ----------
    twin : StateTwin
        The twin.
    equation : int
        The index of the state.
    visited : tuple of NDArray
        States (K, d_x) and commands (K, d_u) where it is evaluated.
    values : NDArray, optional
        (q,), of the parameters, by default the present ones.

    """
    import torch

    x, u = (list(torch.tensor(each).unbind(1)) for each in visited)
    if values is None:
        values = twin.values(None, 1)[0, : len(twin.parameters)]
    zero = torch.zeros_like(x[0])
    p = [torch.full_like(zero, value, requires_grad=True) for value in values.tolist()]
    slope = twin.model.evaluate("slope", x, u, p)[equation]
    if not slope.requires_grad:
        return slope.numpy(), np.zeros((len(zero), len(p)))
    found = torch.autograd.grad(slope.sum(), p, allow_unused=True)
    by_all = torch.stack([zero if each is None else each for each in found], 1).numpy()
    return slope.detach().numpy(), by_all


def _scaled(columns: NDArray) -> NDArray:
    """Columns of norm 1, without those that are 0."""
    size = np.linalg.norm(columns, axis=0)
    return np.divide(columns, size, out=np.zeros_like(columns), where=size > 0)


def variable_names(twin: StateTwin) -> list[str]:
    """Names of the states and then of the commands; a command may have the name of a state."""
    names = [each.name for each in twin.states]
    return [*names, *(f"command {u}" if u in names else u for u in twin.inputs.names)]


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
    got = "equations without parameters and commands"
    remedy = "name the states whose equations are to be corrected"
    require(found, "states", expected="a state equation that can be wrong", got=got, remedy=remedy)
    return found


def _is_definition(twin: StateTwin, equation: int) -> bool:
    known = {node.index for letter in "up" for node in twin.model.variables[letter]}
    return all(node.op in LINEAR and node.index not in known for node in _nodes(twin, equation))


def _is_rate(twin: StateTwin, equation: int) -> bool:
    """Whether a state is the time derivative of another one, as a velocity is."""
    others = (i for i in range(len(twin.states)) if i != equation and _is_definition(twin, i))
    return any(equation in variables_of(twin, i) for i in others)


def _nodes(twin: StateTwin, equation: int) -> list[Node]:
    return twin.model.program.needed([twin.model.slope[equation]])
