"""Simulations of a twin by drawn commands and parameters, from which its equations are learned."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import agree, at_least, require
from retwin.data.trajectories import Channels, Trajectories
from retwin.errors import InputError
from retwin.twins.collected import SimulationError
from retwin.twins.commands.record_sampler import sampler_from
from retwin.twins.commands.samplers import CommandSampler, RecordedSampler
from retwin.twins.twin import Twin, check_channels, checked_commands
from retwin.twins.wrappers.parametric import Parameter, ParametricTwin

MIN_SAMPLES = 20
"""Least number of samples of a simulation: fewer show hardly any memory."""
MAX_SAMPLES = 100_000
"""Number of samples of all simulations together, about; more do not lower the error."""
MIN_SIMULATIONS = 10
"""Least number of simulations to learn from."""
LATER, LARGER = 200, 3.0
"""The sample of a later pulse, and the ratio of effects of the first pulse and this one, from which
the start depends on the first command."""


def drawn_parameters(twin: Twin, spread: float) -> tuple[Parameter, ...]:
    """The free parameters of a twin, with the bounds between which they are drawn."""
    if not isinstance(twin, ParametricTwin):
        return ()
    made = []
    for each, value in zip(twin.parameters, twin.values, strict=True):
        low, high = (value + spread * (end - value) for end in (each.low, each.high))
        made.append(Parameter(each.name, each.unit, min(low, value), max(high, value), value))
    return tuple(made)


def samplers_of(
    twin: Twin, commands: CommandSampler | NDArray, observed: Trajectories | None
) -> tuple[list[CommandSampler], list[NDArray]]:
    """What draws commands for simulations, and the user's own commands, each (n, T, d_u)."""
    samplers: list[CommandSampler] = []
    own: list[NDArray] = []
    if hasattr(commands, "sample"):
        sampler: Any = commands
        remedy = "give both the same rate"
        agree("commands", sampler, twin, "that of the twin", names=("rate",), remedy=remedy)
        samplers.append(sampler)
    else:
        own.append(checked_commands(commands, twin.inputs).astype(np.float64))
    if observed is not None:
        check_channels(twin, observed, "observed")
        at_least("observed", observed.ids, 1, "trajectory", remedy="leave it out if there is none")
        own.append(observed.commands.astype(np.float64))
    for each in own:
        similar = sampler_from(each, twin.rate, limits=getattr(twin, "limits", None))
        duration = min(similar.duration, each.shape[1] / twin.rate)
        samplers += [similar, RecordedSampler(each, twin.rate, duration)]
    return samplers, own


@dataclass(eq=False)
class Simulations:
    """Simulations of a twin by drawn commands and parameters.

    Attributes
    ----------
    twin : Twin
        The twin.
    parameters : sequence of Parameter
        What is drawn.
    samplers : sequence of CommandSampler
        Of equal parts of the commands.
    first : NDArray, optional
        (d_u,), the first command of all simulations, where their starts depend on it.
    seconds : float
        What a simulated sample takes.
    reason : str
        How many have failed.

    """

    twin: Twin
    parameters: Sequence[Parameter]
    samplers: Sequence[CommandSampler]
    first: NDArray | None = None
    seconds: float = field(default=0.0, init=False)
    reason: str = field(default="", init=False)

    def made(self, count: int, rng: np.random.Generator) -> Trajectories:
        """So many simulations, or fewer long ones; their inputs are commands and parameters."""
        longest = max(each.steps for each in self.samplers)
        affordable = max(MIN_SIMULATIONS, MAX_SAMPLES // longest)
        each = -(-min(count, affordable) // len(self.samplers))
        parts = [self._of(sampler, each, rng) for sampler in self.samplers]
        steps = max(part.steps for part in parts)
        return Trajectories.concatenate([part.padded(steps) for part in parts])

    def _of(self, sampler: CommandSampler, count: int, rng: np.random.Generator) -> Trajectories:
        u = sampler.sample(count, rng=rng).astype(np.float64)
        u = beginning_with(self.first, u[:, : MAX_SAMPLES // MIN_SIMULATIONS])
        expected = f"trajectories of {MIN_SAMPLES} samples or more"
        got = u.shape[1]
        remedy = "draw longer ones, in which the twin's memory shows"
        require(u.shape[1] >= MIN_SAMPLES, "commands", expected=expected, got=got, remedy=remedy)
        drawn = {each.name: rng.uniform(each.low, each.high, count) for each in self.parameters}
        options: dict[str, Any] = {"parameters": drawn} if drawn else {}
        began = time.perf_counter()
        try:
            made = self.twin.simulate(u, seed=int(rng.integers(2**31)), **options)
        except SimulationError as error:
            made, self.reason = error.finished, f"of {count} simulations {len(error.failed)} failed"
            # Largest share of the simulations that may fail.
            if len(error.failed) > 0.2 * count:
                expected = "simulations that succeed, of commands and parameters as drawn"
                got = str(error)
                remedy = "narrow the bounds of the parameters, or give a smaller spread"
                raise InputError("twin", expected=expected, got=got, remedy=remedy) from error
        self.seconds = (time.perf_counter() - began) / u[..., 0].size
        rows = made.ids.astype(int)
        held = [np.repeat(each[rows, None, None], u.shape[1], axis=1) for each in drawn.values()]
        names = (f"parameter {name}" for name in drawn)
        units = (each.unit for each in self.parameters)
        inputs = Channels((*made.inputs.names, *names), (*made.inputs.units, *units))
        return made.replace(commands=np.concatenate([made.commands, *held], 2), inputs=inputs)


def beginning_with(first: NDArray | None, commands: NDArray) -> NDArray:
    """Commands (n, T, d_u) with this first sample, if one is given."""
    if first is None:
        return commands
    made = commands.copy()
    made[:, 0] = first
    return made


def first_command(twin: Twin, samplers: Sequence[CommandSampler]) -> NDArray | None:
    """A first command (d_u,) for all simulations, if the start of a twin depends on it.

    A twin may begin in equilibrium with its first command. Then a pulse in the first sample has a
    much larger effect than the same pulse later. None for any other twin.
    """
    drawn = samplers[0].sample(8, rng=np.random.default_rng(0)).astype(np.float64)
    level, other = drawn.mean(axis=(0, 1)), drawn[:, 0].max(axis=0)
    other = np.where(other > level, other, drawn[:, 0].min(axis=0))
    later = min(drawn.shape[1], 2 * LATER) // 2
    u = np.tile(level, (3, 2 * later, 1))
    u[1, 0] = u[2, later] = other
    try:
        made = twin.simulate(u, seed=0).observed.astype(np.float64)
    except SimulationError:
        return None
    at_first, at_later = made[1, :later] - made[0, :later], made[2, later:] - made[0, later:]
    sizes = [np.sqrt(np.sum(each**2, axis=0)) for each in (at_first, at_later)]
    return level if (sizes[0] > LARGER * sizes[1]).any() else None


def check_outputs(training: Trajectories) -> None:
    """Refuse simulations in which an output is constant."""
    spread = np.where(training.mask, training.observed, np.nan)
    fixed = np.nanmax(spread, axis=(0, 1)) == np.nanmin(spread, axis=(0, 1))
    names = [name for name, each in zip(training.outputs.names, fixed, strict=True) if each]
    expected = "outputs that change in its simulations"
    got = f"outputs that do not: {', '.join(names)}"
    remedy = "leave such outputs out, or give commands that excite them"
    require(not names, "twin", expected=expected, got=got, remedy=remedy)
