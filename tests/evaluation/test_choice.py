"""`rt.fit`: the correction of a twin, chosen by parts of its records that are left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

import retwin as rt
from retwin.cli.models import _verdict
from retwin.evaluation import ModelScore, predict_records
from retwin.evaluation.choice.comparison import Comparison, Predicted
from retwin.evaluation.choice.fitting import _row, with_yardstick
from retwin.evaluation.choice.folds import Fold, block_means, folds_of
from retwin.evaluation.choice.remarks import correction_remarks, remarks_of
from retwin.report.choice import fit_page
from retwin.twins import State, StateTwin
from retwin.update import Dynamics, StationaryNoise, free_moments
from retwin.update.blackbox import BLACK_BOXES

INPUTS, OUTPUTS = rt.Channels(("power",), ("W",)), rt.Channels(("heat",), ("K",))
FAST = ("none", "parameters", "dynamics")


def twin_of(sign: float = 1.0, delay: float | None = None) -> StateTwin:
    """A heater that loses heat in proportion to its temperature."""
    parameters = [
        rt.Parameter("gain", "K/J", 0.01, 2.0, 0.2),
        rt.Parameter("loss", "1/s", 0.01, 0.5, 0.1),
    ]
    if delay is not None:
        parameters.append(rt.Parameter("dead", "s", 0.0, 10.0, delay))
    return StateTwin(
        (State("heat", "K", 0.0),),
        lambda x, u, p: x.heat,
        INPUTS,
        OUTPUTS,
        1.0,
        derivative=lambda x, u, p: (sign * p.gain * u.power - p.loss * x.heat,),
        parameters=parameters,
        delays={} if delay is None else {"power": "dead"},
    )


def measured(
    seed: int, slope: Callable[[float, float], float], *, steps: int = 600, delay: int = 0
) -> tuple[NDArray, NDArray]:
    """Commands and outputs of a real heater, whose sensor has white noise of 0.01 K."""
    rng = np.random.default_rng(seed)
    power = np.repeat(rng.uniform(0, 2, steps // 15 + 1), 15)[:steps]
    heat, made = 0.0, []
    for k in range(steps):
        made.append(heat)
        for _ in range(10):
            heat += 0.1 * slope(heat, power[max(k - delay, 0)])
    return power, np.array(made) + 0.01 * rng.normal(size=steps)


def records(*seeds: int, slope: Callable[[float, float], float], **more: int) -> rt.Trajectories:
    pairs = [measured(seed, slope, **more) for seed in seeds]
    power, heat = (np.stack(each)[..., None] for each in zip(*pairs, strict=True))
    return rt.Trajectories(power, np.zeros_like(heat), heat, 1.0, inputs=INPUTS, outputs=OUTPUTS)


def right(heat: float, power: float) -> float:
    return 0.3 * power - 0.08 * heat


def radiating(heat: float, power: float) -> float:
    return 0.3 * power - 0.08 * heat - 0.03 * heat**2


@pytest.mark.slow
def test_a_right_twin_has_nothing_to_correct() -> None:
    found = rt.fit(twin_of(), records(0, slope=right), rt.Choice(candidates=FAST))
    assert found.chosen == "parameters"
    assert any("o correction is clearly better" in each for each in found.remarks)
    _, alone, now = found.parameters["gain"]
    assert alone == now == pytest.approx(0.3, rel=0.01)


@pytest.mark.slow
def test_what_the_equations_lack_is_learned_and_predicts_another_record() -> None:
    found = rt.fit(twin_of(), records(0, slope=radiating), rt.Choice(candidates=FAST))
    assert found.chosen == found.preferred == "dynamics"
    assert found.score("dynamics").rmse["heat"] < 0.5 * found.score("parameters").rmse["heat"]
    scores = {s.who: s for s in rt.score_model(found.twin, records(5, slope=radiating))}
    assert scores["model"].rmse < 0.2 * scores["mean"].rmse
    assert list(scores) == ["model", "mean", "hold"]
    for _, alone, now in found.parameters.values():  # identified values keep their meaning
        assert now == alone


@pytest.mark.slow
def test_dynamics_are_compared_at_a_horizon() -> None:
    settings = rt.Choice(candidates=FAST, horizon=5.0)
    found = rt.fit(twin_of(), records(0, slope=radiating), settings)
    assert found.chosen == "dynamics"
    assert not found.score("dynamics").reason


@pytest.mark.slow
def test_an_unstable_twin_is_judged_over_a_shorter_time_which_is_stated() -> None:
    """A heater whose loss is negative, in closed loop: free simulation grows by e every 10 s."""
    rng, heat, pairs = np.random.default_rng(0), 0.0, []
    for k in range(600):
        power = 1.0 + np.sin(0.1 * k) - 2.0 * heat + 0.3 * rng.normal()
        pairs.append((power, heat + 0.01 * rng.normal()))
        for _ in range(10):
            heat += 0.1 * (0.3 * power + 0.1 * heat)
    power, heat = (each[None, :, None] for each in np.array(pairs).T)
    data = rt.Trajectories(power, 0 * heat, heat, 1.0, inputs=INPUTS, outputs=OUTPUTS)
    twin = StateTwin(
        (State("heat", "K", 0.0),),
        lambda x, u, p: x.heat,
        INPUTS,
        OUTPUTS,
        1.0,
        derivative=lambda x, u, p: (p.gain * u.power + p.growth * x.heat,),
        parameters=[
            rt.Parameter("gain", "K/J", 0.01, 2.0, 0.2),
            rt.Parameter("growth", "1/s", 0.0, 0.5, 0.05),
        ],
    )
    found = rt.fit(twin, data, rt.Choice(candidates=FAST))
    assert found.horizon is not None
    assert found.horizon < 60
    assert "unstable" in found.remarks[0]
    assert f"with evaluate{found.option}, and for no free simulation" in found.remarks[0]
    assert found.option == f" --horizon {found.horizon:g}s"
    assert replace(found, horizon=None, begin=40.0).option == " --warm-up 40s"
    assert replace(found, horizon=None).option == ""
    assert not any("Records begin in different states" in each for each in found.remarks)
    # Its filter does not follow the machine for so long, and that is stated too.
    assert found.score(found.chosen).rmse["heat"] < heat.std() or "Do not use" in found.remarks[1]


@pytest.mark.slow
def test_bands_hold_what_they_promise_of_other_records() -> None:
    """Over records that were not used, at each time ahead; errors are those of 1200 samples."""
    found = rt.fit(twin_of(), records(0, 1, slope=radiating), rt.Choice(candidates=FAST))
    others = records(7, 8, slope=radiating)
    assert found.twin.forecast is not None
    for horizon in (None, 1.0, 10.0, 30.0):
        (own, *_) = rt.score_model(found.twin, others, horizon=horizon, warm_up=5.0)
        assert 0.8 <= own.coverage <= 0.98, horizon
        assert own.width < 1.6 * 3.29 * own.rmse


def unstarted() -> StateTwin:
    """The twin without what its state is at the first sample."""
    twin = twin_of()
    return StateTwin(
        (State("heat", "K", low=-20.0, high=20.0),), twin.output, INPUTS, OUTPUTS, 1.0,
        derivative=twin.derivative, parameters=twin.parameters,
    )  # fmt: skip


def begun(*seeds: int, slope: Callable[[float, float], float], loss: float) -> rt.Trajectories:
    """Records that begin in states of their own, from which the heater cools by that loss."""
    data = records(*seeds, slope=slope, steps=300)
    start = np.random.default_rng(seeds).uniform(-8, 8, size=(len(seeds), 1, 1))
    return data.replace(
        observed=data.observed + start * np.exp(-loss * np.arange(300))[None, :, None]
    )


@pytest.mark.slow
def test_bands_hold_where_records_begin_in_other_states(tmp_path: Path) -> None:
    """The band is wide at the start alone: its mean square says nothing of the time after it."""
    twin = unstarted()
    data = begun(1, 2, 3, 4, 5, slope=radiating, loss=0.12)
    found = rt.fit(twin, data, rt.Choice(method="dynamics", candidates=FAST))
    fresh = begun(11, 12, 13, slope=radiating, loss=0.12)
    held = predict_records(found.twin, fresh)
    later = np.abs(fresh.observed - held.mean)[:, 60:] <= 1.645 * held.deviation[:, 60:]
    assert later.mean() > 0.85
    assert any("Records begin in different states" in each for each in found.remarks)
    assert not correction_remarks(found.scores, "dynamics")
    alike = [replace(each, rmse=found.score("parameters").rmse) for each in found.scores]
    assert "changes the bands alone" in correction_remarks(alike, "dynamics")[0]
    # From starts that their first samples give, they are predicted from the start on.
    found.twin.save(tmp_path / "model")
    for model in (found.twin, rt.load_twin(tmp_path / "model")):
        started = predict_records(model, fresh, started=10.0)
        error, usual = (np.abs(fresh.observed - e.mean)[:, 10:] for e in (started, held))
        assert np.std(error) < 0.5 * np.std(usual)
        assert np.mean(error <= 1.645 * started.deviation[:, 10:]) > 0.8
        assert np.mean(started.deviation) < np.mean(held.deviation[:, :30])
    rows = rt.score_model(found.twin, fresh, warm_up=10.0, started=10.0, twin=twin.parametric())
    errors = {each.who: each.rmse for each in rows}
    (model, *_) = rt.score_model(found.twin, fresh, warm_up=10.0)
    assert errors["model"] < min(0.5 * model.rmse, errors["twin"])


def test_candidates_are_compared_from_starts_that_the_records_give(tmp_path: Path) -> None:
    """The mean of the starts predicts none of them, which hides how good a right twin is."""
    choice = rt.Choice(candidates=("none", "parameters"))
    data = begun(1, 2, 3, 4, 5, slope=right, loss=0.08)
    found = rt.fit(unstarted(), data, choice)
    assert found.chosen == "parameters"
    assert found.begin == 30.0
    assert found.score("parameters").rmse["heat"] < 0.012
    assert 0.85 < np.mean([*found.score("parameters").coverage.values()]) < 0.95
    assert any("Candidates were compared so, too." in each for each in found.remarks)
    assert "from starts that the first 30 s of a record give" in fit_page(found, "model", title="")
    found.twin.save(tmp_path / "model")
    fresh = begun(11, 12, 13, slope=right, loss=0.08)
    for model in (found.twin, rt.load_twin(tmp_path / "model")):
        assert model.unknown_starts
        rows = {each.who: each for each in rt.score_model(model, fresh, warm_up=30, started=30)}
        assert rows["model"].rmse < 0.012
        assert 0.8 < rows["model"].coverage < 0.97
    alike = rt.fit(unstarted(), records(1, 2, 3, 4, 5, slope=right, steps=300), choice)
    assert alike.begin == 0.0
    with pytest.raises(rt.InputError, match="one whose starts are known"):
        rt.fit(twin_of(), data[[0]], choice).twin.started(data[[0]])


@pytest.mark.slow
def test_models_without_the_twin_are_compared_on_the_same_parts(tmp_path: Path) -> None:
    data = records(0, slope=radiating)
    twin = rt.FunctionTwin(lambda u: 3.0 * u, INPUTS, OUTPUTS, 1.0)
    settings = rt.Choice(candidates=("none",), yardstick=True)
    found = rt.fit(twin, data, settings)
    rivals = {each.name: each for each in found.scores if not each.uses_twin}
    assert set(rivals) == set(BLACK_BOXES)
    # A twin without a state lacks the memory of the machine, which the commands determine.
    assert rivals["narx"].rmse["heat"] < 0.2 * found.score("none").rmse["heat"]
    assert rivals["narx"].difference < -2 * rivals["narx"].standard_error
    assert any("the twin lacks something" in each for each in found.remarks)
    page = fit_page(found, "model", title="heater")
    assert page.count("without the twin") > len(rivals)
    assert "retwin monitor fit model " in page
    known = rt.fit(twin_of(), records(0, slope=right), rt.Choice(candidates=FAST))
    alone, divided = (with_yardstick(known, workers=count) for count in (1, 2))
    assert not any("lacks something" in each for each in alone.remarks)
    assert [replace(each, seconds=0.0) for each in divided.scores] == [
        replace(each, seconds=0.0) for each in alone.scores
    ]


def test_copies_of_a_record_count_once() -> None:
    one = records(0, slope=right, steps=300)
    six = rt.Trajectories.concatenate([one.replace(ids=[str(i)]) for i in range(6)])
    alone, copied = (rt.fit(twin_of(), each, rt.Choice(candidates=FAST[:2])) for each in (one, six))
    assert (len(copied.records), copied.parts) == (1, alone.parts)
    assert copied.parameters == alone.parameters
    assert [each.kind for each in copied.checked.findings] == ["copy"] * 5


def test_a_wrong_sign_is_mentioned() -> None:
    found = rt.fit(twin_of(sign=-1.0), records(0, slope=right), rt.Choice(candidates=("none",)))
    assert [each.kind for each in found.checked.findings] == ["sign"]
    assert "check the sign of the gain" in fit_page(found, "model", title="heater")


def test_a_missing_dead_time_is_mentioned_with_its_value() -> None:
    data = records(0, slope=right, delay=4)
    found = rt.fit(twin_of(), data, rt.Choice(candidates=("parameters",)))
    (said,) = [each for each in found.remarks if each.startswith("A dead time of")]
    # Without a dead time, a smaller gain and loss imitate a part of it.
    assert 1.5 < float(said.split()[4]) < 5.0
    known = rt.fit(twin_of(delay=1.0), data, rt.Choice(candidates=("parameters",)))
    assert not any("dead time" in each for each in known.remarks)
    assert known.parameters["dead"][2] == pytest.approx(4.0, abs=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["none", "dynamics"])
def test_a_saved_model_predicts_the_same(tmp_path: Path, method: str) -> None:
    data = records(0, slope=radiating)
    found = rt.fit(twin_of(), data, rt.Choice(candidates=FAST, method=method))
    assert found.chosen == method
    assert any("Taken, as asked for" in each for each in found.remarks) == (method == "none")
    # In place of a model of another kind, as a former fit leaves it.
    (tmp_path / "model" / "residual").mkdir(parents=True)
    found.save(tmp_path / "model")
    again = rt.load_twin(tmp_path / "model")
    for horizon in (None, 3.0):
        one, other = (predict_records(m, data, horizon=horizon) for m in (found.twin, again))
        np.testing.assert_allclose(one.mean, other.mean, atol=1e-6)
        np.testing.assert_allclose(one.deviation, other.deviation, rtol=1e-6)


@pytest.mark.slow
def test_bands_of_two_outputs_hold_of_another_record_after_they_are_saved(tmp_path: Path) -> None:
    both = rt.Channels(("heat", "signal"), ("K", "V"))
    twin = replace(twin_of(), output=lambda x, u, p: (x.heat, 5 * x.heat), outputs=both)

    def with_signal(*seeds: int) -> rt.Trajectories:
        data = records(*seeds, slope=radiating)
        noise = 0.5 * np.random.default_rng(seeds[0]).normal(size=data.observed.shape)
        observed = np.concatenate([data.observed, 5 * data.observed + noise], axis=2)
        seen = np.ones(observed.shape, dtype=bool)
        return data.replace(observed=observed, nominal=observed, mask=seen, outputs=both)

    settings = rt.Choice(candidates=("none", "output"), method="output", yardstick=False)
    found = rt.fit(twin, with_signal(0, 1), settings)
    found.save(tmp_path / "model")
    test, again = with_signal(2, 3), rt.load_twin(tmp_path / "model")
    made = predict_records(again, test)
    kept = predict_records(found.twin, test)
    np.testing.assert_allclose(made.deviation, kept.deviation, rtol=1e-6)
    inside = np.abs(test.observed - made.mean) < 1.645 * made.deviation
    assert (inside.mean(axis=(0, 1)) > 0.85).all()
    relative = made.deviation.mean(axis=(0, 1)) / (test.observed - made.mean).std(axis=(0, 1))
    assert (relative < 2).all()


def test_no_band_is_given_where_commands_leave_the_range_of_the_calibration() -> None:
    found = rt.fit(twin_of(), records(0, slope=right), rt.Choice(candidates=("parameters",)))
    other = records(1, slope=right)
    inside = predict_records(found.twin, other)
    assert np.isfinite(inside.deviation).all()
    wider = other.commands.copy()
    wider[:, 200:230] *= 3
    with pytest.warns(
        rt.update.OutsideTrainingWarning,
        match=r"no band .* in 1 of 1 .* power is 4.*n: 0.*predicted heat",
    ):
        outside = predict_records(found.twin, other.replace(commands=wider))
    given = np.isfinite(outside.deviation[0, :, 0])
    assert np.isfinite(outside.mean).all()
    assert given[:200].all()
    assert not given[200:230].any()
    assert given[-200:].all()  # the heat of that time is lost
    with pytest.warns(rt.update.OutsideTrainingWarning):
        (row, *_) = rt.score_model(found.twin, other.replace(commands=wider))
    assert np.isfinite([row.crps, row.coverage, row.width]).all()


def test_another_unit_is_named_with_its_range() -> None:
    found = rt.fit(twin_of(), records(0, slope=right), rt.Choice(candidates=("parameters",)))
    other = records(1, slope=right)
    kelvin = other.replace(observed=other.observed + 273.15)
    with pytest.warns(rt.update.OutsideTrainingWarning, match="is 2.* here, .* another unit"):
        predict_records(found.twin, kelvin)


@pytest.mark.parametrize("drift", [0.0, 2.0])
def test_bands_of_longer_records_are_given_where_errors_do_not_drift(drift: float) -> None:
    data = records(0, slope=right)
    data = data.replace(observed=data.observed + np.linspace(0, drift, 600)[:, None])
    found = rt.fit(twin_of(), data, rt.Choice(candidates=("parameters",)))
    longer = records(1, slope=right, steps=800)
    said = "no band is given" if drift else "were not tried"
    with pytest.warns(rt.update.OutsideTrainingWarning, match=f"1 of 1 .* 600 s; .*{said} after"):
        given = np.isfinite(predict_records(found.twin, longer).deviation[0, :, 0])
    assert given[:600].any()
    assert given[600:].any() == (not drift)
    assert np.isfinite(predict_records(found.twin, longer, horizon=5.0).deviation[0, -1])


def test_a_twin_without_equations_and_case_is_given_when_it_is_loaded(tmp_path: Path) -> None:
    twin = rt.FunctionTwin(lambda u: np.cumsum(u, axis=1) * 0.1, INPUTS, OUTPUTS, 1.0)
    found = rt.fit(twin, records(0, slope=right), rt.Choice(candidates=("none",)))
    found.save(tmp_path / "model")
    with pytest.raises(rt.InputError, match=r"the twin of this model.*load_twin\(folder, twin\)"):
        rt.load_twin(tmp_path / "model")
    again = rt.load_twin(tmp_path / "model", twin)
    commands = records(1, slope=right).commands
    for one, other in zip(
        free_moments(again, commands), free_moments(found.twin, commands), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_without_a_comparison_the_method_is_fitted_to_all_records(tmp_path: Path) -> None:
    data = records(0, 1, slope=radiating, steps=300)
    alone = rt.Choice(method="parameters", compare=False)
    found = rt.fit(twin_of(), data, alone)
    assert (found.chosen, found.parts, found.score("parameters").rmse) == ("parameters", (), {})
    (said,) = found.remarks
    assert said.startswith("No comparison was made: identified parameters")
    compared = rt.fit(twin_of(), data, rt.Choice(candidates=("parameters",), method="parameters"))
    assert found.parameters == compared.parameters
    assert (found.twin.forecast, compared.twin.forecast is None) == (None, False)
    page = fit_page(found, "model", title="heater")
    assert said in page
    assert 'id="comparison"' not in page
    assert 'id="comparison"' in fit_page(compared, "model", title="heater")
    with pytest.raises(rt.InputError, match="method: expected a method where"):
        rt.Choice(compare=False)


def test_records_with_faults_are_used_where_their_classes_are_named() -> None:
    data = records(0, 1, slope=right, steps=200).replace(labels=["Healthy", "leak"])
    with pytest.raises(rt.InputError, match="method: expected a method where"):
        rt.Choice(calibrate_on="all")
    for calibrate_on, count in (("healthy", 1), ("all", 2), ({"leak": None}, 1)):
        settings = rt.Choice(method="none", compare=False, calibrate_on=calibrate_on)
        found = rt.fit(twin_of(), data, settings)
        assert len(found.records) == count
        assert found.values["residual"]["figures"]["samples"] == 200 * count


def test_wrong_settings_of_a_given_method_end_it_before_the_comparison() -> None:
    told: list[float] = []
    wrong = rt.Choice(method="dynamics", dynamics=Dynamics(states=("nope",)))
    with pytest.raises(rt.InputError, match="nope"):
        rt.fit(twin_of(), records(0, slope=right), wrong, progress=told.append)
    assert not told


def test_an_identification_is_named_where_a_model_is_expected(tmp_path: Path) -> None:
    (tmp_path / "identification.json").write_text("{}")
    with pytest.raises(rt.InputError, match="the folder of an identification"):
        rt.load_twin(tmp_path)


def test_a_missing_lag_is_mentioned_as_one_and_not_as_a_dead_time() -> None:
    """A sensor that follows with a time constant of 12 s."""
    data = records(1, 2, slope=right, steps=300)
    kept = np.exp(-1 / 12)
    late = lfilter([1 - kept], [1, -kept], data.observed.astype(float), axis=1)
    twin = twin_of().parametric().with_values((0.3, 0.08))
    found = rt.fit(twin, data.replace(observed=late), rt.Choice(candidates=("none",)))
    (said,) = [each for each in found.remarks if "lag of" in each]
    assert 8 < float(said.split("lag of ")[1].split()[0]) < 16
    assert not any("dead time" in each for each in found.remarks)


def test_no_dead_time_is_mentioned_of_an_output_that_never_changes() -> None:
    """A transient of the twin, moved out of the record, would explain all of its errors."""
    data = records(0, slope=right)
    data = data.replace(observed=np.full_like(data.observed, 7.0))
    remarks = remarks_with(data, none=np.exp(-np.arange(600) / 20)[None, :, None])
    assert not any("earlier" in each or "dead time" in each for each in remarks)


def remarks_with(data: rt.Trajectories, wanted: str = "", **errors: NDArray) -> tuple[str, ...]:
    """What is said of candidates with such errors (n, T, d_y), which need no fit."""
    folds = folds_of(data)
    predicted = {
        name: [
            Predicted((data.observed + e)[f.rows], 1 + 0 * e[f.rows], 0 * e[f.rows]) for f in folds
        ]
        for name, e in errors.items()
    }
    comparison = Comparison(data, folds, predicted)
    chosen, differences = comparison.simplest()
    scores = [_row(name, comparison, differences, 0.0, "") for name in errors]
    return remarks_of(data, comparison, scores, wanted or chosen, chosen, None, wanted)


def test_a_correction_that_is_better_by_chance_is_said_to_be_so() -> None:
    rng = np.random.default_rng(0)
    data = records(*range(4), slope=right)
    noise = rng.normal(size=data.observed.shape)
    said, more = remarks_with(data, none=noise, dynamics=1.1 * noise)
    assert said.startswith("No correction helps: corrected state equations did not predict")
    assert more.startswith("Corrections of outputs were not tried: without --dynamics")
    other = 0.99 * rng.normal(size=noise.shape)
    said, _ = remarks_with(data, none=noise, dynamics=other)
    assert "No correction is clearly better than the twin" in said
    assert "(corrected state equations) is better by" in said
    assert "within one standard error" in said


def test_a_method_that_was_asked_for_is_said_once_to_be_no_better() -> None:
    rng = np.random.default_rng(0)
    data = records(*range(4), slope=right)
    noise = rng.normal(size=data.observed.shape)
    for scale, how in ((0.99, "as well, more simply,"), (2.0, "clearly better")):
        other = scale * rng.normal(size=noise.shape)
        taken, *_, more = remarks_with(data, "dynamics", none=noise, dynamics=other)
        assert f"predicted {how} by the twin as it is (CRPS" in taken
        assert taken.startswith("Taken, as asked for: corrected state equations. Parts of")
        assert more.startswith("Corrections of outputs were not tried")


def test_errors_that_no_correction_expresses_are_mentioned() -> None:
    data = records(*range(4), slope=right)
    noise = np.random.default_rng(0).normal(size=data.observed.shape)
    drift = np.linspace(-1, 1, data.steps)[:, None]
    slow = 2 * np.cos(30 * drift)
    for error, said in ((drift, "depend on the time"), (slow, "are correlated in time")):
        remarks = remarks_with(data, none=noise + error)
        assert any(f"errors of the twin {said}" in each for each in remarks)


def test_folds_leave_out_what_is_measured_and_never_the_start_of_one_record() -> None:
    data = records(0, slope=right, steps=400)
    folds = folds_of(data)
    time = np.stack([each.held for each in folds if not each.edge])
    assert (time.sum(axis=0) <= 1).all()
    assert not np.stack([each.held for each in folds])[:, :, :10].any()
    edge = next(each for each in folds if each.edge)
    reach = np.abs(data.observed[..., 0] - data.observed.mean())
    assert reach[edge.held].mean() > reach[~edge.held].mean()
    kept = edge.training(data)
    assert not (kept.mask[..., 0] & edge.held).any()
    np.testing.assert_array_equal(kept.commands, data.commands)
    many = folds_of(records(*range(6), slope=right, steps=60))
    assert all((each.held.all(axis=1) | ~each.held.any(axis=1)).all() for each in many)
    assert sum(each.held for each in many if not each.edge).all()


def test_the_simplest_within_a_standard_error_is_taken() -> None:
    rng = np.random.default_rng(0)
    data = records(0, slope=right)
    folds = folds_of(data)

    def guessed(error: float) -> list[Predicted]:
        made = []
        for fold in folds:
            y = data.observed[fold.rows].astype(float)
            mean = y + error * rng.normal(size=y.shape)
            made.append(Predicted(mean, np.ones_like(y), np.zeros_like(y)))
        return made

    models = {"simple": guessed(0.1), "same": guessed(0.1), "better": guessed(0.05)}
    chosen, differences = Comparison(data, folds, models).simplest()
    assert chosen == "better"
    assert differences["better"] == (0.0, 0.0)
    del models["better"]
    assert Comparison(data, folds, models).simplest()[0] == "simple"


def guess(data: rt.Trajectories, errors: np.ndarray) -> list[Predicted]:
    """Predictions of all folds whose errors are standard normal, times `errors` (n,)."""
    rng, made = np.random.default_rng(0), []
    for fold in folds_of(data):
        y = data.observed[fold.rows].astype(float)
        mean = y + errors[fold.rows][:, None, None] * rng.normal(size=y.shape)
        made.append(Predicted(mean, np.ones_like(y), np.zeros_like(y)))
    return made


@pytest.mark.parametrize(
    ("better", "chosen"),
    [
        ([0.7, 0.7, 0.7, 0.7, 0.7, 0.7], "better"),
        ([0.1, 1.02, 1.02, 1.02, 1.02, 1.02], "simple"),  # of one record alone, however long it is
        ([0.985] * 6, "simple"),  # sure, and less than 2 %
    ],
)
def test_a_correction_has_to_be_better_over_records(better: list[float], chosen: str) -> None:
    data = records(*range(6), slope=right)
    models = {"simple": guess(data, np.ones(6)), "better": guess(data, np.array(better))}
    comparison = Comparison(data, folds_of(data), models)
    assert len(comparison.independent_scores("simple")) == 6
    found, differences = comparison.simplest()
    assert found == chosen
    assert differences["simple"][0] > 0


def test_a_correction_is_not_taken_because_it_is_as_good_as_another_one() -> None:
    data = records(*range(6), slope=right)
    noisy = np.array([0.4, 1.3, 0.4, 1.3, 0.4, 1.3])  # as good as either, since it differs so much
    models = {
        "simple": guess(data, np.ones(6)),
        "noisy": guess(data, noisy),
        "better": guess(data, 0.9 * np.ones(6)),
    }
    comparison = Comparison(data, folds_of(data), models)
    chosen, differences = comparison.simplest()
    assert abs(differences["noisy"][0]) < differences["noisy"][1]
    assert chosen == "better"
    del models["better"]
    assert Comparison(data, folds_of(data), models).simplest()[0] == "simple"


def test_a_record_that_two_parts_hold_counts_once() -> None:
    data = records(*range(6), slope=right)
    folds = folds_of(data)
    edge = next(fold for fold in folds if fold.edge).rows
    models = {"simple": guess(data, np.ones(6)), "better": guess(data, np.ones(6))}
    worse = np.ones(6)
    worse[edge] = 2.0
    scores = Comparison(data, folds, {**models, "worse": guess(data, worse)})
    change = scores.independent_scores("worse") - scores.independent_scores("simple")
    assert (change[edge] > 0.1).all()
    assert np.abs(np.delete(change, edge)).max() < 0.1 * change[edge].min() + 0.05


def test_a_constant_deviation_is_taken_where_propagated_ones_do_not_describe_errors() -> None:
    rng, spread = np.random.default_rng(0), np.linspace(0.01, 3.0, 400)[:, None]
    data = records(0, slope=right, steps=400)
    data = data.replace(observed=rng.normal(size=(1, 400, 1)))
    folds = [fold for fold in folds_of(data) if not fold.edge]
    nothing = np.zeros((1, 400, 1))
    wrong = [Predicted(nothing, spread[None], nothing, propagated=True)] * len(folds)
    exact = [Predicted(nothing, nothing + 1.0 + 0.01 * spread, nothing)] * len(folds)
    comparison = Comparison(data, folds, {"wrong": wrong, "exact": exact})
    assert comparison.constant == {"wrong": [True], "exact": [False]}
    for i, fold in enumerate(folds):
        assert comparison.deviation("wrong", i)[0, fold.held[0]] == pytest.approx(1.0, abs=0.15)


def test_block_means_are_those_of_consecutive_samples() -> None:
    values = np.arange(12.0).reshape(1, 12)
    values[0, 6:8] = np.nan
    np.testing.assert_allclose(block_means(values, 5), [2.0, 8.6])
    assert Fold("x", np.isfinite(values)).rows.tolist() == [0]


def test_stationary_noise_has_the_spread_and_the_persistence_of_the_errors() -> None:
    rng = np.random.default_rng(1)
    noise = np.zeros((4, 3000))
    for t in range(1, 3000):
        noise[:, t] = 0.8 * noise[:, t - 1] + 0.6 * rng.normal(size=4)
    twin = twin_of()
    power = rng.random((4, 3000, 1))
    nominal = twin.simulate(power, seed=0).nominal
    data = rt.Trajectories(
        power, nominal, nominal + noise[..., None], 1.0, inputs=INPUTS, outputs=OUTPUTS
    ).replace(labels=["Healthy"] * 4)
    residual = rt.fit_residual(twin, data, rt.Additive(), StationaryNoise(), seed=0)
    assert float(residual.scale) == pytest.approx(1.0, abs=0.06)
    assert float(residual.persistence) == pytest.approx(0.8, abs=0.02)
    model = rt.CorrectedTwin(twin, residual)
    drawn = model.simulate(power, seed=3).observed - nominal
    assert drawn.std() == pytest.approx(1.0, abs=0.06)
    mean, deviation = free_moments(model, power)
    np.testing.assert_allclose(mean, nominal, atol=1e-6)
    np.testing.assert_allclose(deviation, float(residual.scale), rtol=1e-6)


@pytest.mark.parametrize(("horizon", "sample"), [(None, "first"), (1.0, "last measured")])
def test_a_sample_that_predicts_better_is_named_as_what_it_is(
    horizon: float | None, sample: str
) -> None:
    """In free simulation it is the first of the record, else the last one before the horizon."""
    scores = [
        ModelScore(who, "y", horizon, rmse, rmse, float("nan"), float("nan"))
        for who, rmse in (("model", 2.0), ("hold", 1.0))
    ]
    assert _verdict(scores) == [
        f"y: the {sample} sample is a better prediction, by RMSE: 1 in place of 2."
    ]


@pytest.mark.parametrize(
    ("coverage", "interval", "text"),
    [
        (0.9, None, ""),
        (0.84, None, "in the worst. Fewer than five records cannot show"),
        (0.84, (0.7, 0.92), "in the worst. Records that differ so much cannot show"),
        (0.84, (0.7, 0.88), "do not rely on it here"),
        (0.7, (0.6, 0.84), "do not rely on it here"),
    ],
)
def test_a_band_that_holds_too_little_is_said_with_how_sure_that_is(
    coverage: float, interval: tuple[float, float] | None, text: str
) -> None:
    shares = (0.69, 0.9, 0.79, 0.85, 0.97)
    model = ModelScore("model", "y", None, 0.4, 0.3, coverage, 1.0, interval, shares)
    found = _verdict([model, ModelScore("mean", "y", None, 2.0, 2.0, *2 * [float("nan")])])
    assert len(found) == bool(text)
    assert text in " ".join(found)
    assert ("under 90% in 3 of 5 records, 69% in the worst" in " ".join(found)) is (
        "cannot show" in text
    )
    some = replace(model, coverage=0.84, interval=None, shares=(None, 0.8, 0.7))
    assert (
        "under 90% in 2 of 2 records, 70% in the worst. 1 more had no band" in _verdict([some])[0]
    )
    (other,) = _verdict([replace(model, rmse=4.0, coverage=0.4)], started=True)
    assert "holds 40% of these samples, and the RMSE is 13 times" in other
    assert "--warm-up" not in other


def test_an_output_that_has_nothing_in_common_with_the_model_is_named_as_such_alone() -> None:
    nan = float("nan")
    scores = [
        ModelScore("model", "y", None, 26.0, 25.0, 0.0, 4.0),
        ModelScore("twin", "y", None, 25.0, 25.0, nan, nan),
        ModelScore("mean", "y", None, 6.0, 5.0, nan, nan),
    ]
    (found,) = _verdict(scores)
    assert "another unit, another column, or another machine" in found
    held = replace(scores[0], coverage=0.9)
    assert not any("another unit" in each for each in _verdict([held, *scores[1:]]))


def test_the_coverage_of_five_records_has_an_interval_that_contains_it() -> None:
    found = rt.fit(twin_of(), records(1, 2, 3, slope=right), rt.Choice(candidates=("none",)))
    for runs in ((5, 6, 7, 8), (5, 6, 7, 8, 9)):
        (row, *_) = rt.score_model(found.twin, records(*runs, slope=right))
        assert (row.interval is None) == (len(runs) < 5)
        assert np.mean(row.shares) == pytest.approx(row.coverage)  # of records of one length
    assert row.interval is not None
    assert 0 <= row.interval[0] <= row.coverage <= row.interval[1] <= 1


def test_a_twin_that_was_identified_by_the_records_is_judged_without_each_part() -> None:
    data = records(0, slope=right, steps=300)
    names = ("parameters", "output")
    found = rt.fit(twin_of(), data, rt.Choice(identified=True, method="output"))
    assert tuple(each.name for each in found.scores)[:1] == names[:1]
    assert any("have identified the parameters" in each for each in found.remarks)
    named = rt.fit(twin_of(), data, rt.Choice(candidates=FAST[:2], identified=True))
    assert [each.name for each in named.scores] == list(FAST[:2])
    assert not any("have identified the parameters" in each for each in named.remarks)


@pytest.mark.parametrize("forced", [True, False])
def test_a_method_that_is_clearly_worse_is_taken_where_it_is_forced(*, forced: bool) -> None:
    data, both = records(0, slope=right, steps=300), FAST[:2]
    found = rt.fit(twin_of(), data, rt.Choice(both, "none", forced=forced))
    assert found.preferred == "parameters"
    assert found.chosen == ("none" if forced else "parameters")
    said = (
        "left out are predicted clearly better by identified parameters (CRPS"
        if forced
        else "The method that was asked for (the twin as it is)"
    )
    assert said in found.remarks[0]
    wanted = rt.fit(twin_of(), data, rt.Choice(both, "parameters", forced=forced))
    assert wanted.chosen == "parameters"


def test_a_parameter_at_an_end_of_its_range_is_named() -> None:
    narrow = [replace(each, high=0.25, start=0.2) for each in twin_of().parameters[:1]]
    twin = replace(twin_of(), parameters=(*narrow, *twin_of().parameters[1:]))
    settings = rt.Choice(candidates=FAST[:2], method=FAST[1])
    with pytest.warns(UserWarning, match="at a bound: gain"):
        found = rt.fit(twin, records(0, slope=right, steps=300), settings)
    assert any(
        each.startswith("gain is at an end of its range, 0.25 K/J") for each in found.remarks
    )
