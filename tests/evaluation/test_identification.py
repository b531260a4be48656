"""Validation of identified parameters: truth tests of errors, intervals and residual tests."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

import retwin as rt
from retwin.cases.matching import CONSTANT
from retwin.evaluation import hold_out, validate_identification
from retwin.evaluation.identification.parameters import estimates
from retwin.report.identification.texts import findings, interval_remark, state
from retwin.twins import State, StateTwin
from retwin.update.identification import MCMC, LeastSquares, Noise

LEAK, GAIN = 0.1, 0.5


def filled(
    commands: np.ndarray, gain: float = GAIN, leak: float = LEAK, spare: float = 1.0
) -> np.ndarray:
    """A first-order lag."""
    return lfilter([0, gain], [1, leak - 1], commands, axis=1)


def build(values: dict[str, float]) -> rt.FunctionTwin:
    channels = rt.Channels(("u",), ("V",)), rt.Channels(("y",), ("m",))
    return rt.FunctionTwin(partial(filled, **values), *channels, 1.0)


def twin_with(*names: str) -> rt.ParametricTwin:
    """The lag, with some parameters free."""
    ends = {"gain": (0.1, 1.0, 0.3), "leak": (0.02, 0.3, 0.2), "spare": (0.0, 2.0, 1.0)}
    return rt.ParametricTwin.built(build, [rt.Parameter(name, "1", *ends[name]) for name in names])


def measured(
    seed: int, count: int = 1, steps: int = 300, *, memory: float = 0.0, noise: float = 0.2
) -> rt.Trajectories:
    """Trajectories of the lag with autoregressive noise."""
    rng = np.random.default_rng(seed)
    levels = rng.uniform(-1, 1, (count, steps // 10 + 1))
    commands = np.repeat(levels, 10, axis=1)[:, :steps, None]
    made = build({}).simulate(commands, seed=0)
    white = rng.normal(size=(count, steps + 50, 1)) * noise * np.sqrt(1 - memory**2)
    return made.replace(observed=made.nominal + lfilter([1], [1, -memory], white, axis=1)[:, 50:])


def checked(
    data: rt.Trajectories, *names: str, share: float = 0.25
) -> rt.evaluation.Identification:
    twin = twin_with(*names)
    used, held = hold_out(data, share, seed=0)
    found = rt.identify(twin, used, LeastSquares(starts=2), seed=0)
    return validate_identification(found, twin, used, held)


def test_whole_trajectories_are_held_out_where_there_are_enough() -> None:
    data = measured(0, count=8)
    used, held = hold_out(data, 0.25, seed=1)
    assert held is not None
    assert (len(used), len(held)) == (6, 2)
    assert set(used.ids) | set(held.ids) == set(data.ids)
    assert hold_out(data, 0.25, seed=1)[1].ids.tolist() == held.ids.tolist()  # type: ignore[union-attr]
    four, one = hold_out(data[:4], 0.5, seed=1)
    assert (len(four), len(one)) == (3, 1)  # type: ignore[arg-type]


def test_of_few_trajectories_the_end_is_held_out_and_padding_is_not_counted() -> None:
    data = rt.Trajectories.concatenate([measured(0, steps=200), measured(1, steps=100)])
    used, held = hold_out(data, 0.25, seed=0)
    assert held is not None
    assert used.mask.sum(axis=(1, 2)).tolist() == [150, 75]
    assert held.mask.sum(axis=(1, 2)).tolist() == [50, 25]
    assert not (used.mask & held.mask).any()
    np.testing.assert_array_equal(used.commands, held.commands)


def test_nothing_held_out_is_said() -> None:
    data = measured(0)
    assert hold_out(data, 0.0, seed=0) == (data, None)
    with pytest.raises(rt.InputError, match="from 0 to below 1"):
        hold_out(data, 1.0, seed=0)
    found = checked(data, "gain", share=0.0)
    assert (found.split, found.compared) == ("none", "identification")
    assert found.outputs[0].validation is None


def test_errors_are_those_of_free_simulation_in_the_outputs_unit() -> None:
    found = checked(measured(2, count=8, noise=0.05), "gain", "leak")
    (output,) = found.outputs
    assert output.validation is not None
    assert output.unit == "m"
    data, before, after = found.simulated["validation"]
    rms = [np.sqrt(np.mean((data.observed - each) ** 2)) for each in (before, after)]
    assert [output.validation.before, output.validation.after] == pytest.approx(rms)
    assert output.validation.after == pytest.approx(0.05, rel=0.2)
    assert output.validation.interval is not None
    assert output.validation.interval[1] < 1


@pytest.mark.slow
def test_standard_errors_from_one_record_hold_for_autoregressive_noise() -> None:
    """The number of intervals that contain the truth, within limits missed once in 1000."""
    count, inside = 40, 0
    for seed in range(count):
        found = checked(measured(seed, memory=0.8), "gain", share=0.0)
        assert found.basis == "samples"
        low, high = found.parameters[0].interval  # type: ignore[misc]
        inside += low < GAIN < high
    assert binom.ppf(0.0005, count, 0.95) <= inside


def test_records_that_begin_in_another_state_are_named() -> None:
    data = measured(12, count=4, noise=0.01)
    moved = data.observed + 3.0 * 0.9 ** np.arange(data.steps)[:, None]
    for observed, named in ((data.observed, False), (moved, True)):
        found = checked(data.replace(observed=observed), "gain")
        assert (found.begin_errors["y"] > 2) == named
        assert any("did not begin in the state" in each for each in findings(found)) == named


@pytest.mark.parametrize("states", [False, True])
def test_a_horizon_is_advised_where_it_can_be_given(*, states: bool) -> None:
    """Outputs of the other sign are predicted worse than by their mean."""
    data, twin = measured(4, count=4), twin_with("gain")
    data = data.replace(observed=-data.observed)
    if states:
        level = (State("level", "m", 0.0),)
        equations = StateTwin(
            level,
            lambda x, u, p: x.level,
            twin.inputs,
            twin.outputs,
            1.0,
            derivative=lambda x, u, p: (p.gain * u.u - LEAK * x.level,),
            parameters=[rt.Parameter("gain", "1", 0.1, 1.0, 0.3)],
        )
        twin = rt.ParametricTwin(equations, equations.parameters)
    with pytest.warns(UserWarning, match="at a bound: gain"):
        found = rt.identify(twin, data, LeastSquares(starts=1), seed=0, horizon=np.inf)
    said = " ".join(findings(validate_identification(found, twin, data)))
    assert "worse than the record's mean" in said
    assert ("such as --horizon 30s" in said) is states
    assert ("--horizon" in said) is states


def test_a_parameter_without_effect_is_an_open_direction() -> None:
    with pytest.warns(UserWarning, match="not identified: spare"):
        found = checked(measured(3), "gain", "spare")
    assert found.open_parameters == ("spare",)
    assert found.parameters[1].value == 1.0, "it stays, whatever the starts of the search were"
    last = found.directions[-1]
    assert (last.open, list(last.components)) == (True, ["spare"])
    assert np.isinf(last.error)
    assert not found.directions[0].open


@pytest.mark.parametrize(
    ("interval", "side", "identified", "said"),
    [
        ((0.2, 0.4), "", True, ""),
        ((0.2, 0.8), "", False, "not identified: interval covers 60 % of the range"),
        ((-0.05, 0.07), "", False, "not identified: its interval reaches an end of its range"),
        ((0.9, 1.3), "", False, "not identified: its interval reaches an end of its range"),
        (
            (-3.0, 4.0),
            "",
            False,
            "not identified: interval covers 100 % of the range and leaves it",
        ),
        ((0.0, 0.002), "", False, "not identified: its interval reaches an end of its range"),
        ((0.99, 1.0), "high", False, "at its upper bound"),
    ],
)
def test_a_parameter_is_identified_if_its_interval_is_within_half_of_its_range_and_not_at_an_end(
    interval: tuple[float, float], side: str, identified: bool, said: str
) -> None:
    twin = rt.ParametricTwin.built(build, [rt.Parameter("gain", "1", 0.0, 1.0, 0.5)])
    middle, half = sum(interval) / 2, (interval[1] - interval[0]) / 2
    ends, one = np.array([interval]), np.array([half / 2])
    (made,) = estimates(twin, np.array([middle]), one, ends, np.array([True]), [side], bounded=True)
    assert (made.identified, state(made)) == (identified, said)
    (other,) = estimates(twin, np.array([middle]), one, ends, np.array([False]), [side])
    assert not other.identified, "starts disagree"
    assert state(other)


def test_an_interval_that_leaves_a_positive_range_is_named() -> None:
    """Noise hides a small coupling: the estimate is inside its range, its interval is not."""
    coupled = np.random.default_rng(8).normal(size=(5, 60, 1))

    def made(values: dict[str, float]) -> rt.FunctionTwin:
        own = build({})
        return replace(own, function=lambda u: values["coupling"] * u)

    twin = rt.ParametricTwin.built(made, [rt.Parameter("coupling", "1", 0.0, 1.0, 0.5)])
    data = twin.simulate(coupled, parameters={"coupling": 0.05}, seed=0)
    noise = np.random.default_rng(9).normal(size=coupled.shape)
    found = rt.identify(twin, data.replace(observed=data.observed + noise), seed=0)
    checked = validate_identification(found, twin, data)
    (coupling,) = checked.parameters
    assert coupling.interval is not None
    assert coupling.interval[0] < 0 < coupling.value
    assert checked.open_parameters == ("coupling",)
    assert state(coupling) == "not identified: its interval reaches an end of its range"
    texts = findings(checked)
    assert any(
        "it reaches 0, at which its range begins" in each.replace("\n", " ") for each in texts
    )
    assert not any("do not determine" in each for each in texts)


def test_residuals_of_a_right_twin_are_white_and_of_a_wrong_one_follow_the_command() -> None:
    right = checked(measured(4, steps=4000), "gain", "leak")
    (test,) = right.residuals
    assert test.p_white > 1e-3
    assert test.inputs[0].p_value > 1e-3
    assert not interval_remark(right)
    data = measured(4, steps=4000, noise=0.05)
    slow = lfilter([0.1], [1, -0.9], data.observed, axis=1)  # a second lag, which the twin lacks
    wrong = checked(data.replace(observed=slow), "gain")
    (test,) = wrong.residuals
    assert test.p_white < 1e-6
    assert test.inputs[0].p_value < 1e-3
    assert "physical values may lie outside" in interval_remark(wrong)


def test_what_says_that_a_log_shows_nothing_follows_the_errors() -> None:
    """Where two parameters are at bounds and the mean fits as well, records are to be checked."""
    data = measured(4, steps=200)
    with pytest.warns(UserWarning, match="at a bound: gain, leak"):
        found = checked(data.replace(observed=-1000 * data.observed), "gain", "leak")
    assert len(found.at_bound) == 2
    note = f"u: {CONSTANT}"
    error, *texts = findings(found, ["a.csv: times in column t.", note])
    assert "the RMS error of y" in error
    assert texts[0] == note
    assert texts[1].endswith("check units and columns.")
    assert not any("times in column" in each for each in texts)


def test_exact_measurements_give_no_test_and_no_warning() -> None:
    found = checked(measured(5, noise=0.0), "gain")
    assert np.isnan(found.residuals[0].p_white)
    assert found.parameters[0].value == pytest.approx(GAIN, abs=1e-5)


@pytest.mark.slow
def test_a_posterior_is_summarised_by_its_draws() -> None:
    pytest.importorskip("emcee")
    twin = twin_with("gain", "spare")
    data = measured(6, steps=120)
    method = MCMC(walkers=12, steps=120, warm_up=60, starts=1, noise=Noise(discrepancy=False))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # short chains
        posterior = rt.identify(twin, data, method, seed=0)
    found = validate_identification(posterior, twin, data)
    assert found.basis == "posterior"
    gain, spare = found.parameters
    assert gain.value == pytest.approx(posterior.mean["gain"])
    assert gain.error == pytest.approx(posterior.deviation["gain"])
    assert (gain.identified, spare.identified) == (True, False)
    assert found.directions[-1].open
    assert next(iter(found.directions[-1].components)) == "spare"


def diverging(values: dict[str, float]) -> rt.FunctionTwin:
    """The lag, which gives no numbers for fast leaks."""
    made = build(values)
    if values["leak"] > 0.15:
        return replace(made, function=lambda commands: np.full_like(commands, np.nan))
    return made


def test_values_at_which_a_function_is_not_finite_are_left() -> None:
    """From the starts of the search some are within that range, and the optimum is not."""
    data = measured(7, noise=0.05)
    ends = [rt.Parameter("leak", "1", 0.02, 0.3, 0.03)]
    found = rt.identify(rt.ParametricTwin.built(diverging, ends), data, seed=0)
    assert found.values["leak"] == pytest.approx(LEAK, rel=0.02)
    ends = [rt.Parameter("leak", "1", 0.02, 0.3, 0.2)]
    with pytest.raises(rt.InputError, match="return finite numbers, got nan for y"):
        rt.identify(rt.ParametricTwin.built(diverging, ends), data, seed=0)


def test_a_result_of_another_twin_is_refused() -> None:
    data = measured(0)
    found = rt.identify(twin_with("gain"), data, LeastSquares(starts=1), seed=0)
    with pytest.raises(rt.InputError, match="the twin with the parameters gain"):
        validate_identification(found, twin_with("leak"), data)
    with pytest.raises(rt.InputError, match=r"give what rt\.identify returned"):
        validate_identification(data, twin_with("leak"), data)  # type: ignore[arg-type]
