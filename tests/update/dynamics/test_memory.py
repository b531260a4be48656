"""The memory of a state: a wall that takes up heat, which the twin does not have."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

import retwin as rt
from retwin.twins import Parameter, State, StateTwin
from retwin.update import Dynamics, FittedDynamics, Library, fit_dynamics
from retwin.update.dynamics.discrepancy.equations import CorrectedEquations
from retwin.update.dynamics.discrepancy.memory import Memory, with_memories

RATE = 0.1
SLOW = 600.0
"""Time constant of the wall in s."""
EXCHANGE = 0.008
"""By how much the wall changes the air, in 1/s."""
CONSTANT = Dynamics(Library(0, (), False))


def air(x, u, p):
    return (0.02 * u.heater - p.loss * x.air,)


def room(step: bool = False) -> StateTwin:
    """A heated room, by its derivative or by its exact step."""

    def sampled(x, u, p):
        return (x.air + (0.02 * u.heater - p.loss * x.air) / RATE,)

    return StateTwin(
        (State("air", "K"),),
        lambda x, u: x.air,
        rt.Channels(("heater",), ("1",)),
        rt.Channels(("air",), ("K",)),
        RATE,
        **({"step": sampled} if step else {"derivative": air}),
        parameters=(Parameter("loss", "1/s", 1e-4, 0.02, 2e-3),),
    )


def with_wall() -> StateTwin:
    def derivative(x, u, p):
        return air(x, u, p)[0] - EXCHANGE * (x.air - x.wall), (x.air - x.wall) / SLOW

    return replace(room(), states=(State("air", "K"), State("wall", "K")), derivative=derivative)


def record(real: StateTwin, seed: int = 0) -> rt.Trajectories:
    rng = np.random.default_rng(seed)
    levels = rng.uniform(0, 10, size=(2, 12, 1))
    levels[:, 4:6, 0] = 0.0, 10.0
    commands = np.repeat(levels, 60, axis=1)
    made = real.simulate(commands, seed=0)
    noise = 0.02 * rng.normal(size=made.observed.shape)
    return made.replace(nominal=made.observed, observed=made.observed + noise)


@pytest.fixture(scope="module")
def fitted() -> FittedDynamics:
    return fit_dynamics(room(), record(with_wall()), CONSTANT)


def test_a_wall_is_found_with_its_time_constant_and_its_heat(fitted: FittedDynamics) -> None:
    equations = fitted.twin.equations
    values = dict(zip(equations.names, fitted.twin.values, strict=True))
    assert [each.name for each in equations.states] == ["air", "memory_air"]
    (ratio,) = (name for name in values if name.startswith("air: ln"))
    time = float(ratio.split("/")[1].split()[0]) * np.exp(values[ratio])
    assert time == pytest.approx(SLOW, rel=0.03)
    assert fitted.parameters["loss"] == pytest.approx(2e-3, rel=0.03)
    assert abs(fitted.parameters["loss"] - 2e-3) < 4 * fitted.errors["loss"]
    assert f"air: memory over {time:.3g} s" in fitted.terms


def test_it_predicts_records_that_it_has_not_seen(fitted: FittedDynamics) -> None:
    unseen = record(with_wall(), seed=5)

    def error(of: FittedDynamics) -> float:
        made = of.twin.simulate(unseen.commands, seed=0).nominal
        return float(np.sqrt(np.mean((made - unseen.nominal) ** 2)))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        without = fit_dynamics(room(), record(with_wall()), replace(CONSTANT, memory=False))
        assert error(fitted) < 0.02
        assert error(without) > 10 * error(fitted)
        assert fitted.twin.predictive(unseen).coverage()[0] == pytest.approx(0.9, abs=0.05)


def test_a_twin_that_lacks_nothing_gets_no_memory() -> None:
    found = fit_dynamics(room(), record(room()), CONSTANT)
    assert [each.name for each in found.twin.equations.states] == ["air"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["derivative", "step"])
def test_memories_without_weight_do_not_act_on_each_other(kind: str) -> None:
    """Their effects on the outputs are those that each has alone."""

    def slope(x, u, p):
        own = 0.02 * u.heater - p.loss * x.air, 0.01 * (x.air - x.wall)
        return own if kind == "derivative" else (x.air + 5 * own[0], x.wall + 5 * own[1])

    twin = replace(
        room(),
        states=(State("air", "K"), State("wall", "K", 1.0)),
        output=lambda x, u: x.air + x.wall**2,
        **{"derivative": None, "step": None, kind: slope},
    )
    commands = record(room()).commands.astype(float)
    known = Dynamics(Library(1, (), False), states=("air", "wall"))
    visited = (twin.hidden(commands), commands)
    equations = CorrectedEquations.distinct(twin, known.library, known, visited, np.eye(1))
    both = [Memory("air", 300.0), Memory("wall", 900.0)]

    def effects(memories: list[Memory], shift: float) -> np.ndarray:
        """Of the weights, (n, T, 1, M), for time constants that differ by a factor."""
        made = with_memories(equations, memories)
        values = {each.coefficients[1].name: shift for each in memories}
        slopes = made.sensitivities(commands, values)[1]
        return slopes[..., [made.names.index(each.coefficients[0].name) for each in memories]]

    for shift in (0.0, 1.5):
        together = effects(both, shift)
        assert np.abs(together).max() > 0
        for i, memory in enumerate(both):
            np.testing.assert_allclose(together[..., [i]], effects([memory], shift), rtol=1e-9)
            moved = replace(memory, time=memory.time * np.exp(shift))
            np.testing.assert_allclose(together[..., [i]], effects([moved], 0.0), rtol=1e-9)


def test_a_twin_by_steps_gets_the_same_memory(fitted: FittedDynamics) -> None:
    found = fit_dynamics(room(step=True), record(with_wall()), CONSTANT)
    unseen = record(with_wall(), seed=5).commands
    both = [each.twin.simulate(unseen, seed=0).nominal for each in (found, fitted)]
    assert np.abs(both[0] - both[1]).max() < 0.02 * np.ptp(both[1])


def test_saved_and_loaded_it_is_the_same(fitted: FittedDynamics, tmp_path) -> None:
    fitted.twin.save(tmp_path / "model")
    again = rt.update.DynamicsTwin.load(tmp_path / "model")
    commands = record(room(), seed=3).commands
    both = [each.simulate(commands, seed=1).observed for each in (again, fitted.twin)]
    np.testing.assert_array_equal(*both)
