"""Corrected dynamics of unusual twins and records: an answer that is finite, or a refusal."""

from __future__ import annotations

import numpy as np
import pytest
from safetensors.torch import load_file, save_file

import retwin as rt
from retwin.twins import Parameter, State, StateTwin
from retwin.update import Dynamics, DynamicsTwin, Library, fit_dynamics
from retwin.update.training_range import OutsideTrainingWarning

pytestmark = pytest.mark.slow

INPUT = rt.Channels(("u",), ("V",))
OUTPUT = rt.Channels(("y",), ("m",))
STATE = State("x", "m")
QUICK = Dynamics(library=Library(1, (), False))
RNG = np.random.default_rng(0)
COMMANDS = np.cumsum(RNG.normal(size=(2, 120, 1)), axis=1) / 5


def measured(twin: StateTwin, deviation: float = 1e-3) -> rt.Trajectories:
    made = twin.simulate(COMMANDS, seed=0)
    noise = deviation * np.random.default_rng(1).normal(size=made.observed.shape)
    return made.replace(observed=made.observed + noise)


def lag(derivative, *parameters: Parameter, start: State = STATE) -> StateTwin:
    return StateTwin(
        (start,),
        lambda x, u: x.x,
        INPUT,
        OUTPUT,
        20.0,
        derivative=derivative,
        parameters=parameters,
    )


def is_finite(twin: DynamicsTwin) -> bool:
    simulated = twin.simulate(COMMANDS, seed=0)
    return bool(np.isfinite(twin.widening).all() and np.isfinite(simulated.observed).all())


def test_a_twin_without_free_parameters_is_corrected() -> None:
    known = lag(lambda x, u: (u.u - 2 * x.x,))
    found = fit_dynamics(known, measured(lag(lambda x, u: (u.u - 3 * x.x,))))
    assert found.parameters == {}
    assert found.figures["rms_after"] < 1.1e-3 < 10e-3 < found.figures["rms_before"]


def test_a_twin_whose_parameters_explain_every_term_is_fitted() -> None:
    twin = lag(lambda x, u, p: (u.u - 2 * x.x + p.offset,), Parameter("offset", "m/s", -1, 1, 0.1))
    found = fit_dynamics(twin, measured(twin), Dynamics(library=Library(0, (), False)))
    assert found.terms == {}
    assert is_finite(found.twin)


@pytest.mark.slow
def test_an_exact_twin_and_exact_outputs_have_finite_bands() -> None:
    twin = lag(lambda x, u, p: (u.u - p.rate * x.x,), Parameter("rate", "1/s", 0.1, 9.0, 2.0))
    record = measured(twin, deviation=0.0)
    found = fit_dynamics(twin, record, QUICK)
    assert is_finite(found.twin)
    assert np.isfinite(found.twin.predictive(record).covariance).all()


@pytest.mark.parametrize("level", [0.0, 0.1])
def test_an_output_that_never_changes_is_fitted(level: float) -> None:
    twin = lag(
        lambda x, u, p: (p.rate * (level - x.x) + 0 * u.u,),
        Parameter("rate", "1/s", 0.1, 9.0, 2.0),
        start=State("x", "m", level),
    )
    with pytest.warns(UserWarning, match="not determined by the record: rate"):
        found = fit_dynamics(twin, measured(twin, deviation=0.0), QUICK)
    assert is_finite(found.twin)


def test_a_machine_at_rest_is_fitted() -> None:
    """No command ever moves it: nothing acts at the start of the search, and something later."""
    twin = lag(lambda x, u, p: (u.u - p.rate * x.x,), Parameter("rate", "1/s", 0.1, 9.0, 2.0))
    record = twin.simulate(0 * COMMANDS, seed=0)
    noise = 0.01 * np.random.default_rng(1).normal(size=record.observed.shape)
    with pytest.warns(UserWarning, match="rate"):
        found = fit_dynamics(twin, record.replace(observed=record.observed + noise), QUICK)
    assert np.isfinite(found.twin.widening).all()
    assert found.figures["rms_after"] < 0.011


def test_an_output_that_was_never_measured_is_refused() -> None:
    twin = StateTwin(
        (State("x", "m"),),
        lambda x, u: (x.x, 2 * x.x),
        INPUT,
        rt.Channels(("y", "z"), ("m", "V")),
        20.0,
        derivative=lambda x, u: (u.u - 2 * x.x,),
    )
    record = measured(twin)
    mask = np.ones(record.observed.shape, dtype=bool)
    mask[..., 1] = False
    with pytest.raises(rt.InputError, match="every output, got none of z"):
        fit_dynamics(twin, record.replace(mask=mask), QUICK)


@pytest.mark.slow
def test_a_start_at_its_bound_is_a_warning() -> None:
    def slope(x, u):
        return (u.u - 2 * x.x,)

    narrow = lag(slope, start=State("x", "m", 0.0, -0.1, 0.1))
    with pytest.warns(UserWarning, match="at a bound.*start_x"):
        found = fit_dynamics(narrow, measured(lag(slope, start=State("x", "m", 0.8))), QUICK)
    assert "start_x" in found.reason


def test_parameters_that_the_record_does_not_determine_have_no_error_of_zero() -> None:
    def slope(x, u, p):
        return (p.gain * p.scale * u.u - p.rate * x.x + 0 * p.idle,)

    names = {"rate": 2.0, "gain": 1.0, "scale": 1.0, "idle": 1.0}
    twin = lag(slope, *(Parameter(name, "1", 0.1, 9.0, value) for name, value in names.items()))
    with pytest.warns(UserWarning, match="not determined by the record: gain, scale, idle"):
        found = fit_dynamics(twin, measured(twin), QUICK)
    assert np.isinf([found.errors[name] for name in ("gain", "scale", "idle")]).all()
    assert 0 < found.errors["rate"] < 0.1
    assert is_finite(found.twin)


def test_errors_at_the_edges_are_relative_to_the_whole_range() -> None:
    """With outputs in two units; where one is at its end, it does not vary much."""
    twin = StateTwin(
        (STATE,),
        lambda x, u: (x.x, 2 * x.x),
        INPUT,
        rt.Channels(("y", "z"), ("m", "V")),
        20.0,
        derivative=lambda x, u, p: (u.u - p.rate * x.x,),
        parameters=(Parameter("rate", "1/s", 0.1, 9.0, 2.0),),
    )
    figures = fit_dynamics(twin, measured(twin, 0.01), QUICK).figures
    assert figures["held_out_edges"] == pytest.approx(figures["held_out"], rel=0.2)


HIDDEN = {"pole": 0.8, "gain": 0.4, "mix": 0.3}
"""Parameters of a system whose hidden state may have any scale."""


def hidden_state(missing: float = 0.0) -> StateTwin:
    """A hidden state of which only the product of what leads to it and from it shows."""

    def step(x, u, p):
        own = p.pole * x.a + p.gain * u.u + missing * x.a**2
        return own, 0.9 * x.b + p.mix * x.a

    ranges = {"pole": (0.1, 0.99, 0.7), "gain": (0.01, 5, 0.5), "mix": (0.01, 2, 0.3)}
    return StateTwin(
        (State("a", "1"), State("b", "1")),
        lambda x, u: x.b,
        rt.Channels(("u",), ("1",)),
        rt.Channels(("b",), ("1",)),
        1.0,
        step=step,
        parameters=[Parameter(name, "1", *each) for name, each in ranges.items()],
    )


def hidden_record(seed: int, missing: float = 0.0) -> rt.Trajectories:
    """One record, with noise of 0.02."""
    rng = np.random.default_rng(seed)
    commands = np.repeat(rng.uniform(-2, 2, size=(1, 200, 1)), 5, axis=1)
    made = hidden_state(missing).simulate(commands, seed=0, parameters=HIDDEN)
    return made.replace(observed=made.observed + 0.02 * rng.normal(size=made.observed.shape))


CONSTANT = Dynamics(library=Library(0, (), False), memory=False)


def test_what_is_not_determined_is_no_noise() -> None:
    """A step along it to the estimates without a part is rounding, and would seem to be noise."""
    with pytest.warns(UserWarning, match="not determined by the record: gain, mix"):
        found = fit_dynamics(hidden_state(), hidden_record(4), CONSTANT)
    assert np.sqrt(found.twin.noise[0]) > 0.01


def test_what_only_one_part_determines_is_no_noise() -> None:
    """The transient at the begin alone separates two constants, and is predicted without them."""
    with pytest.warns(UserWarning, match="not determined by the record: gain, mix"):
        found = fit_dynamics(hidden_state(), hidden_record(5), CONSTANT)
    assert np.sqrt(found.twin.noise[0]) == pytest.approx(0.02, rel=0.1)
    errors = found.twin.predictive(hidden_record(5)).whiteness()[0][0]
    assert np.abs(errors.values[errors.largest]) < 0.1


@pytest.mark.parametrize("seed", [1, 3])
def test_a_discrepancy_does_not_determine_what_the_twin_leaves_open(seed: int) -> None:
    """By its prior alone, it would give a hidden state a scale, and that a small error."""
    curved = Dynamics(library=Library(2, (), False), memory=False)
    with pytest.warns(UserWarning, match="not determined by the record: gain, mix"):
        found = fit_dynamics(hidden_state(), hidden_record(seed, missing=0.015), curved)
    assert np.isinf([found.errors["gain"], found.errors["mix"]]).all()
    assert found.parameters["pole"] == pytest.approx(0.8, abs=4 * found.errors["pole"])
    assert found.figures["rms_after"] < 0.021 < 0.2 < found.figures["rms_before"]


@pytest.mark.parametrize("level", [-2e-6, 0.0, 1e5])
def test_a_command_that_was_constant_may_change_a_little_in_any_unit(level: float) -> None:
    twin = StateTwin(
        (STATE,),
        lambda x, u: x.x,
        rt.Channels(("u", "ambient"), ("V", "kg/s")),
        OUTPUT,
        20.0,
        derivative=lambda x, u: (u.u - 2 * x.x + u.ambient / (abs(level) or 1.0),),
    )
    commands = np.concatenate([COMMANDS, np.full(COMMANDS.shape, level)], axis=2)
    made = twin.simulate(commands, seed=0)
    found = fit_dynamics(
        twin, made.replace(observed=made.observed + 1e-3 * RNG.normal(size=(2, 120, 1))), QUICK
    ).twin
    change = np.array([0.0, abs(level) or 1.0])
    assert not found.outside(commands + 0.04 * change).any()
    assert found.outside(commands + 0.06 * change).all()
    with pytest.warns(OutsideTrainingWarning, match="ambient leaves the range"):
        found.simulate(commands + change, seed=0)


@pytest.fixture(scope="module")
def fitted() -> DynamicsTwin:
    known = lag(lambda x, u: (u.u - 2 * x.x,))
    return fit_dynamics(known, measured(known), QUICK).twin


def test_predictions_that_are_not_finite_are_refused() -> None:
    unstable = lag(lambda x, u: (u.u - 2 * x.x + 0.01 * x.x**3,))
    record = measured(unstable)
    grown = fit_dynamics(unstable, record, QUICK).twin
    with pytest.raises(rt.InputError, match=r"trajectories \[0, 1\] with which it does not"):
        grown.predictive(record.replace(commands=1e60 + 0 * COMMANDS))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("noise", -1.0),
        ("noise", 0.0),
        ("process", -1.0),
        ("widening", -1.0),
        ("widening", np.nan),
        ("start_deviation", -1.0),
        ("domain_low", np.nan),
        ("domain_low", 1e9),
        ("domain_mean", np.nan),
        ("domain_mean", 1e9),
        ("domain_speed", np.nan),
    ],
)
def test_forged_weights_are_refused(fitted: DynamicsTwin, tmp_path, name: str, value) -> None:
    fitted.save(tmp_path / "model")
    file = tmp_path / "model" / "weights.safetensors"
    weights = load_file(file)
    weights[name] = weights[name].clone().fill_(value)
    save_file(weights, file)
    with pytest.raises(rt.InputError):
        DynamicsTwin.load(tmp_path / "model")


def test_bands_are_scaled_for_each_output() -> None:
    """Noise of one output has far outliers: with its variance, bands would be too wide there."""
    twin = StateTwin(
        (State("x", "m"), State("z", "m")),
        lambda x, u: (x.x, x.z),
        INPUT,
        rt.Channels(("x", "z"), ("m", "m")),
        20.0,
        derivative=lambda x, u, p: (u.u - p.rate * x.x, u.u - 2 * x.z),
        parameters=(Parameter("rate", "1/s", 0.1, 9.0, 2.0),),
    )
    rng = np.random.default_rng(3)
    commands = np.clip(np.cumsum(rng.normal(size=(12, 300, 1)), axis=1) / 3, -1, 1)
    outliers = rng.standard_t(2.5, size=(12, 300))
    noise = 1e-3 * np.stack([rng.normal(size=(12, 300)), outliers], axis=2)
    made = twin.simulate(commands, seed=0)
    real = made.replace(observed=made.observed + noise)
    found = fit_dynamics(twin, real[np.arange(6)], QUICK)
    names = ("widening_x", "widening_z")
    np.testing.assert_array_equal([found.figures[name] for name in names], found.twin.widening)
    draws = found.twin.simulate(np.repeat(commands[6:], 200, axis=0), seed=0).observed
    low, high = np.quantile(draws.reshape(6, 200, 300, 2), [0.05, 0.95], axis=1)
    inside = (low <= real.observed[6:]) & (real.observed[6:] <= high)
    np.testing.assert_allclose(inside.mean(axis=(0, 1)), 0.9, atol=0.03)


@pytest.mark.parametrize(
    ("argument", "value"), [("library", {"degree": 2}), ("states", "x"), ("states", ("x", "x"))]
)
def test_wrong_settings_are_refused(argument: str, value) -> None:
    with pytest.raises(rt.InputError, match=f"^{argument}: "):
        Dynamics(**{argument: value})
