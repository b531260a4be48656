"""`Memory`: a hidden state that follows another one slowly, and acts on its equation.

    s' = (x - s) / tau,    x' = f(x, u) + coefficient * (x - s)

Such is a wall that takes up heat, a viscoelastic joint, an adsorbing surface: one relaxation of the
memory that is left where fast or unobserved states are not modelled (Zwanzig, Nonequilibrium
Statistical Mechanics, 2001, chapter 9). The state is m = x - s, with m' = x' - m / tau, which is 0
at the first sample: there the two are in balance, wherever x starts.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.twins.compiled.model import with_parameters
from retwin.twins.equations.state import State
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.wrappers.parametric import Parameter
from retwin.update.dynamics.discrepancy.equations import CorrectedEquations
from retwin.update.dynamics.discrepancy.terms import WIDEST

SHORTEST = 4
"""Shortest time constant that is tried, in samples."""
RATIO = 4.0
"""Ratio of a time constant that is tried to the one before."""


def times_tried(samples: int, rate: float) -> NDArray:
    """Time constants in s up to a record of so many samples."""
    count = int(np.log(max(samples / SHORTEST, 1.0)) / np.log(RATIO)) + 1
    return SHORTEST * RATIO ** np.arange(count) / rate


@dataclass(frozen=True)
class Memory:
    """The memory of one state of corrected equations.

    Attributes
    ----------
    state : str
        The state whose equation has it.
    time : float
        The most probable time constant in s before anything is measured; the standard deviation of
        its logarithm is 1.

    """

    state: str
    time: float

    @property
    def coefficients(self) -> tuple[Parameter, Parameter]:
        """Its weight, and the logarithm of its time constant over `time`."""
        names = f"{self.state}: memory", f"{self.state}: ln(time / {self.time:.4g} s)"
        first, second = (Parameter(each, "1", -WIDEST, WIDEST, 0.0) for each in names)
        return first, second

    def fitted(self, shared: NDArray) -> float:
        """The time constant in s for unknowns (k,) of which it is the last."""
        return self.time * float(np.exp(shared[-1]))

    def values(self, equations: CorrectedEquations, memory: NDArray) -> NDArray:
        """The term of coefficient 1 for values (K,) of the hidden state, relative to the speed."""
        scale = equations.domain.scale[self._index(equations)]
        return np.asarray(memory / scale)

    def speed(self, equations: CorrectedEquations) -> NDArray:
        """(d_x + 1,), see `Domain`; the hidden state changes as fast as the other at most."""
        own = equations.domain.speed
        return np.append(own, own[self._index(equations)])

    def _index(self, equations: CorrectedEquations) -> int:
        return [each.name for each in equations.twin.states].index(self.state)


def with_memories(equations: CorrectedEquations, memories: Sequence[Memory]) -> StateTwin:
    """The corrected equations with memories, whose parameters are the last, two of each.

    A coefficient of 1 is, for a difference of half the state's range, a term as large as the
    root mean square of the state's time derivative.
    """
    twin, domain, more = equations.corrected, equations.domain, len(memories)
    if not memories:
        return twin
    names = [each.name for each in twin.states]
    parts = namedtuple("x", names, rename=True)  # type: ignore[misc]
    own = namedtuple("p", [each.name for each in twin.parameters], rename=True)  # type: ignore[misc]
    function, output = (
        with_parameters(each) for each in (twin.derivative or twin.step, twin.output)
    )
    discrete = twin.step is not None
    places = [names.index(each.state) for each in memories]

    def slope(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        found = list(function(parts(*x[:-more]), u, own(*p[: -2 * more])))
        hidden = []
        for k, (i, memory) in enumerate(zip(places, memories, strict=True)):
            weight, logarithm = p[2 * (k - more)], p[2 * (k - more) + 1]
            found[i] = found[i] + float(domain.speed[i] / domain.scale[i]) * weight * x[k - more]
            decay = torch.exp(-logarithm) / memory.time
            if discrete:
                kept = torch.exp(-decay / twin.rate) * x[k - more]
                hidden.append(found[i] - x[i] + kept)
            else:
                hidden.append(found[i] - decay * x[k - more])
        return *found, *hidden

    taken, hidden = {*names, *twin.inputs.names}, []
    for i in places:
        name = f"memory_{names[i]}"
        while name in taken:
            name += "_"
        taken.add(name)
        hidden.append(State(name, twin.states[i].unit))
    changed = replace(twin, step=slope) if discrete else replace(twin, derivative=slope)
    coefficients = [each for memory in memories for each in memory.coefficients]
    return replace(
        changed,
        states=(*twin.states, *hidden),
        output=lambda x, u, p: output(parts(*x[:-more]), u, own(*p[: -2 * more])),
        parameters=(*twin.parameters, *coefficients),
    )
