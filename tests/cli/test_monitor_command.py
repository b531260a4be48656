"""`retwin monitor`: calibrated and replayed by the command line alone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

import retwin as rt
from retwin.cli.monitor import _event_rows
from retwin.monitor import Alarm, Monitor
from retwin.monitor.models.cause import Cause, cause_text
from retwin.monitor.models.state import Visible
from retwin.twins import ParameterShift
from retwin.update import DynamicsTwin, StationaryNoise


@pytest.mark.slow
def test_a_monitor_is_calibrated_and_its_promise_printed(watched: Path, call, tmp_path) -> None:
    given = (watched / "model", watched / "healthy.npz", "--false-alarms", "1 per day")
    out = tmp_path / "watch"
    code, printed, err = call("monitor", "fit", *given, "--out", out, "--json")
    assert code == 0, err
    found = json.loads(printed)
    assert found["arl"] == 86400
    assert "86400 measured samples (1 day)" in found["promises"]["level"]
    assert sum(found["tried"]["events"].values()) == 0
    code, printed, _ = call("monitor", "replay", out, watched / "healthy.npz", "--case", "none")
    assert code == 2


def test_a_cause_is_written_with_its_time_size_and_probability_where_it_has_them() -> None:
    nothing, alarm = (np.nan,) * 3, Alarm("tank", 3, 3.0, "level", "higher than predicted", 1e6, 3)
    named = {"leaking": 0.3, "Healthy": 0.7}
    none = Cause(alarm, "Healthy", 0.7, 0.9, nothing, nothing, named)
    assert cause_text(vars(none), "") == "no known fault; probability 0.70, or leaking (0.30)"
    leaking = Cause(alarm, "leaking", 0.7, 0.0, (0.2, 0.1, 0.3), (2.0, 1.0, 3.0), named, unit="1/s")
    assert (
        cause_text(vars(leaking), "2 s")
        == "leaking from 2 s; size 0.2 1/s (0.1 to 0.3), probability 0.70"
    )
    more = replace(leaking, unknown=0.9, unit="1")
    assert cause_text(vars(more), "2 s") == (
        "leaking from 2 s, and more than that; size 0.2 (0.1 to 0.3), "
        "probability 0.70 among the known causes"
    )
    unclear = replace(leaking, probability=0.4)
    assert cause_text(vars(unclear), "2 s").startswith("not clear, most likely leaking from 2 s;")
    shares = {"Healthy": 0.0, "leaking": 0.45, "weak pump": 0.2, "stuck": 0.35}
    alike = replace(unclear, probabilities=shares)
    assert cause_text(vars(alike), "").endswith(", or weak pump (0.20), or stuck (0.35)")
    assert ", or " not in cause_text(vars(replace(alike, probabilities={"weak pump": 0.19})), "")
    frozen = replace(leaking, size=nothing, unit="")
    assert cause_text(vars(frozen), "2 s") == "leaking from 2 s; probability 0.70"


def test_an_event_has_the_newest_size_of_the_cause_that_opened_it() -> None:
    first = Alarm("tank", 3, 3.0, "level", "higher than predicted", 1e6, 3)
    watched = SimpleNamespace(events=[first], endings=[])
    found = Cause(first, "leaking", 0.7, 0.0, (0.2, 0.1, 0.3), (2.0, 1.0, 3.0), {}, unit="1/s")
    later = replace(found, probability=0.9, size=(0.25, 0.2, 0.3), same=True)
    beside = replace(later, name="weak pump", probability=0.4)
    within = replace(later, probability=0.8, onset=(3.1, 3.0, 4.0))
    for more, text in (((later,), "0.25"), ((beside,), "0.2 "), ((within,), "0.2 ")):
        (row,) = _event_rows(watched, [found, *more], 1.0)  # type: ignore[arg-type]
        assert row[-1][0].startswith(f"leaking from 2.0 s; size {text.strip()} 1/s")
    anew = replace(first, event=9, sample=9, time=9.0)
    both = SimpleNamespace(events=[first, anew], endings=[])
    same, other = replace(found, alarm=anew), replace(beside, alarm=anew, same=False)
    (row,) = _event_rows(both, [found, same], 1.0)  # type: ignore[arg-type]
    assert row[1:3] == ("3", "lasts")
    assert row[-1][0].startswith("leaking from 2.0 s; size")
    assert "again, or still, 1 time until 9 s, then leaking from 2.0 s" in row[-1][1]
    rows = _event_rows(both, [found, other], 1.0)  # type: ignore[arg-type]
    assert [each[-1][0][:9] for each in rows] == ["leaking f", "not clear"]
    remark = SimpleNamespace(events=[replace(first, promised=False)], endings=[])
    (row,) = _event_rows(remark, [found], 1.0)  # type: ignore[arg-type]
    assert row[-2].startswith("remark: ")
    assert row[-1][0].startswith("if it is a fault, and the twin holds there: leaking from 2.0 s")
    (row,) = _event_rows(watched, [found], 1.0, left=3.0)  # type: ignore[arg-type]
    assert row[-1][0].startswith("if the twin holds there: leaking from 2.0 s")
    second = replace(within, name="weak pump", size=(-0.5, -0.6, -0.4), unit="", same=False)
    (row,) = _event_rows(watched, [found, second], 1.0)  # type: ignore[arg-type]
    newest = "weak pump from 3.1 s; size -0.5 (-0.6 to -0.4), probability 0.80"
    assert row[-1][0] == newest
    assert row[-1][1].startswith("before, by fewer samples: leaking from 2.0 s")
    # What all samples say now is shown, also where it is not sure enough to replace the first.
    unsure = replace(second, same=True)
    (row,) = _event_rows(watched, [found, unsure], 1.0)  # type: ignore[arg-type]
    assert row[-1][0].startswith(newest)


@pytest.mark.slow
def test_a_leak_is_reported_with_its_time_and_cause(watched: Path, call) -> None:
    case, watch = ("--case", watched / "case.toml"), watched / "watch"
    code, printed, err = call("monitor", "replay", watch, watched / "leak.npz", *case, "--json")
    assert code == 0, err
    (record,) = json.loads(printed)["records"]
    first = record["alarms"][0]
    assert 300 <= first["time"] <= 315
    assert first["cause"]["name"] == "leaking"
    assert abs(first["cause"]["onset"][0] - 300) < 4
    both = (watched / "healthy.npz", watched / "leak.npz")
    code, printed, _ = call("monitor", "replay", watch, *both, *case)
    assert "healthy.npz: 0 events in 0.111 measured hours." in printed
    assert "leaking from" in printed
    words = " ".join(printed.split())
    assert (
        "This replay of 13.3 minutes shows 1 event. The promise of at most one false event in"
        in words
    )
    assert "These are more events than it allows: faults; or, if you know" in words
    assert "probability 1.00" in words
    assert first["cause"]["unit"] == "1/s"


@pytest.mark.slow
def test_a_log_is_watched_by_its_columns_or_its_mapping(
    watched: Path, call, tmp_path: Path
) -> None:
    record = rt.load(watched / "leak.npz")
    names = (*record.inputs.names, *record.outputs.names)
    columns = [*record.commands[0].T, *record.observed[0].T]
    at = np.arange(record.steps) / record.rate
    text = [";".join(("time", *names))]
    text += [";".join(f"{x:.9g}" for x in row) for row in zip(at, *columns, strict=True)]
    (tmp_path / "leak.csv").write_text("\n".join(text))
    mapping = [f"rate = {record.rate}"]
    for kind, some in (("commands", record.inputs), ("outputs", record.outputs)):
        for name, unit in zip(some.names, some.units, strict=True):
            mapping.append(f'{kind}.{name} = {{ signal = "{name}", unit = "{unit}" }}')
    (tmp_path / "m.toml").write_text("\n".join(mapping))
    replay = ("monitor", "replay", watched / "watch", tmp_path / "leak.csv")
    for mapped in ((), ("--mapping", tmp_path / "m.toml")):
        code, printed, err = call(*replay, *mapped, "--json")
        assert code == 0, err
        (found,) = json.loads(printed)["records"]
        assert 300 <= found["alarms"][0]["time"] <= 315


@pytest.mark.slow
def test_tables_calibrate_without_a_model(call, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name, steps, offset in (("healthy", 400, 0.0), ("later", 300, 8.0)):
        values = np.c_[np.arange(steps), rng.normal(size=(steps, 2)), np.ones(steps)]
        values[150:, 2] += offset
        head = "time,flow,pressure,state"
        np.savetxt(tmp_path / f"{name}.csv", values, delimiter=",", header=head, comments="")
    out = tmp_path / "watch"
    code, printed, err = call("monitor", "fit", tmp_path / "healthy.csv", "--out", out)
    assert code == 0, err
    assert "calibrated on 0.111 h of your data; causes are channels" in " ".join(printed.split())
    assert "never change: state" in err
    code, printed, err = call("monitor", "replay", out, tmp_path / "later.csv", "--json")
    assert code == 0, err
    (event,) = json.loads(printed)["records"][0]["alarms"][:1]
    assert (event["output"], 150 <= event["time"] < 160) == ("pressure", True)


@pytest.mark.slow
def test_a_black_box_keeps_the_case_that_its_records_are_read_by(
    watched: Path, call, tmp_path: Path
) -> None:
    columns = "\n".join(
        f'{part} = {{ valve = "u{i}", level = "y{i}" }}'
        for i, part in enumerate(("calibration", "test"), 1)
    )
    case = watched / "recorded.toml"
    case.write_text(f"{(watched / 'case.toml').read_text()}[records]\n{columns}\n")
    rng, steps = np.random.default_rng(0), 300
    valve = np.repeat(rng.random((steps // 10, 2)), 10, axis=0)
    level = lfilter([0.1], [1, -0.9], valve, axis=0) + 0.01 * rng.normal(size=(steps, 2))
    rows = np.c_[valve[:, 0], level[:, 0], valve[:, 1], level[:, 1]]
    file, out = tmp_path / "day.csv", tmp_path / "watch"
    np.savetxt(file, rows, delimiter=",", header="u1,y1,u2,y2", comments="")
    code, printed, err = call("monitor", "fit", file, "--case", case, "--out", out)
    assert code == 0, err
    assert "causes are channels" in " ".join(printed.split())
    code, printed, err = call("monitor", "replay", out, file, "--json")
    assert code == 0, err
    assert json.loads(printed)["records"][0]["measured_samples"] == 2 * steps


def test_an_output_that_slowly_leaves_its_range_is_named_without_an_alarm(
    watched: Path, call, tmp_path: Path
) -> None:
    """The filter follows it, so that errors of one step do not show it."""
    healthy = rt.load(watched / "healthy.npz")
    made = Monitor.load(watched / "watch")
    assert made.find_excursions(healthy) == {}
    width = float(np.ptp(healthy.observed))
    ramp = np.linspace(0, 1, healthy.steps)[None, :, None]
    away = healthy.replace(observed=healthy.observed + 2 * width * ramp)
    ((name, (first, value, low, high)),) = made.find_excursions(away).items()
    assert name == "level"
    assert value == pytest.approx(float(away.observed.max()))
    assert value > high + width > low
    before = away.observed[0, : round(first * away.rate), 0]
    assert (before < high + 0.26 * (high - low)).all()
    rt.save(away, tmp_path / "away.npz")
    code, printed, err = call("monitor", "replay", watched / "watch", tmp_path / "away.npz")
    assert code == 0, err
    assert "Outputs leave the range of the calibration: level" in " ".join(printed.split())


def test_a_monitor_that_sees_sensors_at_most_says_so(
    watched: Path, call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from retwin import monitor

    sensor = Visible("level: sensor offset", 0.1, 1.0, 1.0, 5.0, "m", 1.0, "range")
    given = ("monitor", "fit", watched / "model", watched / "healthy.npz")
    for size, said in ((0.02, False), (0.2, True)):
        leak = Visible("leak changed", size, 0.5, 1.0, 5.0, "1/s", 0.1)
        monkeypatch.setattr(monitor, "visible_sizes", lambda *_, **__: [leak, sensor])  # noqa: B023
        code, _, err = call(*given, "--false-alarms", "1 per day", "--out", tmp_path / f"{said}")
        assert code == 0, err
        assert ("filter follows it as a disturbance" in err) is said


def test_what_cannot_calibrate_leaves_nothing(watched: Path, call, tmp_path) -> None:
    faulty = rt.load(watched / "healthy.npz").replace(labels=np.array(["leaking"]))
    rt.save(faulty, tmp_path / "faulty.npz")
    fit, out = ("monitor", "fit", watched / "model"), ("--out", tmp_path / "no")
    code, _, err = call(*fit, tmp_path / "faulty.npz", *out)
    assert (code, "healthy" in err) == (2, True), err
    code, _, err = call(*fit, watched / "healthy.npz", "--false-alarms", "seldom", *out)
    assert (code, "false_alarms" in err and "1 per month" in err) == (2, True), err
    assert not (tmp_path / "no").exists()


def test_what_is_no_monitor_is_refused(watched: Path, call) -> None:
    code, _, err = call("monitor", "replay", watched / "model", watched / "leak.npz")
    assert (code, "monitor" in err) == (2, True), err


@pytest.mark.slow
@pytest.mark.parametrize("equations", [True, False])
def test_equations_that_are_not_corrected_are_watched_and_else_a_black_box(
    watched: Path, call, tmp_path: Path, *, equations: bool
) -> None:
    case, healthy = watched / "case.toml", watched / "healthy.npz"
    given = (case, "--real", healthy, "--correction", "additive", "--no-compare")
    surrogate = ("--surrogate", "off" if equations else "on")  # a network has no equations
    code, _, err = call("fit", *given, *surrogate, "--out", tmp_path / "model")
    assert code == 0, err
    out = tmp_path / "watch"
    code, printed, err = call("monitor", "fit", tmp_path / "model", healthy, "--out", out)
    assert code == 0, err
    words = " ".join(printed.split())
    assert ("model corrects no state equations: those of the twin" in words) == equations
    assert ("has no state equations" in words and "causes are channels" in words) != equations
    assert ("leaking: seen" in words) == equations
    code, printed, err = call("monitor", "replay", out, watched / "leak.npz")
    assert code == 0, err
    assert "1 event" in printed
    assert "in free simulation level is off by" in printed


@pytest.mark.slow
def test_state_equations_are_watched_beneath_a_correction_of_outputs(
    watched: Path, call, tmp_path: Path
) -> None:
    inner, healthy = DynamicsTwin.load(watched / "model"), rt.load(watched / "healthy.npz")
    residual = rt.fit_residual(inner, healthy, rt.Additive(), StationaryNoise(), seed=0)
    rt.CorrectedTwin(inner, residual).save(tmp_path / "model")
    given = (tmp_path / "model", watched / "healthy.npz", "--out", tmp_path / "watch")
    code, printed, err = call("monitor", "fit", *given)
    assert code == 0, err
    assert "black box" not in printed
    assert Monitor.load(tmp_path / "watch").twin.equations.names == inner.equations.names


def test_a_folder_that_is_no_store_is_not_made_one(call, tmp_path: Path) -> None:
    code, _, err = call("monitor", "recalibrate", tmp_path, "--asset", "tank")
    assert (code, "monitor.sqlite" in err) == (2, True), err
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_trajectories_are_watched_by_a_diagnoser(watched: Path, call, tmp_path: Path) -> None:
    case = ("--case", watched / "case.toml")
    code, _, err = call(
        "diagnose", "fit", "--from", watched / "model", "--out", tmp_path / "physics"
    )
    assert code == 0, err
    twin = DynamicsTwin.load(watched / "model")
    rng = np.random.default_rng(1)
    leak = ParameterShift("leak", size=0.1)
    for name, count, fault in (("healthy", 13, None), ("leak", 3, leak)):
        valve = np.repeat(rng.random((count, 5, 1)), 10, axis=1)
        rt.save(twin.simulate(valve, faults=[fault] * count, seed=2), tmp_path / f"{name}.npz")
    given = ("monitor", "fit", tmp_path / "physics", tmp_path / "healthy.npz", *case)
    out = ("--out", tmp_path / "watch")
    code, _, err = call(*given, *out, "--lasting", "5")
    assert (code, "whole trajectories" in err) == (2, True), err
    code, printed, err = call(*given, *out, "--false-alarms", "500 trajectories")
    assert code == 0, err
    assert "at least 500 trajectories" in " ".join(printed.split())
    replayed = ("monitor", "replay", tmp_path / "watch", tmp_path / "healthy.npz")
    code, printed, err = call(*replayed, tmp_path / "leak.npz", "--json")
    assert code == 0, err
    healthy, leaking = json.loads(printed)["records"]
    assert (healthy["alarms"], healthy["trajectories"]) == ([], 13)
    assert (leaking["alarms"][0]["number"], leaking["alarms"][0]["name"]) == (13, "leaking")
    code, printed, _ = call(*replayed, tmp_path / "leak.npz")
    assert "healthy.npz: 0 alarms in 13 trajectories." in printed
