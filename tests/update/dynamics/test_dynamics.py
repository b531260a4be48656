"""Corrected dynamics against systems whose discrepancy, parameters and noise are known."""

from __future__ import annotations

import json
import pickle
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

import retwin as rt
from retwin.errors import InputError
from retwin.testing import TWIN_CHECKS, TwinSubject
from retwin.twins import FunctionTwin, Parameter, State, StateTwin
from retwin.twins.compiled import steps
from retwin.twins.equations.saved_equations import equations_from, equations_of
from retwin.update import Dynamics, DynamicsTwin, Library, OutsideTrainingWarning, fit_dynamics
from retwin.update.dynamics import FittedDynamics
from retwin.update.dynamics.estimation import correlation_time
from retwin.update.dynamics.filter.noise import needed_factor
from retwin.update.dynamics.filter.prediction import Prediction, log_density

pytestmark = pytest.mark.slow

FORCE = rt.Channels(("force",), ("N",))
POSITION = rt.Channels(("position",), ("m",))
STIFFNESS = Parameter("stiffness", "N/m", 10.0, 100.0, 40.0)
DAMPING = Parameter("damping", "N s/m", 0.05, 5.0, 0.6)
CUBIC = Parameter("cubic", "N/m^3", 0.0, 500.0, 0.0)
RATE = 40.0
NOISE = 1e-3


def spring(x, u, p):
    pull = p.stiffness * x.position + p.cubic * x.position**3
    return x.velocity, u.force - p.damping * x.velocity - pull


def position(x, u):
    return x.position


OSCILLATOR = StateTwin(
    (State("position", "m", 0.0, -0.5, 0.5), State("velocity", "m/s")),
    position,
    FORCE,
    POSITION,
    RATE,
    derivative=spring,
    parameters=(STIFFNESS, DAMPING, CUBIC),
)
LINEAR = OSCILLATOR.parametric().holding("cubic")


def forces(count: int, seed: int, size: float = 8.0, samples: int = 400) -> np.ndarray:
    white = np.random.default_rng(seed).normal(size=(count, samples, 1))
    kernel = np.hanning(7) / np.sqrt(np.sum(np.hanning(7) ** 2))
    smooth = np.apply_along_axis(np.convolve, 1, white[..., 0], kernel, mode="same")
    return size * smooth[..., None]


def record(seed: int = 0, count: int = 3, size: float = 8.0, **truth: float) -> rt.Trajectories:
    """Measured outputs of an oscillator with such parameters, and the true ones as nominal."""
    made = OSCILLATOR.simulate(forces(count, seed, size), seed=0, parameters=truth)
    noise = NOISE * np.random.default_rng(seed + 1).normal(size=made.observed.shape)
    return made.replace(nominal=made.observed, observed=made.observed + noise)


TRUTH = {"stiffness": 30.0, "damping": 0.8, "cubic": 120.0}


@pytest.fixture(scope="module")
def fitted() -> FittedDynamics:
    return fit_dynamics(LINEAR, record(**TRUTH))


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


def test_a_structural_error_is_learned(fitted: FittedDynamics) -> None:
    unseen = record(seed=10, **TRUTH)
    made = fitted.twin.simulate(unseen.commands, seed=0).nominal
    linear = LINEAR.with_values({"stiffness": 38.0, "damping": 0.8})
    before = rms(linear.simulate(unseen.commands, seed=0).observed - unseen.nominal)
    assert rms(made - unseen.nominal) < 0.02 * before


def test_the_learned_curve_is_the_missing_one(fitted: FittedDynamics) -> None:
    """Within 5 % of its range where data are, and inside 95 % intervals of the posterior."""
    domain, twin = fitted.twin.domain, fitted.twin
    x = np.linspace(0.8 * domain.low[0], 0.8 * domain.high[0], 41)
    states = np.column_stack([x, np.zeros_like(x)])
    values = twin.values[: len(twin.equations.parameters)]
    here = twin.slope(states, np.zeros((41, 1)))[:, 1]
    wanted = -TRUTH["stiffness"] * x - TRUTH["cubic"] * x**3
    assert len(values) == len(twin.equations.parameters)
    assert np.abs(here - wanted).max() < 0.05 * np.ptp(wanted)


@pytest.mark.slow
def test_a_true_parameter_shift_is_not_explained_by_the_discrepancy() -> None:
    shifted = record(stiffness=55.0, damping=1.5, cubic=0.0)
    found = fit_dynamics(LINEAR, shifted)
    for name, value in (("stiffness", 55.0), ("damping", 1.5)):
        assert abs(found.parameters[name] - value) < 5 * found.errors[name] + 0.02 * value
    twin, count = found.twin, len(found.terms)
    states = shifted.replace(observed=shifted.nominal).observed[0, :, 0]
    where = np.column_stack([states, np.gradient(states, 1 / RATE)]), shifted.commands[0]
    kept = np.ones(len(twin.values))
    kept[-2 - count : -2] = 0.0
    alone = replace(twin, values=kept * twin.values)
    assert rms((twin.slope(*where) - alone.slope(*where))[:, 1]) < 0.05 * twin.domain.speed[1]


def test_a_structural_error_is_not_explained_by_the_parameters(fitted: FittedDynamics) -> None:
    for name in ("stiffness", "damping"):
        assert abs(fitted.parameters[name] - TRUTH[name]) < 5 * fitted.errors[name]
        assert fitted.errors[name] < 0.2 * TRUTH[name]


def test_terms_that_parameters_explain_are_left_out(fitted: FittedDynamics) -> None:
    names = set(fitted.terms)
    assert not names & {"velocity: position", "velocity: velocity"}
    assert "velocity: position^3" in names
    assert all(name.startswith("velocity: ") for name in names), "position' = velocity is known"


def with_process_noise(
    seed: int, count: int = 8, size: float = 8.0, deviation: float = 0.01
) -> rt.Trajectories:
    commands, rng = forces(count, seed, size), np.random.default_rng(seed)
    twin = replace(OSCILLATOR, parameters=(STIFFNESS, DAMPING, CUBIC))
    theta = np.tile(twin.values(None, 1), (count, 1))
    kicks = deviation * rng.normal(size=(count, commands.shape[1], 2)) * [0, 1]
    outputs = twin.steps().run(commands, theta, kicks)[0]
    made = twin.simulate(commands, seed=0)
    return made.replace(observed=outputs + NOISE * rng.normal(size=outputs.shape))


@pytest.fixture(scope="module")
def noisy() -> FittedDynamics:
    return fit_dynamics(LINEAR, with_process_noise(0), Dynamics(Library(degree=2, knots=())))


@pytest.mark.slow
def test_process_and_measurement_noise_are_separated(noisy: FittedDynamics) -> None:
    assert np.sqrt(noisy.twin.process) == pytest.approx([0.0, 0.01], rel=0.25)
    assert np.sqrt(noisy.twin.noise) == pytest.approx([NOISE], rel=0.35)


def test_bands_of_free_simulation_hold_what_they_promise(noisy: FittedDynamics) -> None:
    unseen = with_process_noise(50, count=12, size=6.0)
    draws = 200
    repeated = np.repeat(unseen.commands, draws, axis=0)
    made = noisy.twin.simulate(repeated, seed=0).observed.reshape(12, draws, -1, 1)
    low, high = np.quantile(made, [0.05, 0.95], axis=1)
    inside = (low <= unseen.observed) & (unseen.observed <= high)
    assert 0.8 < inside.mean() < 0.97


@pytest.mark.parametrize("deviation", [0.75, 1.0, 1.3])
def test_few_or_correlated_errors_do_not_make_bands_narrower(deviation: float) -> None:
    """Many errors show that bands are too wide; few, which are correlated, do so by chance."""
    rng = np.random.default_rng(0)
    many = np.abs(rng.normal(0, deviation, (8, 4000)))
    assert needed_factor(many, many > 0) == pytest.approx(deviation, rel=0.05)
    found = []
    for _ in range(50):
        few = lfilter([(1 - 0.97**2) ** 0.5], [1, -0.97], rng.normal(0, deviation, (4, 600)))
        few = np.abs(few[:, 200:])
        found.append(needed_factor(few, few >= 0))
    assert np.mean(np.array(found) >= 0.9 * deviation) > 0.85
    if deviation < 1:
        assert np.mean(np.array(found) >= deviation) > 0.85


def test_one_step_predictions_hold_what_they_promise(noisy: FittedDynamics) -> None:
    unseen = with_process_noise(50, count=12, size=6.0)
    found = noisy.twin.predictive(unseen)
    assert 0.88 < found.coverage()[0] < 0.92
    pit = found.pit()
    assert abs(np.corrcoef(pit[:, 1:].ravel(), pit[:, :-1].ravel())[0, 1]) < 0.06
    assert rms(found.mean - unseen.observed) < 0.7 * rms(unseen.nominal - unseen.observed)


def test_the_start_of_a_record_is_inferred_from_its_first_samples(fitted: FittedDynamics) -> None:
    start = {"start_position": 0.3}
    unseen = record(seed=30, count=1, size=6.0, **TRUTH, **start)
    begun = fitted.twin.started(unseen.between(0, 2.0))
    assert begun.values[-2] == pytest.approx(0.3, abs=4 * np.linalg.norm(begun.factor[-2]))
    assert 1e-5 < np.linalg.norm(begun.factor[-2]) < 0.01
    error = begun.simulate(unseen.commands, seed=0).nominal - unseen.nominal
    assert rms(error) < 3 * NOISE
    with pytest.raises(InputError, match="one trajectory"):
        fitted.twin.started(record(**TRUTH))


def test_missing_samples_are_not_used(noisy: FittedDynamics) -> None:
    unseen = with_process_noise(50, count=2, size=6.0)
    mask = unseen.mask.copy()
    mask[:, 100:160] = False
    broken = np.where(mask, unseen.observed, 1e6)
    found = noisy.twin.predictive(unseen.replace(observed=broken, mask=mask))
    whole = noisy.twin.predictive(unseen)
    np.testing.assert_array_equal(found.mean[:, :100], whole.mean[:, :100])
    assert np.all(found.deviation[:, 130] > 1.5 * whole.deviation[:, 130])
    assert np.isnan(found.pit()[:, 130]).all()
    np.testing.assert_allclose(found.mean[:, 300:], whole.mean[:, 300:], atol=0.02)


def test_the_filter_is_the_exact_conditional_of_a_linear_system() -> None:
    """Against the joint Gaussian distribution of all outputs."""
    twin = StateTwin(
        (State("a"), State("b")),
        lambda x, u: (x.a + 0.5 * x.b, x.b),
        FORCE,
        rt.Channels(("y", "z"), ("m", "m")),
        RATE,
        step=lambda x, u, p: (0.9 * x.a + 0.2 * x.b + u.force, p.pole * x.b),
        parameters=(Parameter("pole", "1", 0.0, 1.0, 0.7),),
    )
    rng, samples = np.random.default_rng(0), 6
    start, process, noise = np.array([0.5, 2.0]), np.array([0.1, 0.3]), np.array([0.2, 0.05])
    a, h = np.array([[0.9, 0.2], [0.0, 0.7]]), np.array([[1.0, 0.5], [0.0, 1.0]])
    # The covariance of the states x[j] and x[k] for j <= k is P[j] A'^(k - j).
    spread = [np.diag(start)]
    for _ in range(samples - 1):
        spread.append(a @ spread[-1] @ a.T + np.diag(process))
    joint = np.zeros((2 * samples, 2 * samples))
    for j in range(samples):
        for k in range(j, samples):
            part = h @ spread[j] @ np.linalg.matrix_power(a, k - j).T @ h.T
            joint[2 * j : 2 * j + 2, 2 * k : 2 * k + 2] = part
            joint[2 * k : 2 * k + 2, 2 * j : 2 * j + 2] = part.T
        joint[2 * j : 2 * j + 2, 2 * j : 2 * j + 2] += np.diag(noise)
    commands = rng.normal(size=(1, samples, 1))
    theta = np.array([[0.7, 0.0, 0.0]])
    centre = twin.steps().run(commands, theta)[0].ravel()
    y = centre + np.linalg.cholesky(joint) @ rng.normal(size=2 * samples)
    seen = np.ones((1, samples, 2), dtype=bool)
    seen[0, 2], seen[0, 3, 0] = False, False
    measured = (y.reshape(1, samples, 2), seen)
    known = np.diag(start)[None]
    found = twin.steps().filter(commands, theta, measured, known, (process, noise))
    mean, covariance, *_ = found
    for k in range(samples):
        earlier = np.flatnonzero(seen.ravel()[: 2 * k])
        now = np.arange(2 * k, 2 * k + 2)
        gain = joint[np.ix_(now, earlier)] @ np.linalg.inv(joint[np.ix_(earlier, earlier)])
        wanted = centre[now] + gain @ (y - centre)[earlier]
        left = joint[np.ix_(now, now)] - gain @ joint[np.ix_(earlier, now)]
        np.testing.assert_allclose(mean[0, k], wanted, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(covariance[0, k], left, rtol=1e-9, atol=1e-12)


def test_predictions_with_uncertain_parameters_are_the_exact_conditional_ones() -> None:
    """Against the joint Gaussian distribution of all outputs."""
    rng, samples = np.random.default_rng(0), 7
    noise, slopes = rng.uniform(0.1, 1.0, samples * 2), rng.normal(size=(samples * 2, 3))
    joint = np.diag(noise) + slopes @ slopes.T
    y, centre = rng.normal(size=(2, samples * 2))
    seen = rng.random(samples * 2) < 0.7
    outputs = rt.Channels(("y", "z"), ("m", "m"))
    record = rt.Trajectories(
        commands=rng.normal(size=(1, samples, 1)),
        nominal=np.zeros((1, samples, 2)),
        observed=y.reshape(1, samples, 2),
        rate=RATE,
        mask=seen.reshape(1, samples, 2),
        inputs=FORCE,
        outputs=outputs,
    )
    y = np.where(seen, record.observed.ravel(), 0.0)
    covariance = np.stack([np.diag(each) for each in noise.reshape(samples, 2)])[None]
    known = Prediction(record, centre.reshape(1, samples, 2), covariance, np.zeros((1, samples, 1)))
    found = known.marginal(slopes.reshape(1, samples, 2, 3))
    for k in range(samples):
        earlier = np.flatnonzero(seen[: 2 * k])
        now = np.arange(2 * k, 2 * k + 2)
        gain = joint[np.ix_(now, earlier)] @ np.linalg.inv(joint[np.ix_(earlier, earlier)])
        wanted = centre[now] + gain @ (y - centre)[earlier]
        np.testing.assert_allclose(found.mean[0, k], wanted, rtol=1e-9)
        left = joint[np.ix_(now, now)] - gain @ joint[np.ix_(earlier, now)]
        np.testing.assert_allclose(found.covariance[0, k], left, rtol=1e-9)


@pytest.mark.parametrize("interpolation", ["hold", "linear", "spline"])
def test_the_compiled_filter_and_process_noise_are_those_of_torch(
    interpolation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    twin, rng = replace(OSCILLATOR, interpolation=interpolation), np.random.default_rng(0)
    commands, theta = forces(2, 3, samples=40), np.tile(twin.values({"cubic": 90.0}, 1), (2, 1))
    kicks = 0.01 * rng.normal(size=(2, 40, 2))
    spread = np.tile([[0.1, 0.05], [0.05, 0.2]], (2, 1, 1))
    variances = 1e-3 * rng.random((2, 40, 2)), np.array([1e-4])

    def both() -> list[np.ndarray]:
        made = twin.steps().run(commands, theta, kicks)
        return [*made, *twin.steps().filter(commands, theta, measured, spread, variances)]

    measured = (rng.normal(size=(2, 40, 1)), rng.random((2, 40, 1)) > 0.2)
    compiled = both()
    monkeypatch.setattr(steps, "compiled", lambda source: None)
    for one, other in zip(compiled, both(), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


def test_a_saved_model_needs_no_code_of_the_twin(fitted: FittedDynamics, tmp_path) -> None:
    fitted.twin.save(tmp_path / "model")
    loaded, commands = DynamicsTwin.load(tmp_path / "model"), forces(2, 20)
    for one, other in ((fitted.twin, loaded), (loaded, fitted.twin)):
        made, again = (each.simulate(commands, seed=3) for each in (one, other))
        np.testing.assert_array_equal(made.observed, again.observed)
    unseen = record(seed=10, **TRUTH)
    mean = fitted.twin.predictive(unseen).mean
    np.testing.assert_array_equal(mean, loaded.predictive(unseen).mean)


@pytest.mark.parametrize(
    "operation",
    [["system", [], ""], ["add", [10**6, 0], ""], ["variable", [], "x[9]"], ["add", [-1, 0], ""]],
)
def test_a_forged_model_is_refused(fitted: FittedDynamics, tmp_path, operation: list) -> None:
    fitted.twin.save(tmp_path / "model")
    file = tmp_path / "model" / "model.json"
    about = json.loads(file.read_text())
    about["equations"]["operations"][3] = operation
    file.write_text(json.dumps(about))
    with pytest.raises(InputError):
        DynamicsTwin.load(tmp_path / "model")


def test_equations_come_back_from_json() -> None:
    again = equations_from(StateTwin, json.loads(json.dumps(equations_of(OSCILLATOR))))
    commands = forces(2, 5)
    made = OSCILLATOR.simulate(commands, seed=0).observed
    np.testing.assert_array_equal(again.simulate(commands, seed=0).observed, made)
    assert again.fingerprint == equations_from(StateTwin, equations_of(again)).fingerprint


def test_equations_of_lambdas_reach_worker_processes() -> None:
    twin = replace(OSCILLATOR, output=lambda x, u: x.position)
    commands = forces(2, 5)
    again = pickle.loads(pickle.dumps(twin)).simulate(commands, seed=0).observed
    np.testing.assert_array_equal(again, twin.simulate(commands, seed=0).observed)


def test_it_is_a_twin(fitted: FittedDynamics) -> None:
    subject = TwinSubject(fitted.twin, forces(4, 30, size=6.0))
    for check in TWIN_CHECKS:
        check(subject)


def test_states_beyond_their_range_are_a_warning(fitted: FittedDynamics) -> None:
    with pytest.warns(OutsideTrainingWarning, match="leaves the range"):
        fitted.twin.simulate(forces(1, 7, size=16.0), seed=0)


@pytest.mark.slow
def test_the_equations_to_correct_can_be_named() -> None:
    with pytest.warns(UserWarning, match="at a bound, and perhaps beyond it: damping"):
        found = fit_dynamics(LINEAR, record(**TRUTH), Dynamics(states=("position",)))
    assert found.twin.corrected == ("position",)
    with pytest.raises(InputError, match="states"):
        fit_dynamics(LINEAR, record(**TRUTH), Dynamics(states=("force",)))


def test_a_parameter_at_its_bound_is_a_warning() -> None:
    bounded = replace(
        OSCILLATOR, parameters=(replace(STIFFNESS, high=45.0), DAMPING, CUBIC)
    ).parametric()
    with pytest.warns(UserWarning, match="at a bound, and perhaps beyond it: stiffness"):
        found = fit_dynamics(
            bounded.holding("cubic"),
            record(stiffness=80.0, damping=0.8),
            Dynamics(Library(degree=0, knots=(), friction=False)),
        )
    assert "stiffness" in found.reason


@pytest.mark.slow
def test_noise_free_outputs_are_fitted_without_a_failure() -> None:
    exact = record(**TRUTH)
    found = fit_dynamics(LINEAR, exact.replace(observed=exact.nominal))
    assert found.figures["rms_after"] < 1e-4
    assert np.isfinite(found.twin.simulate(exact.commands, seed=0).observed).all()


def test_what_cannot_be_corrected_is_refused() -> None:
    observed = record(**TRUTH)
    function = FunctionTwin(lambda u: u, FORCE, POSITION, RATE)
    with pytest.raises(InputError, match="StateTwin"):
        fit_dynamics(function, observed)  # type: ignore[arg-type]
    short = observed.replace(
        mask=np.arange(400)[None, :, None] < np.array([3, 2, 2])[:, None, None]
    )
    with pytest.raises(InputError, match="more measured samples"):
        fit_dynamics(LINEAR, short)
    with pytest.raises(InputError, match="rate"):
        fit_dynamics(LINEAR, observed.replace(rate=10.0))
    spoilt = observed.observed.copy()
    spoilt[0, 100] = 1e9
    with pytest.raises(InputError, match="by NaN"):
        fit_dynamics(LINEAR, observed.replace(observed=spoilt))
    unstable = replace(OSCILLATOR, substeps=1, parameters=(
        Parameter("stiffness", "N/m", 10.0, 1e9, 1e8), DAMPING, CUBIC))  # fmt: skip
    with pytest.raises(InputError, match="finite"):
        fit_dynamics(unstable.parametric().holding("cubic"), observed)


def test_the_correlation_time_is_that_of_an_autoregression() -> None:
    rng, pole = np.random.default_rng(0), 0.8
    x = np.zeros((4, 20_000, 1))
    for k in range(1, x.shape[1]):
        x[:, k] = pole * x[:, k - 1] + rng.normal(size=(4, 1))
    assert correlation_time(x) == pytest.approx((1 + pole) / (1 - pole), rel=0.1)
    assert correlation_time(rng.normal(size=(4, 20_000, 1))) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_progress_ends_at_one() -> None:
    shares: list[float] = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit_dynamics(LINEAR, record(count=2, **TRUTH), progress=shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


@pytest.mark.slow
def test_the_page_of_corrected_dynamics() -> None:
    page = (Path(__file__).parents[3] / "docs" / "dynamics.md").read_text("utf-8")
    page, _, _ = page.partition("\n## State equations of a black box")
    names: dict = {"__name__": "shown"}
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(code, "docs/dynamics.md", "exec"), names)
    found = names["fitted"]
    assert found.figures["rms_after"] < 0.02 * found.figures["rms_before"]
    assert next(iter(found.terms)) == "velocity: position^3"
    assert 0.75 < names["inside"].mean() <= 1
    assert names["error"] < 0.05


def test_a_filter_that_diverges_has_no_density() -> None:
    covariance = np.ones((1, 4, 2, 2)) + np.eye(2)
    covariance[0, 1] = np.inf
    covariance[0, 2] = -np.eye(2)
    density = log_density(np.zeros((1, 4, 2)), covariance, np.ones((1, 4, 2), dtype=bool))[0]
    wanted = -np.log(2 * np.pi) - 0.5 * np.log(3)
    np.testing.assert_allclose(density, [wanted, np.nan, np.nan, wanted])
