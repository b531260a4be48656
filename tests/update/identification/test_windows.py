"""Integrating and unstable plants: windows whose starts are estimated, and when they are used."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.cases.styrofoam_incubator.case import WARM_UP, measurements
from retwin.cases.styrofoam_incubator.twin import INCUBATOR
from retwin.evaluation import hold_out, validate_identification
from retwin.report.identification.texts import findings
from retwin.twins import FunctionTwin, Parameter, ParametricTwin, State, StateTwin
from retwin.update.dynamics.arrow import Arrow, bounded_step
from retwin.update.identification import LeastSquares, identify
from retwin.update.identification.misfit import misfit_of

RATE, GAIN = 50.0, 3.2
INPUTS, OUTPUTS = rt.Channels(("u",), ("V",)), rt.Channels(("y",), ("m",))
CART = StateTwin(
    (State("position", "m"), State("velocity", "m/s")),
    lambda x, u, p: x.position,
    INPUTS,
    OUTPUTS,
    RATE,
    derivative=lambda x, u, p: (x.velocity, p.gain * u.u),
    parameters=(Parameter("gain", "m/s2/V", 0.1, 10.0, 1.0),),
)
LAG = replace(
    CART,
    states=(State("level", "m"),),
    output=lambda x, u, p: x.level,
    derivative=lambda x, u, p: (p.gain * u.u - 2.0 * x.level,),
)
QUICK = LeastSquares(starts=1)
pytestmark = pytest.mark.filterwarnings("ignore:at a bound")


def record(commands: np.ndarray, outputs: np.ndarray) -> rt.Trajectories:
    return rt.Trajectories(
        commands, np.zeros_like(outputs), outputs, RATE, inputs=INPUTS, outputs=OUTPUTS
    )


def in_closed_loop(seed: int = 0, seconds: float = 30.0) -> rt.Trajectories:
    """A cart under feedback, with friction and a slow force that no twin has."""
    rng, period = np.random.default_rng(seed), 1 / RATE
    x, v, force, aim = 0.3, 0.3, 0.0, 0.0
    commands, outputs = [], []
    for k in range(round(seconds * RATE)):
        if k % 150 == 0:
            aim = rng.uniform(-1, 1)
        y = x + 2e-3 * rng.normal()
        u = np.clip(1.5 * (aim - y) - 0.9 * v, -2, 2)
        commands.append(u)
        outputs.append(y)
        force += -period * force / 5 + 0.05 * np.sqrt(period) * rng.normal()
        a = GAIN * u + force + 0.02 - 0.02 * np.tanh(v / 0.01)
        x, v = x + period * v + period**2 / 2 * a, v + period * a
    return record(np.array(commands)[None, :, None], np.array(outputs)[None, :, None])


@pytest.fixture(scope="module")
def cart() -> rt.Trajectories:
    return in_closed_loop()


@pytest.mark.slow
def test_an_integrating_plant_is_fitted_in_windows(cart: rt.Trajectories) -> None:
    found = identify(CART.parametric(), cart, QUICK, seed=0)
    whole = identify(CART.parametric(), cart, QUICK, seed=0, horizon=np.inf)
    assert whole.horizon == np.inf
    assert found.horizon < cart.steps / RATE / 5
    assert abs(found.values["gain"] - GAIN) < abs(whole.values["gain"] - GAIN) / 3
    assert found.horizons[0].error < next(e.error for e in found.horizons if e.length is None)


@pytest.mark.slow
def test_the_page_has_the_error_of_predictions_and_of_the_mean(cart: rt.Trajectories) -> None:
    used, held_out = hold_out(cart, 0.25, seed=0)
    before = CART.parametric()
    texts = {}
    for horizon in (None, np.inf):
        found = identify(before, used, QUICK, seed=0, horizon=horizon)
        texts[horizon] = " ".join(
            findings(validate_identification(found, before, used, held_out, seed=0))
        )
    assert "from estimated starts" in texts[None]
    assert "the record's mean alone has" in texts[None]
    assert "fitted in windows of" in texts[None]
    assert "worse than the record's mean" in texts[np.inf]


def test_derivatives_are_those_of_the_misfit_whose_starts_follow(cart: rt.Trajectories) -> None:
    with misfit_of(CART.parametric(), cart, seed=0, rate=None, processes=1, length=100) as misfit:
        theta, step = np.array([2.0]), 1e-4
        slope = misfit.derivatives(theta)
        assert slope is not None
        gradient = 2 * slope[:, 0] @ misfit.residuals(theta[None]).ravel()
        ends = [np.sum(misfit.residuals(np.array([[2.0 + e]])) ** 2) for e in (step, -step)]
    assert gradient == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-4)


@pytest.mark.slow
def test_an_unstable_plant_is_fitted_although_its_free_simulation_fails() -> None:
    def derivative(x, u, p):
        return (x.velocity, p.gain * u.u + 9.0 * x.position)

    unstable = replace(CART, derivative=derivative)
    rng = np.random.default_rng(1)
    x, v, commands, outputs = 0.01, 0.0, [], []
    for _ in range(1000):
        u = -8.0 * x - 2.0 * v + 0.2 * rng.normal()
        commands.append(u)
        outputs.append(x + 1e-4 * rng.normal())
        for _ in range(10):
            a = GAIN * u + 9.0 * x + 0.1 * rng.normal()
            x, v = x + v / RATE / 10, v + a / RATE / 10
    observed = record(np.array(commands)[None, :, None], np.array(outputs)[None, :, None])
    found = identify(unstable.parametric(), observed, QUICK, seed=0)
    assert found.values["gain"] == pytest.approx(GAIN, rel=0.1)


def test_a_stable_plant_is_simulated_freely() -> None:
    commands = np.repeat(np.random.default_rng(0).uniform(-1, 1, (1, 40, 1)), 25, axis=1)
    made = LAG.simulate(commands, seed=0, parameters={"gain": GAIN}).observed
    found = identify(LAG.parametric(), record(commands, made), QUICK, seed=0)
    assert (found.horizon, found.horizons, found.lasting) == (np.inf, (), False)
    assert found.values["gain"] == pytest.approx(GAIN, rel=1e-3)


@pytest.mark.slow
@pytest.mark.real_data
@pytest.mark.filterwarnings("ignore:not identified|at a bound|unknown")
def test_windows_are_taken_where_whole_records_are_overfitted() -> None:
    """A day of the incubator, whose parts are predicted badly by parameters of whole records.

    The plant is stable: effects of its start decay. The next day says which parameters are better.
    """
    folder = Path(os.environ.get("RETWIN_DATA", "")) / "incubator"
    if not folder.is_dir():
        pytest.skip("RETWIN_DATA names no folder with incubator/*.csv")
    _, others = measurements(warm_up=0)(folder)
    first, following = (
        others[[i]].between(0, float(others.lengths[i]) / others.rate) for i in (0, 1)
    )
    guess = {"c_air": 500.0, "g_box": 0.5, "c_heater": 50.0, "g_heater": 1.0}
    twin, errors = INCUBATOR.parametric().with_values(guess), {}
    for horizon in (None, np.inf):
        found = identify(twin, first, seed=0, horizon=horizon)
        physics = found.twin.holding(*(each.name for each in INCUBATOR.parameters))
        started = identify(physics, following.between(0, WARM_UP), seed=0).twin
        error = started.simulate(following.commands, seed=0).observed - following.observed
        errors[horizon] = np.sqrt(np.mean(error[following.mask] ** 2))
        if horizon is None:
            assert np.isfinite(found.horizon)
            assert not found.lasting
            judged = validate_identification(found, twin, first)
            assert "have not seen more than twice as badly" in " ".join(findings(judged))
    assert errors[None] < 0.7 * errors[np.inf]


def test_what_windows_would_need_is_said_of_a_function(cart: rt.Trajectories) -> None:
    def twice(commands: np.ndarray, gain: float) -> np.ndarray:
        return np.cumsum(np.cumsum(gain * commands, axis=-2), axis=-2) / RATE**2

    def build(values) -> FunctionTwin:
        return FunctionTwin(partial(twice, **values), INPUTS, OUTPUTS, RATE)

    twin = ParametricTwin.built(build, CART.parameters)
    found = identify(twin, cart, QUICK, seed=0)
    assert found.lasting
    texts = " ".join(findings(validate_identification(found, twin, cart)))
    assert "write its equations as a StateTwin" in texts
    with pytest.raises(rt.InputError, match="none for a twin without states"):
        identify(twin, cart, QUICK, seed=0, horizon=2.0)


def test_a_start_is_inferred_unless_it_is_given() -> None:
    commands = np.repeat(np.random.default_rng(0).uniform(-1, 1, (2, 8, 1)), 25, axis=1)
    given = {"gain": np.full(2, GAIN), "start_level": np.array([1.5, -2.0])}
    observed = record(commands, LAG.simulate(commands, seed=0, parameters=given).observed)
    free = identify(LAG.parametric(), observed, QUICK, seed=0)
    assert free.values["gain"] == pytest.approx(GAIN, rel=1e-3)
    assert not free.own_starts  # a start without bounds is no parameter
    fixed = replace(LAG, states=(State("level", "m", 0.0),)).parametric()
    assert identify(fixed, observed, QUICK, seed=0).values["gain"] != pytest.approx(GAIN, rel=0.05)


def test_each_record_has_its_own_start_unless_one_is_stated() -> None:
    """Bounds of an unknown start make it a parameter, of which records have different values."""
    commands = np.repeat(np.random.default_rng(0).uniform(-1, 1, (6, 8, 1)), 25, axis=1)
    starts = np.array([1.5, -2.0, 0.5, 2.5, -1.0, 0.0])
    given = {"gain": np.full(6, GAIN), "start_level": starts}
    observed = record(commands, LAG.simulate(commands, seed=0, parameters=given).observed)
    bounded = replace(LAG, states=(State("level", "m", None, -5.0, 5.0),)).parametric()
    used, held_out = hold_out(observed, 0.25, seed=0)
    found = identify(bounded, used, QUICK, seed=0)
    assert found.values["gain"] == pytest.approx(GAIN, rel=1e-3)
    own = starts[np.isin(observed.commands[:, 0, 0], used.commands[:, 0, 0])]
    assert found.values["start_level"] == pytest.approx(own.mean(), abs=0.01)
    assert found.own_starts == {"start_level": pytest.approx(own.std(), abs=0.01)}
    assert [*found.intervals] == ["gain"]
    judged = validate_identification(found, bounded, used, held_out, seed=0)
    assert judged.errors("validation")["y"].after < 1e-3
    assert [(each.name, each.own) for each in judged.parameters] == [
        ("gain", False),
        ("start_level", True),
    ]
    assert judged.open_parameters == ()
    assert "Each record has its own start_level" in " ".join(findings(judged))
    stated = replace(LAG, states=(State("level", "m", 0.0, -5.0, 5.0),)).parametric()
    shared = identify(stated, used, QUICK, seed=0)
    assert not shared.own_starts
    assert [*shared.intervals] == ["gain", "start_level"]


@pytest.mark.parametrize("horizon", [None, 2.0])
def test_an_output_that_was_never_measured_is_left_out(horizon: float | None) -> None:
    """Its column is there, and empty: its size is not NaN, with which a search never ended."""
    both = rt.Channels(("y", "v"), ("m", "m/s"))
    twin = replace(CART, output=lambda x, u, p: (x.position, x.velocity), outputs=both)
    one = in_closed_loop(seconds=8.0)
    outputs = np.concatenate([one.observed, np.full_like(one.observed, np.nan)], axis=2)
    observed = replace(
        one, nominal=np.zeros_like(outputs), observed=outputs, mask=None, outputs=both
    )
    found = identify(twin.parametric(), observed, QUICK, seed=0, horizon=horizon)
    alone = identify(CART.parametric(), one, QUICK, seed=0, horizon=horizon)
    assert found.horizon == alone.horizon < np.inf
    assert found.values["gain"] == pytest.approx(alone.values["gain"], rel=1e-3)


def test_a_step_that_is_not_finite_ends_the_search() -> None:
    curvature = Arrow(np.zeros((0, 0)), np.zeros((1, 1, 0)), np.full((1, 1, 1), np.nan))
    end = np.full(1, np.inf)
    assert np.isnan(bounded_step(curvature, np.full(1, np.nan), 1.0, -end, end)).all()
