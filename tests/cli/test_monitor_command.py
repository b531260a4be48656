"""`retwin monitor`: calibrated and replayed by the command line alone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.monitor import fit_monitor
from retwin.twins import ParameterShift
from retwin.update import DynamicsTwin, fit_dynamics

MODULE = """
import retwin as rt
from retwin.twins import Parameter, State, StateTwin

tank = StateTwin(
    (State("level", "m"),),
    lambda x, u: x.level,
    rt.Channels(("valve",), ("1",)),
    rt.Channels(("level",), ("m",)),
    1.0,
    derivative=lambda x, u, p: (p.gain * u.valve - p.leak * x.level,),
    parameters=(
        Parameter("gain", "m", 0.05, 0.2, 0.1),
        Parameter("leak", "1/s", 0.01, 0.1, 0.05),
    ),
)
"""
CASE = """
name = "watched_tank"
twin = "watched_module:tank"
commands = { kind = "HoldSampler", duration = 100, hold_durations = [5, 30], low = [0], high = [1] }
[faults]
leaking = { kind = "ParameterShift", parameter = "leak", size = [0.02, 0.5] }
[dynamics]
library = { degree = 0, knots = [], friction = false }
"""


# One for the session: a second module of that name would be refused.
@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("watched")
    (made / "watched_module.py").write_text(MODULE)
    (made / "case.toml").write_text(CASE)
    system = rt.cases.get(str(made / "case.toml"))
    rng = np.random.default_rng(0)
    for name, late in (("fit", 0.06), ("healthy", 0.06), ("leak", 0.16)):
        valve = np.repeat(rng.random((1, 40, 1)), 10, axis=1)
        level, levels = 0.0, []
        for k, u in enumerate(valve[0, :, 0]):
            levels.append(level)
            leak = 0.06 if k < 300 else late
            level = u * 0.1 / leak + (level - u * 0.1 / leak) * np.exp(-leak)
        output = np.array(levels)[None, :, None] + 1e-3 * rng.normal(size=(1, 400, 1))
        data = system.twin.simulate(valve, seed=0)
        rt.save(data.replace(observed=output), made / f"{name}.npz")
    fitted = fit_dynamics(system.twin, rt.load(made / "fit.npz"), system.dynamics).twin
    replace(fitted, case=str(made / "case.toml")).save(made / "model")
    fit_monitor(fitted, rt.load(made / "healthy.npz"), "1 per day", blanking=30).save(
        made / "watch"
    )
    return made


def test_a_monitor_is_calibrated_and_its_promise_printed(folder: Path, call, tmp_path) -> None:
    given = (folder / "model", folder / "healthy.npz", "--false-alarms", "1 per day")
    out = tmp_path / "watch"
    code, printed, err = call("monitor", "fit", *given, "--out", out, "--json")
    assert code == 0, err
    found = json.loads(printed)
    assert found["arl"] == 86400
    assert "86400 measured samples (1 day)" in found["promises"]["level"]
    code, printed, _ = call("monitor", "replay", out, folder / "healthy.npz", "--case", "none")
    assert code == 2


def test_a_leak_is_reported_with_its_time_and_cause(folder: Path, call) -> None:
    case, watch = ("--case", folder / "case.toml"), folder / "watch"
    code, printed, err = call("monitor", "replay", watch, folder / "leak.npz", *case, "--json")
    assert code == 0, err
    (record,) = json.loads(printed)["records"]
    first = record["alarms"][0]
    assert 300 <= first["time"] <= 315
    assert first["cause"]["name"] == "leaking"
    assert abs(first["cause"]["onset"][0] - 300) < 4
    both = (folder / "healthy.npz", folder / "leak.npz")
    code, printed, _ = call("monitor", "replay", watch, *both, *case)
    assert "healthy.npz: 0 alarms in 0.111 measured hours." in printed
    assert "leaking from" in printed


def test_what_cannot_calibrate_leaves_nothing(folder: Path, call, tmp_path) -> None:
    faulty = rt.load(folder / "healthy.npz").replace(labels=np.array(["leaking"]))
    rt.save(faulty, tmp_path / "faulty.npz")
    fit, out = ("monitor", "fit", folder / "model"), ("--out", tmp_path / "no")
    code, _, err = call(*fit, tmp_path / "faulty.npz", *out)
    assert (code, "healthy" in err) == (2, True), err
    code, _, err = call(*fit, folder / "healthy.npz", "--false-alarms", "seldom", *out)
    assert (code, "false_alarms" in err and "1 per month" in err) == (2, True), err
    assert not (tmp_path / "no").exists()


def test_what_is_no_monitor_is_refused(folder: Path, call) -> None:
    code, _, err = call("monitor", "replay", folder / "model", folder / "leak.npz")
    assert (code, "monitor" in err) == (2, True), err


@pytest.mark.slow
def test_trajectories_are_watched_by_a_diagnoser(folder: Path, call, tmp_path: Path) -> None:
    case = ("--case", folder / "case.toml")
    code, _, err = call("diagnose", "invert", folder / "model", "--out", tmp_path / "physics")
    assert code == 0, err
    twin = DynamicsTwin.load(folder / "model")
    rng = np.random.default_rng(1)
    leak = ParameterShift("leak", size=0.1)
    for name, count, fault in (("healthy", 13, None), ("leak", 3, leak)):
        valve = np.repeat(rng.random((count, 5, 1)), 10, axis=1)
        rt.save(twin.simulate(valve, faults=[fault] * count, seed=2), tmp_path / f"{name}.npz")
    given = ("monitor", "fit", tmp_path / "physics", tmp_path / "healthy.npz", *case)
    out = ("--out", tmp_path / "watch")
    code, _, err = call(*given, *out, "--blanking", "5")
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
