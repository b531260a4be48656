"""State equations learned from simulations of twins whose equations are not accessible."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmus import c_fmu
from numpy.typing import NDArray
from test_readme import python_of

import retwin as rt
from retwin.cases.cascaded_tanks.case import VOLTAGES
from retwin.cases.cascaded_tanks.twin import TANKS
from retwin.errors import InputError
from retwin.twins import HoldSampler, ParameterShift, StateTwin
from retwin.update import (
    FittedStateSurrogate,
    StateSurrogate,
    fit_dynamics,
    fit_state_surrogate,
    identify,
)
from retwin.update.dynamics.estimation import Estimation

RATE = 10.0
FORCE, POSITION = rt.Channels(("force",), ("N",)), rt.Channels(("position",), ("m",))
HOLDS = HoldSampler((-3.0,), (3.0,), RATE, 20.0)
PARAMETERS = (
    rt.Parameter("stiffness", "N/m", 2.0, 8.0, 4.0),
    rt.Parameter("damping", "N s/m", 0.2, 1.2, 0.5),
)
Values = Sequence[NDArray]


def integrated(
    slope: Callable[[Values, NDArray], Values], start: Sequence[float], commands: NDArray
) -> NDArray:
    """The first state (n, T, 1) of equations, by two Runge-Kutta steps per sample."""
    x, found, h = [np.full(len(commands), each) for each in start], [], 0.5 / RATE
    for u in commands[..., 0].T:
        found.append(x[0])
        for _ in range(2):
            slopes: list[Values] = []
            for share in (0.0, 0.5, 0.5, 1.0):
                last = slopes[-1] if slopes else [np.zeros(len(u))] * len(x)
                at = [a + share * h * k for a, k in zip(x, last, strict=True)]
                slopes.append(slope(at, u))
            x = [
                a + h / 6 * (k[0] + 2 * k[1] + 2 * k[2] + k[3])
                for a, k in zip(x, zip(*slopes, strict=True), strict=True)
            ]
    return np.stack(found, axis=1)[..., None]


def lag(commands: NDArray, gain: float = 1.0) -> NDArray:
    """A saturating lag that begins at 0.3."""
    return integrated(lambda x, u: [gain * np.tanh(u) - x[0]], [0.3], commands)


def spring(commands: NDArray, stiffness: float = 4.0, damping: float = 0.5) -> NDArray:
    """A mass on a hardening spring, displaced by 0.2 m at the start."""

    def slope(x: Values, u: NDArray) -> Values:
        return [x[1], u - damping * x[1] - stiffness * (x[0] + x[0] ** 3)]

    return integrated(slope, [0.2, 0.0], commands)


def two_wells(commands: NDArray) -> NDArray:
    """A chaotic oscillator."""
    return integrated(lambda x, u: [x[1], u - 0.3 * x[1] + x[0] - x[0] ** 3], [1.0, 0.0], commands)


def twin_of(function: Callable[..., NDArray]) -> rt.FunctionTwin:
    return rt.FunctionTwin(function, FORCE, POSITION, RATE)


def with_values(values: dict[str, float]) -> rt.FunctionTwin:
    return twin_of(partial(spring, **values))


def with_gain(values: dict[str, float]) -> rt.FunctionTwin:
    return twin_of(partial(lag, **values))


SMALL = StateSurrogate(states=1, hidden=4, simulations=20)
GAINS = rt.ParametricTwin.built(with_gain, (rt.Parameter("gain", "1", 0.5, 2.0, 1.0),))
SHORT = HoldSampler((-2.0,), (2.0,), RATE, 6.0)


def noisy(twin: rt.Twin, seed: int, count: int = 2, **options: object) -> rt.Trajectories:
    """Measurements of a twin with errors of 1 cm."""
    rng = np.random.default_rng(seed)
    made = twin.simulate(HOLDS.sample(count, rng=rng), seed=0, **options)  # type: ignore[arg-type]
    return made.replace(observed=made.observed + rng.normal(0, 0.01, made.observed.shape))


def relative(found: StateTwin, twin: rt.Twin, commands: NDArray) -> float:
    """RMS of the error of a surrogate over the standard deviation of the twin."""
    truth = twin.simulate(commands, seed=0).observed
    error = found.simulate(commands, seed=0).observed - truth
    return float(np.sqrt(np.mean(error**2)) / truth.std())


@pytest.fixture(scope="module")
def small() -> FittedStateSurrogate:
    return fit_state_surrogate(GAINS, SHORT, settings=SMALL)


@pytest.fixture(scope="module")
def sprung() -> FittedStateSurrogate:
    twin = rt.ParametricTwin.built(with_values, PARAMETERS)  # type: ignore[arg-type]
    return fit_state_surrogate(twin, HOLDS)


def test_it_follows_the_twin_from_the_first_sample_on(small: FittedStateSurrogate) -> None:
    fresh = SHORT.sample(5, rng=np.random.default_rng(9))
    assert relative(small.twin, GAINS, fresh) < 0.02
    first = small.twin.simulate(fresh, seed=0).observed[:, 0, 0]
    np.testing.assert_allclose(first, 0.3, atol=0.01)
    assert small.figures["nrmse_position"] < 0.02
    assert small.figures["states"] == 1
    assert set(small.history) == {1}


def test_parameters_of_the_twin_are_those_of_the_surrogate(small: FittedStateSurrogate) -> None:
    (found,) = small.twin.parameters
    assert (found.name, found.unit, found.low, found.high) == ("gain", "1", 0.5, 2.0)
    fresh = SHORT.sample(5, rng=np.random.default_rng(9))
    weak = GAINS.with_values([0.7])
    made = small.twin.simulate(fresh, seed=0, parameters={"gain": 0.7}).observed
    truth = weak.simulate(fresh, seed=0).observed
    assert np.sqrt(np.mean((made - truth) ** 2)) < 0.02 * truth.std()
    updated = identify(small.twin.parametric(), weak.simulate(fresh, seed=0), seed=0)
    assert updated.values["gain"] == pytest.approx(0.7, abs=0.01)


def test_a_saved_one_is_the_same(small: FittedStateSurrogate, tmp_path: Path) -> None:
    small.save(tmp_path / "model")
    loaded = FittedStateSurrogate.load(tmp_path / "model")
    fresh = SHORT.sample(2, rng=np.random.default_rng(9))
    made = [each.twin.simulate(fresh, seed=0).observed for each in (small, loaded)]
    np.testing.assert_allclose(made[0], made[1], rtol=1e-12)
    about = [(each.figures, each.history, each.reason) for each in (small, loaded)]
    assert about[0] == about[1]


@pytest.mark.slow
def test_the_seed_determines_it(small: FittedStateSurrogate) -> None:
    again = fit_state_surrogate(GAINS, SHORT, settings=SMALL)
    assert again.twin.fingerprint == small.twin.fingerprint


def test_own_commands_are_learned_and_compared(small: FittedStateSurrogate) -> None:
    beyond = 4 * np.sin(np.arange(60) / 5)[None, :, None]
    with pytest.raises(InputError, match="commands: expected force from"):
        small.twin.simulate(beyond, seed=0)
    found = fit_state_surrogate(GAINS, beyond, settings=SMALL)
    assert found.figures["own_position"] < 0.02
    assert relative(found.twin, GAINS, beyond) < 0.05


def test_an_error_beside_which_the_discrepancy_is_small_is_refused() -> None:
    commands = SHORT.sample(2, rng=np.random.default_rng(3))
    near = GAINS.simulate(commands, seed=0)
    near = near.replace(observed=near.observed + 1e-6)
    with pytest.raises(InputError, match=r"observed.*twin's discrepancy.*more simulations"):
        fit_state_surrogate(GAINS, SHORT, near, SMALL)


def test_the_search_ends_where_its_error_is_small_beside_the_discrepancy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It takes fewer simulations with derivatives, and its error is the share that was wanted."""
    runs = [0]

    def counted(*given: Any) -> Any:
        runs[-1] += 1
        return linearised(*given)

    linearised = Estimation.linearised
    monkeypatch.setattr(Estimation, "linearised", counted)
    commands = SHORT.sample(2, rng=np.random.default_rng(3))
    far = GAINS.simulate(commands, seed=0)
    far = far.replace(observed=1.5 * far.observed)
    errors = []
    for share in (0.0, 0.2):
        runs.append(0)
        found = fit_state_surrogate(GAINS, SHORT, far, replace(SMALL, sufficient=share))
        errors.append(found.figures["own_position"] / found.figures["discrepancy_position"])
    assert runs[2] < 0.6 * runs[1]
    assert errors[0] < errors[1] < 0.4
    with pytest.raises(InputError, match="sufficient"):
        StateSurrogate(sufficient=0.9)


def test_a_constant_output_and_another_rate_are_refused() -> None:
    still = twin_of(lambda u: np.ones_like(u))
    with pytest.raises(InputError, match=r"outputs that change.*position"):
        fit_state_surrogate(still, SHORT, settings=SMALL)
    slow = HoldSampler((-2.0,), (2.0,), 2 * RATE, 6.0)
    with pytest.raises(InputError, match=r"commands\.rate: expected that of the twin"):
        fit_state_surrogate(GAINS, slow, settings=SMALL)
    with pytest.raises(InputError, match="spread"):
        StateSurrogate(spread=1.5)


@pytest.mark.slow
def test_a_chaotic_twin_is_refused() -> None:
    excited = HoldSampler((-0.5,), (0.5,), RATE, 30.0)
    with pytest.raises(InputError, match=r"twin.*follows to 0\.1.*last.*chaos"):
        fit_state_surrogate(
            twin_of(two_wells), excited, settings=StateSurrogate(states=2, simulations=30)
        )


@pytest.mark.slow
def test_the_number_of_states_is_found(sprung: FittedStateSurrogate) -> None:
    assert sprung.figures["states"] == 2
    assert sprung.history[1] > 10 * sprung.history[2]
    assert sprung.figures["nrmse_position"] < 0.005
    assert sprung.figures["nrmse_first_position"] < 0.005


@pytest.mark.slow
def test_shifted_parameters_of_a_black_box_are_identified(sprung: FittedStateSurrogate) -> None:
    truth = {"stiffness": 5.5, "damping": 0.8}
    inside = 0
    for seed in range(4):
        found = fit_dynamics(sprung.twin, noisy(with_values(truth), seed))
        for name, value in truth.items():
            deviations = abs(found.parameters[name] - value) / found.errors[name]
            inside += deviations < 2
        assert found.figures["rms_after"] < 0.0115
    assert inside >= 6, "of 8 intervals of two standard errors"
    updated = identify(sprung.twin.parametric(), noisy(with_values(truth), 0), seed=0)
    for name, value in truth.items():
        assert updated.values[name] == pytest.approx(value, rel=0.01)


@pytest.mark.slow
def test_faults_of_a_black_box_are_inverted(sprung: FittedStateSurrogate) -> None:
    healthy = noisy(with_values({}), 20, count=3)
    fitted = fit_dynamics(sprung.twin, healthy)
    soft = ParameterShift(parameter="stiffness", size=(-1.8, -0.5), label="Soft")
    faults = {"Healthy": None, "Soft": soft}
    diagnoser = rt.fit_inversion(fitted.twin, None, healthy, faults)
    softened = with_values({"stiffness": 2.8})
    probable = [
        diagnoser.predict_proba(noisy(twin, 30, count=4))[:, 1]
        for twin in (with_values({}), softened)
    ]
    assert probable[0].max() < 0.5 < probable[1].min()


@pytest.mark.slow
def test_the_cascaded_tanks() -> None:
    found = fit_state_surrogate(TANKS, VOLTAGES, settings=StateSurrogate(simulations=50))
    assert found.figures["states"] == 2
    fresh = VOLTAGES.sample(20, rng=np.random.default_rng(9))
    assert relative(found.twin, TANKS, fresh) < 0.01


@pytest.mark.slow
def test_parameters_of_an_fmu(tmp_path: Path) -> None:
    channels = (["u"], ["x"])
    inner = rt.FMUTwin.from_file(c_fmu(tmp_path), 50.0, *channels, workers=1)
    free = (rt.Parameter("gain", "1", 0.5, 2.0, 1.0), rt.Parameter("tau", "s", 0.05, 0.3, 0.1))
    twin = rt.ParametricTwin(inner, free)
    sampler = HoldSampler((-5.0,), (5.0,), 50.0, 4.0)
    settings = StateSurrogate(states=1, hidden=8, simulations=50)
    found = fit_state_surrogate(twin, sampler, settings=settings)
    assert found.figures["nrmse_x"] < 0.01
    real = twin.with_values([1.4, 0.2]).simulate(
        sampler.sample(3, rng=np.random.default_rng(9)), seed=0
    )
    updated = identify(found.twin.parametric(), real, seed=0)
    assert updated.values["gain"] == pytest.approx(1.4, rel=0.01)
    assert updated.values["tau"] == pytest.approx(0.2, rel=0.02)


PENDULUM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body>
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.3"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator>
  <sensor><jointpos name="angle" joint="hinge"/></sensor>
</mujoco>
"""


@pytest.mark.slow
def test_a_mujoco_model_with_memory(tmp_path: Path) -> None:
    (tmp_path / "pendulum.xml").write_text(PENDULUM)
    twin = rt.MuJoCoTwin.from_file(tmp_path / "pendulum.xml", rate=20.0)
    sampler = HoldSampler((-1.0,), (1.0,), 20.0, 15.0)
    settings = StateSurrogate(states=2, simulations=30)
    found = fit_state_surrogate(twin, sampler, settings=settings)
    fresh = sampler.sample(10, rng=np.random.default_rng(9))
    assert relative(found.twin, twin, fresh) < 0.01


@pytest.mark.slow
def test_the_page_of_state_surrogates() -> None:
    names: dict = {"__name__": "shown"}
    for code in python_of("dynamics", "State equations of a black box"):
        exec(compile(code, "docs/dynamics.md", "exec"), names)
    assert names["learned"].figures["nrmse_level"] < 0.005
    found = names["fitted"]
    assert abs(found.parameters["leak"] - 0.06) < 3 * found.errors["leak"] < 0.003
