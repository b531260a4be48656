"""Eq. 2: known parameters are found again, and those that are not identified are named."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import pytest
from toys import AFFINE, LAG, LINE, PRODUCT, commands, lag, line, measured, parametric

import retwin as rt
from retwin.cases.armpi_fpv.twin import armpi_parametric
from retwin.evaluation.identification.validation import validate_identification
from retwin.testing import TWIN_CHECKS, TwinSubject
from retwin.twins import State, StateTwin
from retwin.update.identification import Evolution, LeastSquares, identify, profile
from retwin.update.identification.misfit import misfit_of
from retwin.update.identification.search import Loss, Search

GAIN, SHARE = 1.7, 0.8


@pytest.mark.parametrize("method", [LeastSquares(starts=3), Evolution(5, 10)])
def test_known_parameters_are_found_within_their_errors(method) -> None:
    observed = measured(LAG, 0.05, seed=1, gain=GAIN, share=SHARE)
    updated = identify(LAG, observed, seed=0, method=method)
    for name, true in (("gain", GAIN), ("share", SHARE)):
        assert abs(updated.values[name] - true) < 3 * updated.errors[name] < 0.1
        assert updated.intervals[name][0] < true < updated.intervals[name][1]
    assert updated.identifiability.identified.all()
    assert updated.figures["rms_after"] == pytest.approx(0.05, rel=0.15)
    assert updated.figures["rms_before"] > 4 * updated.figures["rms_after"]
    residual = observed.observed - updated.twin.simulate(observed.commands, seed=0).observed
    assert updated.objective == pytest.approx(np.linalg.norm(residual))


@pytest.mark.parametrize("unit", [1e-12, 1e-9, 1e9])
def test_the_unit_of_the_outputs_does_not_matter(unit: float) -> None:
    found = {}
    for each in (1.0, unit):
        twin = parametric(lag, gain=(0.1 * each, 5.0 * each), share=(0.1, 0.98))
        observed = measured(twin, 0.05 * each, seed=1, gain=GAIN * each, share=SHARE)
        updated = identify(twin, observed, seed=0, method=LeastSquares(starts=2))
        assert updated.identifiability.identified.all()
        found[each] = [
            number * scale
            for name, scale in (("gain", 1 / each), ("share", 1.0))
            for number in (updated.values[name], *updated.intervals[name])
        ]
    assert found[unit] == pytest.approx(found[1.0], rel=1e-5)


def test_standard_errors_are_those_of_the_linear_model() -> None:
    observed = measured(LINE, 0.2, seed=2, a=1.0, b=-0.5)
    updated = identify(LINE, observed, seed=0, method=LeastSquares(2, "linear"))
    design = observed.commands.reshape(-1, 2)
    best, rest, *_ = np.linalg.lstsq(design, observed.observed.ravel())
    assert list(updated.values.values()) == pytest.approx(best, abs=1e-5)
    variance = rest[0] / (len(design) - 2) * np.linalg.inv(design.T @ design)
    # Beyond the formula, an error may only allow for what looks like correlated noise.
    ratio = updated.identifiability.errors / np.sqrt(np.diag(variance))
    assert (ratio >= 0.999).all()
    assert (ratio < 1.2).all()


def persistent(count: int, seed: int, kind: str) -> rt.Trajectories:
    """Data of `AFFINE` with errors that are independent, or persist where `kind` says."""
    rng = np.random.default_rng([1, seed])
    made = AFFINE.with_values({"a": 1.0, "b": -0.5}).simulate(commands(count, seed=seed), seed=0)
    every = {"sample": 1, "segment": 10, "trajectory": 60}[kind]
    errors = np.repeat(rng.normal(size=(count, 60 // every, 1)), every, axis=1)
    noise = 0.5 * errors + 0.1 * rng.normal(size=errors.shape)
    return made.replace(observed=made.observed + noise)


def share_inside(count: int, kind: str, loss: Loss, seeds: int) -> float:
    """Share of the 95 % intervals that hold the true parameter."""
    inside = []
    for seed in range(seeds):
        observed = persistent(count, seed, kind)
        updated = identify(AFFINE, observed, seed=0, method=LeastSquares(1, loss))
        for name, true in (("a", 1.0), ("b", -0.5)):
            low, high = updated.intervals[name]
            inside.append(low <= true <= high)
    return float(np.mean(inside))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sample", "trajectory"])
def test_intervals_hold_the_truth_as_often_as_they_should(kind: str) -> None:
    """Of 60 intervals at least 50: with independent ones that fails once in 10,000 times."""
    assert share_inside(4, kind, "soft_l1", seeds=30) >= 50 / 60


@pytest.mark.long
@pytest.mark.parametrize("loss", ["linear", "soft_l1"])
@pytest.mark.parametrize("kind", ["sample", "segment", "trajectory"])
@pytest.mark.parametrize("count", [3, 4, 6, 10])
def test_intervals_hold_from_any_number_of_trajectories(count: int, kind: str, loss: Loss) -> None:
    assert 0.92 <= share_inside(count, kind, loss, seeds=500) <= 0.985


def test_a_trajectory_that_alone_determines_a_parameter_gives_no_standard_error() -> None:
    observed = persistent(4, 0, "sample")
    still = observed.commands.copy()
    still[1:, :, 0] = 0.0
    made = AFFINE.with_values({"a": 1.0, "b": -0.5}).simulate(still, seed=0)
    updated = identify(AFFINE, made, seed=0, method=LeastSquares(1))
    assert np.isnan(updated.errors["a"])
    assert "of which one alone determines a parameter" in updated.reason


def test_two_trajectories_give_no_standard_errors() -> None:
    updated = identify(AFFINE, persistent(2, 0, "sample"), seed=0, method=LeastSquares(1))
    assert np.isnan(list(updated.errors.values())).all()
    assert "no standard errors can be given from 2 trajectories" in updated.reason
    assert np.isfinite(updated.identifiability.errors).all()


def test_trajectories_without_a_measurement_are_named_and_are_no_evidence() -> None:
    """Counted among twelve, three measured ones had intervals half as wide as alone."""
    three, every = persistent(3, 0, "segment"), persistent(12, 0, "segment")
    observed = every.observed.copy()
    observed[:3], observed[3:] = three.observed, np.nan
    commands = every.commands.copy()
    commands[:3] = three.commands
    method = LeastSquares(1)
    alone = identify(AFFINE, three, seed=0, method=method)
    padded = every.replace(observed=observed, mask=np.isfinite(observed), commands=commands)
    with pytest.warns(UserWarning, match="nothing was measured in 00003, 00004"):
        updated = identify(AFFINE, padded, seed=0, method=method)
    assert updated.errors == pytest.approx(alone.errors)
    assert updated.intervals["a"] == pytest.approx(alone.intervals["a"])
    assert "nothing was measured in 00003" in updated.reason


def test_a_value_that_stands_for_a_missing_measurement_is_refused() -> None:
    observed = measured(LAG, 0.05, seed=1, gain=GAIN, share=SHARE)
    spoilt = observed.observed.copy()
    spoilt[0, 30] = 1e9
    with pytest.raises(rt.InputError, match=r"got 1e\+09 of .* by NaN"):
        identify(LAG, observed.replace(observed=spoilt), seed=0)


def test_a_product_of_two_parameters_is_not_identified() -> None:
    observed = measured(PRODUCT, 0.05, seed=3, a=1.2, b=0.9)
    with pytest.warns(UserWarning, match="not identified: a, b"):
        updated = identify(PRODUCT, observed, seed=0, method=LeastSquares(starts=4))
    assert not updated.identifiability.identified.any()
    assert updated.values["a"] * updated.values["b"] == pytest.approx(1.08, abs=0.03)
    assert np.isinf(updated.errors["a"])
    assert "not identified" in updated.reason


@pytest.mark.parametrize("effect", [0.0, 1e-6, 1e-3])
def test_a_parameter_that_hardly_changes_the_outputs_keeps_its_value(effect: float) -> None:
    def decayed(commands: np.ndarray, a: float, b: float, start: float) -> np.ndarray:
        # What is left of a start when the first measurement is used.
        return (
            line(commands, a, b) + effect * start * np.exp(-np.arange(commands.shape[-2]))[:, None]
        )

    twin = parametric(decayed, a=(-3.0, 5.0), b=(-4.0, 4.0), start=(0.0, 4.0))
    observed = measured(twin, 0.05, seed=3, a=1.2, b=0.9, start=3.0)
    with pytest.warns(UserWarning, match="not identified: start"):
        updated = identify(twin, observed, seed=0, method=LeastSquares(starts=4))
    assert updated.values["start"] == twin.values[2] == 2.0
    assert updated.values["a"] == pytest.approx(1.2, abs=0.05)
    assert not updated.identifiability.at_bound.any()


def test_a_best_value_on_a_bound_is_reported() -> None:
    narrow = parametric(lag, gain=(0.1, 1.0), share=(0.1, 0.98))
    observed = measured(LAG, 0.05, seed=4, gain=GAIN, share=SHARE)
    with pytest.warns(UserWarning, match="at a bound: gain"):
        updated = identify(narrow, observed, seed=0, method=LeastSquares(starts=2))
    assert updated.values["gain"] == pytest.approx(1.0, abs=1e-2)


def test_values_that_depend_on_a_bound_are_not_identified() -> None:
    """The gain is 1.3 where the range ends at 1: the share of the lag is wrong by it."""
    narrow = parametric(lag, gain=(0.1, 1.0), share=(0.1, 0.98))
    observed = measured(LAG, 0.01, seed=4, gain=1.3, share=SHARE)
    with pytest.warns(UserWarning, match="values that depend on this bound: share"):
        found = identify(narrow, observed, seed=0, method=LeastSquares(starts=2))
    assert abs(found.values["share"] - SHARE) > 0.04
    assert found.identifiability.depends.tolist() == [False, True]
    assert not found.identifiability.identified[1]


@pytest.mark.slow
def test_a_true_value_on_a_bound_leaves_the_others_identified() -> None:
    narrow = parametric(lag, gain=(0.1, 1.0), share=(0.1, 0.98))
    depends = []
    for seed in range(30):
        observed = measured(LAG, 0.05, seed=seed, gain=1.0, share=SHARE)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = identify(narrow, observed, seed=0, method=LeastSquares(starts=1))
        depends.append(found.identifiability.depends[1])
    assert sum(depends) <= 4  # at most 5 % are expected; five of 30 have a probability of 1.6 %


def test_a_robust_loss_forgives_outliers_and_a_mask_hides_them() -> None:
    clean = measured(LAG, 0.02, seed=5, gain=GAIN, share=SHARE)
    spoilt = clean.observed.copy()
    spoilt[0, 20:35] += 8.0
    observed = clean.replace(observed=spoilt)

    def gain(data: rt.Trajectories, loss: str) -> float:
        method = LeastSquares(starts=2, loss=loss)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return identify(LAG, data, seed=0, method=method).values["gain"]

    assert abs(gain(observed, "linear") - GAIN) > 0.1
    assert gain(observed, "cauchy") == pytest.approx(GAIN, abs=0.02)
    seen = np.ones_like(clean.mask)
    seen[0, 20:35] = False
    assert gain(observed.replace(mask=seen), "linear") == pytest.approx(GAIN, abs=0.02)


@pytest.mark.parametrize(("loss", "exact"), [("linear", 1e-2), ("soft_l1", 0.15)])
def test_profile_is_the_parabola_of_the_linear_model(loss: Loss, exact: float) -> None:
    observed = measured(LINE, 0.2, seed=6, a=1.0, b=-0.5)
    updated = identify(LINE, observed, seed=0, method=LeastSquares(1, loss))
    found = profile(updated, observed, "a", points=7)
    wanted = ((found.values - updated.values["a"]) / updated.errors["a"]) ** 2
    assert found.rise == pytest.approx(wanted, rel=exact, abs=1e-3)
    low, high = found.interval
    half = np.diff(updated.intervals["a"]) / 2
    assert (high - low) / 2 == pytest.approx(half, rel=0.15)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_result_over_processes() -> None:
    observed = measured(LAG, 0.05, seed=7, gain=GAIN, share=SHARE)
    method = LeastSquares(starts=2)
    progress: list[float] = []
    alone = identify(LAG, observed, seed=3, method=method, progress=progress.append)
    spread = identify(LAG, observed, seed=3, method=method, processes=2)
    assert alone.values == spread.values
    assert alone.twin_runs == spread.twin_runs > 0
    assert progress[-1] == 1.0
    assert progress == sorted(progress)


def test_bad_input_is_named() -> None:
    observed = measured(LAG, 0.05, seed=8, gain=GAIN, share=SHARE)
    faulty = observed.replace(labels=np.full(len(observed), "Stuck"))
    plain = LAG.twin.twin  # type: ignore[attr-defined]
    still = observed.replace(commands=0 * observed.commands, observed=0 * observed.observed)
    for match, call in {
        "never change and are equal": lambda: identify(LAG, still, seed=0),
        "twin: expected a ParametricTwin": lambda: identify(plain, observed, seed=0),
        "observed: expected healthy": lambda: identify(LAG, faulty, seed=0),
        "observed.rate": lambda: identify(LAG, observed.replace(rate=20.0), seed=0),
        "rate: expected": lambda: identify(LAG, observed, seed=0, rate=3.0),
        "more measurements": lambda: identify(
            LAG, observed.replace(mask=np.zeros_like(observed.mask)), seed=0
        ),
        "seed": lambda: identify(LAG, observed, seed=-1),
        "processes": lambda: identify(LAG, observed, seed=0, processes=0),
        "starts": lambda: LeastSquares(starts=0),
        "loss": lambda: Evolution(loss="none"),  # type: ignore[arg-type]
    }.items():
        with pytest.raises(rt.InputError, match=match):
            call()


@pytest.fixture(scope="module")
def updated_twin() -> rt.Twin:
    observed = measured(LAG, 0.05, seed=9, gain=GAIN, share=SHARE)
    return identify(LAG, observed, seed=0, method=LeastSquares(starts=1)).twin


@pytest.mark.parametrize("check", TWIN_CHECKS, ids=lambda check: check.__name__)
def test_the_updated_twin_keeps_the_contract(updated_twin: rt.Twin, check: Callable) -> None:
    faults = (None, rt.Stuck(0, onset=1.2), rt.Stuck(0, onset=2.5))
    check(TwinSubject(updated_twin, commands(3, 40), faults))


@pytest.mark.slow
def test_delay_and_joint_offsets_of_the_emulated_robot(case: rt.Case) -> None:
    some = case.sampler.sample(6, rng=np.random.default_rng(0))
    hidden: dict[str, np.ndarray] = {}
    observed = case.emulator.simulate(some, seed=1, hidden=hidden)
    assert hidden["missed"].any()  # a movement of joint 2, an outlier that biases the plain norm
    twin = armpi_parametric(rt.cases.ArmPiTwin(step=0.01)).holding("stiffness", "damping")
    method = LeastSquares(starts=1, loss="cauchy")
    updated = identify(twin, observed, seed=0, rate=case.sensor_rate, method=method)
    delay = hidden["delay"].mean()
    assert updated.errors["delay"] < 0.01
    assert abs(updated.values["delay"] - delay) < 2 * updated.errors["delay"]
    for joint, offset in enumerate(hidden["offset"].mean(axis=(0, 1)), 1):
        name = f"offset.motor_{joint}"
        assert abs(updated.values[name] - offset) < 2 * updated.errors[name]


TRUE = {"gain": 3.0, "loss": 0.5}
"""Parameters of the equations of a lag, which its commands move to levels from 0 to 6."""


def lagging(least: float = 0.05) -> rt.ParametricTwin:
    return StateTwin(
        [State("x", start=0.0)],
        lambda x, u: x.x,
        rt.Channels(("u",), ("1",)),
        rt.Channels(("y",), ("m",)),
        10.0,
        derivative=lambda x, u, p: (p.gain * u.u - p.loss * x.x,),
        parameters=[rt.Parameter("gain", "1", 0.1, 10.0), rt.Parameter("loss", "1", least, 5.0)],
    ).parametric()


@pytest.mark.parametrize("least", [-5.0, -20.0, -60.0])
def test_a_twin_that_runs_away_within_its_ranges_is_identified(least: float) -> None:
    twin = lagging(least)  # at -20 it reaches 1e170 at the end, whose square is infinite
    steps = np.random.default_rng(3).uniform(0.0, 1.0, (4, 10, 1)).repeat(20, axis=1)
    made = twin.with_values(TRUE).simulate(steps, seed=0)
    noise = 0.02 * np.random.default_rng(4).normal(size=made.observed.shape)
    starting = twin.with_values({"gain": 1.0, "loss": 1.0})
    observed = made.replace(observed=made.observed + noise)
    updated = identify(starting, observed, LeastSquares(6), seed=0)
    for name, true in TRUE.items():
        assert abs(updated.values[name] - true) < 3 * updated.errors[name] < 0.2


def test_residuals_that_run_away_can_be_squared_and_leave_the_others_their_derivatives() -> None:
    twin = lagging(-100.0).with_values(TRUE)
    steps = np.random.default_rng(3).uniform(0.0, 1.0, (2, 10, 1)).repeat(20, axis=1)
    with misfit_of(twin, twin.simulate(steps, seed=0), seed=0, rate=None, processes=1) as misfit:
        search = Search(misfit, LeastSquares(), None)
        for loss, runs_away in ((1.0, False), (-1.0, True), (-20.0, True), (-90.0, True)):
            point = (np.array([3.0, loss]) - misfit.low) / search.width
            residual = search.residuals(point[None])[0]
            limited = np.abs(residual) == search.limit
            assert limited.any() == runs_away
            assert np.isfinite(np.sum(residual**2))
            jacobian = search.jacobian(point)
            assert np.isfinite(jacobian.T @ jacobian).all()
            assert not jacobian[limited].any()
            assert jacobian[~limited].any() == (not limited.all())


@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize("kind", ["equations", "function"])
def test_a_sensor_that_stops_at_a_limit_biases_nothing(kind: str, count: int) -> None:
    twin, true = (lagging(), TRUE) if kind == "equations" else (LAG, {"gain": 1.7, "share": 0.8})
    inputs = len(twin.inputs)
    steps = np.random.default_rng(3).uniform(0.0, 1.0, (count, 25, inputs)).repeat(20, axis=1)
    made = twin.with_values(true).simulate(steps, seed=0)
    clean = made.observed.astype(float)
    noise = 0.02 * clean.std() * np.random.default_rng(4).normal(size=clean.shape)
    limit = float(np.quantile(clean, 0.6))
    observed = made.replace(observed=np.minimum(clean + noise, limit))
    with pytest.warns(UserWarning, match=f"y never above {limit:.6g}: taken for limits"):
        updated = identify(twin, observed, LeastSquares(2), seed=0)
    for name, value in true.items():
        assert updated.values[name] == pytest.approx(value, rel=0.02)
    # The twin itself has no limit.
    assert updated.twin.simulate(steps, seed=0).observed.max() > 1.1 * limit
    checked = validate_identification(updated, twin, observed)
    assert checked.outputs[0].identification.after < 0.03 * clean.std()
