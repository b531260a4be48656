"""`retwin identify`: parameters of any twin from logs, and what the logs do not determine."""

from __future__ import annotations

import json
import re
import shutil
import sys
import tomllib
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fmus import c_fmu

import retwin as rt
from retwin.cases.updated_case import updated_case
from retwin.cli.reading import read
from retwin.deploy.identified import identified_by
from retwin.update import identification

RATE = 50.0
PENDULUM = """<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="bob">
      <joint name="swing" type="hinge" axis="0 1 0" damping="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="torque" joint="swing" ctrlrange="-2 2"/></actuator>
  <sensor><jointpos name="angle" joint="swing"/></sensor>
</mujoco>
"""
MODULE = """
from scipy.signal import lfilter


def filled(commands, gain=0.1, leak=0.05, spare=1.0):
    # level[t] = level[t - 1] + gain * valve[t - 1] - leak * level[t - 1]
    return lfilter([0, gain], [1, leak - 1], commands, axis=1)


def broken(commands, gain=0.1):
    raise ZeroDivisionError("no such tank")
"""
TANK = """
name = "tank"
twin = "identify_module:filled"
rate = 1
inputs = { valve = {} }
outputs = { level = { unit = "m" } }
commands = { kind = "HoldSampler", duration = 100, hold_durations = [5, 30], low = [0], high = [1] }
[parameters]
gain = { unit = "m", low = 0.05, high = 0.2, start = 0.1 }  # kept
leak = { unit = "1/s", low = 0.01, high = 0.1, start = 0.05 }
"""


def lagged(u: np.ndarray, gain: float, tau: float, step: float) -> np.ndarray:
    """The exact response of the lag to a held input."""
    x = np.zeros(len(u))
    for k in range(1, len(u)):
        x[k] = gain * u[k - 1] + (x[k - 1] - gain * u[k - 1]) * np.exp(-step / tau)
    return x


def steps(rng: np.random.Generator, count: int, *, low: float = -1, high: float = 1) -> np.ndarray:
    """A command of random levels."""
    return np.repeat(rng.uniform(low, high, count // 25 + 1), 25)[:count]


def write(path: Path, **columns: np.ndarray) -> Path:
    """A table of these columns."""
    text = [
        ",".join(columns),
        *(",".join(f"{x:.6g}" for x in row) for row in zip(*columns.values(), strict=True)),
    ]
    path.write_text("\n".join(text).replace("nan", "") + "\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twins, and logs of systems that they describe with other values of their parameters."""
    folder = tmp_path_factory.mktemp("identify")
    rng = np.random.default_rng(0)
    c_fmu(folder, name="plant")
    for i in range(5):
        u = steps(rng, 200)
        x = lagged(u, 1.7, 0.25, 1 / RATE) + 0.02 * rng.normal(size=200)
        x[rng.integers(200, size=9)] = np.nan
        write(folder / f"run{i}.csv", time=np.arange(200) / RATE, u=u, x=x)
    (folder / "robot.xml").write_text(PENDULUM, encoding="utf-8")
    robot = rt.MuJoCoTwin.from_file(folder / "robot.xml", rate=RATE)
    torque = np.stack([steps(rng, 150) for _ in range(4)])[..., None]
    damping = {"joint.swing.damping": 0.09, "joint.swing.frictionloss": 0.03}
    angle = robot.simulate(torque, seed=0, parameters=damping).observed
    for i in range(4):
        values = angle[i, :, 0] + 0.002 * rng.normal(size=150)
        write(folder / f"swing{i}.csv", t=np.arange(150) / RATE, tau=torque[i, :, 0], angle=values)
    (folder / "identify_module.py").write_text(MODULE, encoding="utf-8")
    (folder / "tank.toml").write_text(TANK, encoding="utf-8")
    for i in range(2):
        valve, level = steps(rng, 400, low=0), np.zeros(400)
        for k in range(1, 400):
            level[k] = level[k - 1] + 0.13 * valve[k - 1] - 0.03 * level[k - 1]
        write(folder / f"tank{i}.csv", valve=valve, level=level + 0.01 * rng.normal(size=400))
    return folder


@pytest.fixture
def place(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The same files in the current folder."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    sys.modules.pop("identify_module", None)


def result(folder: str = "out") -> dict:
    """What identification.json holds."""
    return json.loads(Path(folder, "identification.json").read_text("utf-8"))


def contains(found: dict, name: str, truth: float) -> bool:
    """Whether an interval, widened to be missed once in 10 000 times, contains a true value."""
    each = found["parameters"][name]
    return abs(each["value"] - truth) < 8 * each["error"]


@pytest.mark.slow
def test_an_fmu_is_calibrated_to_its_logs(place: Path, call) -> None:
    runs = sorted(place.glob("run*.csv"))
    ranges = ["--free", "gain=0.1:5", "--free", "tau=0.02:1"]
    words = ("identify", "plant.fmu", *runs, "--starts", "1")
    code, out, err = call(*words, "--inputs", "u", *ranges, "--out", "out")
    assert code == 0, err
    found = result()
    assert contains(found, "gain", 1.7)
    assert contains(found, "tau", 0.25)
    assert found["held_out"] == "trajectories"
    assert found["rate"] == RATE
    held = found["outputs"]["x"]["validation"]
    assert held["after"] == pytest.approx(0.02, rel=0.2)
    assert held["before"] > 10 * held["after"]
    assert "fell from" in out
    assert "left out: seen" in out
    assert list(found["outputs"]) == ["x"]
    start = json.loads(Path("out/start_values.json").read_text("utf-8"))
    assert start == {n: found["parameters"][n]["value"] for n in ("gain", "tau")}
    code, out, _ = call("twin", "info", "out/updated.toml")
    assert code == 0
    twin = rt.cases.get("out/updated.toml").twin
    measured = rt.load("out/logs.npz")
    residual = twin.simulate(measured.commands, seed=0).observed - measured.observed
    assert np.sqrt(np.mean(residual[measured.mask] ** 2)) == pytest.approx(0.02, rel=0.2)


@pytest.mark.slow
def test_a_robot_is_calibrated_by_places_in_its_model(place: Path, call) -> None:
    logs = sorted(place.glob("swing*.csv"))
    names = ("joint.swing.damping", "joint.swing.frictionloss")
    free = ["--free", f"{names[0]}=0:0.5", "--free", f"{names[1]}=0:0.2"]
    words = ("identify", "robot.xml", *logs, "--column", "torque=tau", *free, "--out", "out")
    code, _, err = call(*words)
    assert code == 0, err
    found = result()
    assert contains(found, names[0], 0.09)
    assert contains(found, names[1], 0.03)
    twin = rt.cases.get("out/updated.toml").twin
    assert dict(zip(twin.names, twin.values, strict=True))[names[0]] == pytest.approx(0.09, rel=0.1)


def test_a_function_is_calibrated_by_its_keyword_arguments(place: Path, call) -> None:
    channels = ("--inputs", "valve", "--outputs", "level", "--rate", "1")
    free = ("--free", "gain=0.01:0.5", "--free", "leak=0.001:0.2")
    name = "identify_module:filled"
    code, out, err = call(
        "identify", name, "tank0.csv", "tank1.csv", *channels, *free, "--out", "out"
    )
    assert code == 0, err
    found = result()
    assert (found["held_out"], found["errors_rest_on"]) == ("time", "samples")
    assert contains(found, "gain", 0.13)
    assert contains(found, "leak", 0.03)
    assert found["outputs"]["level"]["validation"]["interval"][1] < 1
    assert "each row is a sample at 1 Hz" in out
    assert rt.cases.get("out/updated.toml").parametric.names == ("gain", "leak")


def test_a_case_is_updated_and_keeps_all_else(place: Path, call) -> None:
    code, _, err = call("identify", "tank.toml", "tank0.csv", "tank1.csv", "--out", "deep/out")
    assert code == 0, err
    updated = rt.cases.get("deep/out/updated.toml")
    before = rt.cases.get("tank.toml")
    assert updated.sampler == before.sampler
    assert updated.parametric.parameters[0].high == 0.2
    values = dict(zip(updated.twin.names, updated.twin.values, strict=True))
    assert values["gain"] == pytest.approx(0.13, rel=0.02)
    again = call("identify", "deep/out/updated.toml", "tank0.csv", "--out", "again", "--json")
    assert json.loads(again[1])["parameters"]["gain"]["start"] == values["gain"]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes(place: Path, call) -> None:
    for name in ("one", "two"):
        assert call("identify", "tank.toml", "tank0.csv", "--out", name)[0] == 0
    first, second = (result(name) for name in ("one", "two"))
    assert first.pop("seconds") != second.pop("seconds")
    assert first == second
    assert Path("one/updated.toml").read_bytes() == Path("two/updated.toml").read_bytes()


@pytest.mark.slow
def test_what_the_logs_do_not_determine_is_said(place: Path, call) -> None:
    """`spare` changes nothing."""
    channels = ("--inputs", "valve", "--outputs", "level", "--rate", "1")
    free = [f"--free={each}" for each in ("gain=0.01:0.5", "leak=0.01:0.1", "spare=0:2")]
    name = "identify_module:filled"
    code, out, err = call("identify", name, "tank0.csv", *channels, *free, "--out", "out")
    assert code == 0
    assert "do not determine spare" in out
    assert "warning: not identified: spare" in err
    found = result()
    assert not found["parameters"]["spare"]["identified"]
    assert found["parameters"]["spare"]["interval"] is None
    assert found["directions"][-1]["open"]
    assert "do not determine spare" in Path("out/report.html").read_text("utf-8")


def test_records_that_never_move_have_a_result_that_says_so(place: Path, call) -> None:
    for i in range(2):
        write(place / f"tank{i}.csv", valve=np.full(100, 0.3), level=np.full(100, 7.0))
    code, out, err = call("identify", "tank.toml", "tank0.csv", "tank1.csv", "--out", "out")
    assert code == 0, err
    assert "empty slice" not in err
    assert "never changes: is 7 all the time" in " ".join(out.split())
    assert result()["records"]["explained"] == {"healthy": {}}


def test_a_value_at_its_bound_has_no_error(place: Path, call) -> None:
    code, out, _ = call(
        "identify", "tank.toml", "tank0.csv", "--free", "gain=0.05:0.11", "--out", "out"
    )
    assert code == 0
    gain = result()["parameters"]["gain"]
    assert (gain["at_bound"], gain["error"], gain["interval"]) == ("high", None, None)
    assert "gain lies at its upper bound, 0.11" in out


def test_what_invalidates_a_result_comes_first_and_each_file_is_named(place: Path, call) -> None:
    """Commands that never change, and a level that follows no gain of the twin."""
    level = np.cumsum(np.random.default_rng(1).normal(size=100))
    write(place / "flat.csv", valve=np.full(100, 0.5), level=level)
    code, out, err = call("identify", "tank.toml", "flat.csv", "--out", "out")
    assert code == 0
    table, rest = out.split("RMS error", 1)
    assert "±" not in table, "the interval alone"
    assert "physical values may lie outside" in table
    errors, first, *_ = rest.split("\n\n")[1].splitlines()
    assert "the RMS error of level" in errors
    assert first.startswith("valve: constant in what was read")
    assert out.count("constant in what was read") == 1
    page = Path("out/report.html").read_text("utf-8")
    assert page.index("valve: constant in what was read") < page.index("not white noise (Ljung")
    assert page.count("physical values may lie outside") == 1
    assert "Saved out/logs.npz" in err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("plant.fmu run0.csv --free gain=0:2 --out out", "for every command.*none for trouble"),
        ("plant.fmu run0.csv --inputs u --out out", "--free gain=LOW:HIGH; there are gain = 1"),
        ("robot.xml swing0.csv --out out", "joint.swing.damping = 0.02"),
        ("plant.fmu none.csv --free gain=1:2 --out out", "LOG: expected an existing file"),
        ("tank.toml tank0.csv --free gain --free gain=0:1 --out out", "gain twice"),
        ("tank.toml tank0.csv --free spare=0:2 --out out", "expected some of gain, leak"),
        ("tank.toml tank0.csv --free gain=3:2 --out out", "contains its present value"),
        ("tank.toml tank0.csv --free gain=a:b --out out", "with numbers"),
        ("tank.toml tank0.csv --column level=u --out out", "expected a column 'u'"),
        ("tank.toml tank0.csv --column nothing=u --out out", "channels of the twin, valve, level"),
        ("tank.toml tank0.csv --hold-out 1 --out out", "from 0 to below 1"),
        ("tank.toml tank0.csv --method bayes --loss linear --out out", "none with --method bayes"),
        ("tank.toml tank0.csv --method magic --out out", "one of least_squares"),
        ("tank.toml tank0.csv --transient 900 --out out", "less than the 400 s"),
        ("tank.toml tank0.csv --rate 5 --out out", "the case has its own"),
        ("tank.toml tank0.csv --out tank.toml", "a folder to replace"),
        ("robot.xml tank0.csv --free joint.swing.damping=0:1 --out out", "give --time COLUMN"),
        (
            "identify_module:broken tank0.csv --inputs valve --outputs level --rate 1 "
            "--free gain=0:1 --out out",
            "ZeroDivisionError: no such tank",
        ),
    ],
)
def test_what_cannot_be_used_is_refused_before_any_work(
    words: str, said: str, place: Path, call
) -> None:
    if "robot.xml tank0" in words:
        shutil.copy("tank0.csv", "rows.csv")
        text = Path("rows.csv").read_text().replace("valve,level", "torque,angle")
        Path("tank0.csv").write_text(text)
    code, out, err = call("identify", *words.split())
    assert code == (1 if "broken" in words else 2), err
    assert out == ""
    assert len(err.strip().splitlines()) == 1
    assert re.search(said, err), err
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.replace("valve,level", "valve,other"), "a column for an output of the twin"),
        (lambda t: t.replace("valve,level", "other,level"), "none for valve"),
        (lambda t: t.splitlines()[0] + "\n", "a table of numbers, got 'valve,level'"),
        (lambda t: "", "a table of numbers, got an empty file"),
        (lambda t: t + "0.5,3.4e38\n", "3.4e+38 for level at 400 s; leave the cell empty"),
        (lambda t: t.replace("0.", "0.x", 9), "expected numbers in the rows below its header"),
        (
            lambda t: "\n".join(x.split(",")[0] + "," for x in t.splitlines()[1:]).join(
                ["valve,level\n", "\n"]
            ),
            "no value at all of level",
        ),
    ],
    ids=[
        "no output",
        "no command",
        "no rows",
        "empty",
        "missing",
        "no numbers",
        "nothing measured",
    ],
)
def test_logs_that_lack_something_are_refused(change, said: str, place: Path, call) -> None:
    Path("log.csv").write_text(change(Path("tank0.csv").read_text()))
    code, _, err = call("identify", "tank.toml", "log.csv", "--out", "out")
    assert (code, len(err.strip().splitlines())) == (2, 1), err
    assert said in err, err
    assert not Path("out").exists()


def test_a_log_at_another_rate_is_refused(place: Path, call) -> None:
    case = rt.cases.get("tank.toml")
    made = case.twin.simulate(np.ones((2, 30, 1)), seed=0)
    rt.save(made.replace(rate=2.0), "fast.npz")
    code, _, err = call("identify", "tank.toml", "fast.npz", "--out", "out")
    assert code == 2
    assert "1 Hz" in err
    assert "2 Hz" in err


def test_saved_trajectories_are_matched_by_name_and_unit(place: Path, call) -> None:
    case = rt.cases.get("tank.toml")
    truth = case.parametric.with_values({"gain": 0.15})
    rng = np.random.default_rng(1)
    commands = np.stack([steps(rng, 200, low=0) for _ in range(4)])[..., None]
    made = truth.simulate(commands, seed=0)
    made = made.replace(observed=made.observed + 0.01 * rng.normal(size=made.observed.shape))
    named = [rt.Channels(("height",), (unit,)) for unit in ("m", "cm")]
    rt.save(made.replace(outputs=named[0], labels=None), "saved.npz")
    rt.save(made.replace(outputs=named[1], observed=100 * made.observed, labels=None), "cm.npz")
    words = ("--inputs", "valve", "--outputs", "level", "--rate", "1", "--free", "gain=0:1")
    name = "identify_module:filled"
    column = ("--column", "level=height")
    code, _, err = call("identify", name, "saved.npz", *words, *column, "--out", "out")
    assert code == 0, err
    assert contains(result(), "gain", 0.15)
    found = rt.cases.read_logs(["cm.npz"], case.twin, rt.cases.Columns({"level": "height"}))
    assert (found.trajectories.outputs.units, "level: cm to m" in found.notes[0]) == (("m",), True)
    np.testing.assert_allclose(found.trajectories.observed, made.observed, atol=1e-12)


@pytest.mark.slow
def test_columns_that_are_named_once_are_known_to_later_commands(place: Path, call) -> None:
    for i in range(2):
        text = Path(f"tank{i}.csv").read_text("utf-8")
        Path(f"plant{i}.csv").write_text(text.replace("valve,level", "FIC 1,TT 2"), "utf-8")
    named = ("--column", "valve=FIC 1", "--column", "level=TT 2")
    logs = ["plant0.csv"]
    code, _, err = call("identify", "tank.toml", *logs, *named, "--out", "out")
    assert code == 0, err
    case = rt.cases.get("out/updated.toml")
    assert case.logs.names == {"valve": "FIC 1", "level": "TT 2"}
    used = rt.load("out/logs.npz")
    assert identified_by("out/updated.toml", used.between(2.0, used.steps / used.rate))
    assert not identified_by("out/updated.toml", used.replace(observed=used.observed + 1.0))
    assert not identified_by("tank.toml", used)
    code, _, err = call("fit", "out/updated.toml", "--real", "plant0.csv", "--seed", "0",
                        "--correction", "additive", "--no-compare", "--out", "model")  # fmt: skip
    assert code == 0, err
    for file in ("plant1.csv", "tank1.csv"):  # also one that names the channels themselves
        code, out, err = call("evaluate", "model", "--real", file)
        assert code == 0, err
        assert "level" in out
    code, _, err = call("identify", "out/updated.toml", "plant1.csv", "--out", "again")
    assert code == 0, err


def test_a_mapping_is_remembered_too(place: Path, call) -> None:
    rows = Path("tank0.csv").read_text("utf-8").splitlines()[1:]
    stamps = (f"1|2|2026 00-{i // 60:02d}-{i % 60:02d}" for i in range(len(rows)))
    rows = [f"{stamp},{row}" for stamp, row in zip(stamps, rows, strict=True)]
    Path("own.csv").write_text("\n".join(["stamp,a,b", *rows]), "utf-8")
    Path("m.toml").write_text(
        'rate = 1\n[time]\ncolumn = "stamp"\nformat = "%d|%m|%Y %H-%M-%S"\n'
        '[commands.valve]\nsignal = "a"\n[outputs.level]\nsignal = "b"\n',
        "utf-8",
    )
    code, _, err = call("identify", "tank.toml", "own.csv", "--mapping", "m.toml", "--out", "out")
    assert code == 0, err
    case = rt.cases.get("out/updated.toml")
    assert case.logs.mapping == Path("m.toml").resolve()
    found, plain = read(Path("own.csv"), case), read(Path("tank0.csv"), case)
    np.testing.assert_array_equal(found.observed, plain.observed)


def test_the_page_needs_nothing_else_and_shows_names_as_text(place: Path, call) -> None:
    name = "<img src=x onerror=alert(1)>.csv"
    Path(name).write_bytes(Path("tank0.csv").read_bytes())
    assert call("identify", "tank.toml", name, "--out", "out")[0] == 0
    page = Path("out/report.html").read_text("utf-8")
    assert "<img src=x" not in page
    assert "&lt;img src=x" in page
    assert not re.search(r"<script[^>]+src|<link|<iframe", page)
    assert {f'id="{each}"' in page for each in ("summary", "parameters", "open", "next")} == {True}
    assert re.search(r"<b>Next:</b></p>\s*<ol>\s*<li>[A-Z]", page)


def test_a_sensor_of_several_channels_keeps_its_name_in_the_case(place: Path) -> None:
    free, sensors = ["joint.swing.damping=0:1"], ["body:bob"]
    opened = rt.cases.open_parametric("robot.xml", free, outputs=sensors, rate=RATE)
    assert len(opened.twin.outputs) == 3
    text = updated_case(opened, opened.twin.with_values([0.3]), place / "out", "logs.npz")
    written = tomllib.loads(text)
    assert (written["twin"], written["folder"], written["outputs"]) == ("robot.xml", "..", sensors)
    assert written["parameters"]["joint.swing.damping"]["start"] == 0.3


@pytest.mark.parametrize(
    ("shape", "said", "correction"),
    [
        ("ramps", "move in ramps and rest", "delay_offset"),
        ("levels", "change in steps", "additive"),
        ("sweep", "change all the time", "additive"),
    ],
)
def test_the_correction_of_the_case_suits_the_commands_of_the_logs(
    place: Path, shape: str, said: str, correction: str
) -> None:
    levels = np.random.default_rng(2).uniform(size=(3, 8))
    at, one = np.arange(200), np.arange(8) * 25
    commands = {
        "ramps": np.stack([np.interp(at % 25, [0, 9], [0, 1]) + row.repeat(25) for row in levels]),
        "levels": levels.repeat(25, axis=1),
        "sweep": np.stack([np.interp(at, one, row) for row in levels]),
    }[shape][..., None]
    opened = rt.cases.open_parametric(
        "identify_module:filled", ["gain=0:1"], inputs=["valve"], outputs=["level"], rate=1.0
    )
    logs = opened.twin.simulate(commands, seed=0)
    rt.save(logs, "logs.npz")
    text = updated_case(opened, opened.twin.with_values([0.3]), place, "logs.npz", logs)
    assert said in " ".join(line.removeprefix("# ") for line in text.splitlines())
    assert tomllib.loads(text)["correction"] == correction
    Path("updated.toml").write_text(text, encoding="utf-8")
    case = rt.cases.get("updated.toml")
    assert isinstance(case.correction, {"additive": rt.Additive}.get(correction, rt.DelayOffset))
    assert case.state_surrogate.sufficient > 0, "the function shows no state equations"


@pytest.mark.slow
def test_a_posterior_is_drawn(place: Path, call, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("emcee")
    few = partial(identification.MCMC, walkers=12, steps=100, warm_up=60, starts=1)
    monkeypatch.setattr(identification, "MCMC", few)
    words = ("tank0.csv", "tank1.csv", "--method", "bayes", "--sensor-rate", "0.1")
    code, _, err = call("identify", "tank.toml", *words, "--out", "out")
    assert code == 0, err
    found = result()
    assert (found["method"], found["errors_rest_on"]) == ("bayes", "posterior")
    assert contains(found, "gain", 0.13)
    low, high = found["parameters"]["gain"]["interval"]
    assert 0.05 < low < high < 0.2
    assert "posterior mean" in Path("out/report.html").read_text("utf-8")


def test_a_function_of_an_array_per_command_is_refused(call, tmp_path, monkeypatch) -> None:
    """Otherwise the order of --inputs would decide which is which."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    text = "def room(heater, ambient, gain=2.0):\n    return gain * heater + ambient\n"
    Path("rooms_of_identify.py").write_text(text)
    Path("run.csv").write_text("time,heater,ambient,air\n0,0,1,2\n1,0,1,2\n2,1,1,2\n")
    words = ("rooms_of_identify:room", "run.csv", "--inputs", "ambient,heater", "--outputs", "air")
    code, _, err = call("identify", *words, "--free", "gain=1:3", "--out", "identified")
    assert code == 2
    assert "room(heater, ambient, gain=2.0)" in err
    assert "by names, with ambient=u[..., 0], heater=u[..., 1]" in err
