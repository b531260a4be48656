"""Process noise in proportion to the change of a state."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

import retwin as rt
from retwin.twins import Parameter, State, StateTwin
from retwin.update import Dynamics, DynamicsTwin, Library, fit_dynamics
from retwin.update.dynamics.filter.noise import fit_noise, folds
from retwin.update.dynamics.filter.noise_search import Search
from retwin.update.dynamics.filter.online import OnlineFilter

LAG = StateTwin(
    (State("x", "m"),),
    lambda x, u: x.x,
    rt.Channels(("u",), ("V",)),
    rt.Channels(("y",), ("m",)),
    20.0,
    derivative=lambda x, u, p: (u.u - p.rate * x.x,),
    parameters=(Parameter("rate", "1/s", 0.1, 20.0, 3.0),),
)
CONSTANT, PROPORTIONAL, MEASURED = 1e-3, 0.3, 1e-3
"""Standard deviations."""


def record(proportional: float, count: int = 4, seed: int = 0) -> rt.Trajectories:
    """A switched lag, whose noise after a switch is as large as its change."""
    rng = np.random.default_rng(seed)
    commands = np.repeat(rng.integers(2, size=(count, 10, 1)), 40, axis=1).astype(float)
    theta = np.tile([3.0, 0.0], (count, 1))
    change = np.diff(LAG.steps().run(commands, theta)[1], axis=1, append=0.0)
    kicks = np.sqrt(CONSTANT**2 + (proportional * change) ** 2) * rng.normal(size=change.shape)
    outputs = LAG.steps().run(commands, theta, kicks)[0]
    made = LAG.simulate(commands, seed=0)
    return made.replace(observed=outputs + MEASURED * rng.normal(size=outputs.shape))


@pytest.fixture(scope="module")
def twin() -> DynamicsTwin:
    return fit_dynamics(
        LAG, record(PROPORTIONAL), Dynamics(Library(0, (), False), memory=False)
    ).twin


def test_it_is_separated_from_constant_noise(twin: DynamicsTwin) -> None:
    assert np.sqrt(twin.proportional) == pytest.approx([PROPORTIONAL], rel=0.15)
    assert np.sqrt(twin.process) == pytest.approx([CONSTANT], rel=0.4)
    assert np.sqrt(twin.noise) == pytest.approx([MEASURED], rel=0.3)


def test_it_is_left_out_where_noise_is_constant(twin: DynamicsTwin) -> None:
    constant = record(0.0, seed=1)
    parts = folds(constant.mask, 10)
    found = fit_noise(twin, constant, [0], parts, np.zeros((10, len(twin.values))))
    assert found.proportional == pytest.approx([0.0])
    assert np.sqrt(found.process) == pytest.approx([CONSTANT], rel=0.3)


def test_the_search_finds_what_a_grid_finds_with_few_calls(twin: DynamicsTwin) -> None:
    made = record(PROPORTIONAL)
    search = Search(twin, made, np.array([0]), folds(made.mask, 10), np.zeros((10, 2)))
    found = search.visit(search.visit().best)
    best = found.scores.sum(axis=1).max()
    assert len(found.points) < 300
    axis = np.linspace(np.log(1e-6), 0, 9)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    around = found.best + np.random.default_rng(0).normal(0, 0.2, size=(200, 3))
    assert max(search.predict(each)[1].sum() for each in (*grid, *around)) <= best + 0.01
    # Without each part, no visited point is better for the others than the step of scoring.
    more = found.points[:, None] + np.random.default_rng(1).normal(0, 0.02, size=(3, 3))
    scores = np.array([search.predict(each)[1] for each in more[-40:].reshape(-1, 3)])
    others = found.scores.sum(axis=1)[:, None] - found.scores
    near = (scores.sum(axis=1)[:, None] - scores).max(axis=0)
    assert (near <= others.max(axis=0) + 0.02).all()


def test_intervals_hold_what_they_promise_after_a_switch_and_between(twin: DynamicsTwin) -> None:
    unseen = record(PROPORTIONAL, count=40, seed=2)
    inside = np.abs(twin.predictive(unseen).standardised()[:, 1:]) < 1.645
    change = np.abs(np.diff(unseen.nominal, axis=1))
    for part in (change > 0.01, change < 1e-3):
        assert part.sum() > 2000
        assert inside[part].mean() == pytest.approx(0.9, abs=0.02)


def test_a_measured_deviation_makes_no_larger_one_probable(twin: DynamicsTwin) -> None:
    healthy = record(PROPORTIONAL, seed=2)
    late = (np.arange(healthy.steps) > 200)[:, None]
    faulty = healthy.replace(observed=healthy.observed - 0.1 * late)
    deviation = [
        twin.filter(each.commands.astype(float), each.observed.astype(float), each.mask)[1]
        for each in (healthy, faulty)
    ]
    np.testing.assert_array_equal(*deviation)


def test_simulations_spread_as_the_filter_predicts(twin: DynamicsTwin) -> None:
    sure = replace(twin, factor=0 * twin.factor, start_deviation=np.zeros(1), widening=np.ones(1))
    commands = record(PROPORTIONAL, count=1).commands
    made = sure.simulate(np.repeat(commands, 1000, axis=0), seed=0).observed
    spread = sure.simulation.noise_variance(commands.astype(float))[0]
    np.testing.assert_allclose(made.var(axis=0), spread, rtol=0.25)


def test_it_is_the_same_online(twin: DynamicsTwin) -> None:
    unseen, online = record(PROPORTIONAL, count=3, seed=3), OnlineFilter(twin)
    commands, measured = unseen.commands.astype(float), unseen.observed.astype(float)
    state, found = online.start(3), []
    for part in np.split(np.arange(unseen.steps), [1, 7, 200]):
        state, _, covariance = online.step(
            state, commands[:, part], measured[:, part], unseen.mask[:, part]
        )
        found.append(covariance)
    whole = online.step(online.start(3), commands, measured, unseen.mask)[2]
    np.testing.assert_array_equal(np.concatenate(found, axis=1), whole)
    wanted = twin.filter(commands, measured, unseen.mask)[1]
    np.testing.assert_allclose(whole[:, 100:], wanted[:, 100:], rtol=1e-3)


def test_it_is_saved_and_a_model_without_it_is_refused(twin: DynamicsTwin, tmp_path: Path) -> None:
    twin.save(tmp_path / "model")
    assert DynamicsTwin.load(tmp_path / "model").proportional == twin.proportional
    file = tmp_path / "model" / "weights.safetensors"
    weights = load_file(file)
    del weights["proportional"]
    save_file(weights, file)
    with pytest.raises(rt.InputError, match="proportional"):
        DynamicsTwin.load(tmp_path / "model")
