"""Corrected dynamics by the command line alone, of a case with a twin in its own module."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.cases.file import read_case
from retwin.update import DynamicsTwin, TanhNetwork

MODULE = """
import retwin as rt
from retwin.twins import Parameter, State, StateTwin


def draining(x, u, p):
    return (p.gain * u.valve - p.leak * x.level,)


tank = StateTwin(
    (State("level", "m"),),
    lambda x, u: x.level,
    rt.Channels(("valve",), ("1",)),
    rt.Channels(("level",), ("m",)),
    1.0,
    derivative=draining,
    parameters=(
        Parameter("gain", "m", 0.05, 0.2, 0.1),
        Parameter("leak", "1/s", 0.01, 0.1, 0.05),
    ),
)
"""

CASE = """
name = "tank"
twin = "state_module:tank"
commands = { kind = "HoldSampler", duration = 100, hold_durations = [5, 30], low = [0], high = [1] }
[records]
calibration = { valve = "u1", level = "y1" }
test = { valve = "u2", level = "y2" }
[dynamics]
library = { degree = 3, knots = [], friction = false }
folds = 8
"""


def measured(rng: np.random.Generator, samples: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Commands and levels of a tank whose outflow grows with the square of the level."""
    valve = np.repeat(rng.random(samples // 10), 10)
    level, levels = 0.0, []
    for u in valve:
        levels.append(level)
        for _ in range(10):
            level += 0.1 * (0.1 * u - 0.04 * level - 0.05 * level**2)
    return valve, np.array(levels) + 1e-3 * rng.normal(size=samples)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tmp_path = tmp_path_factory.mktemp("tank")
    rng = np.random.default_rng(0)
    columns = np.column_stack([*measured(rng), *measured(rng)])
    np.savetxt(tmp_path / "d.csv", columns, delimiter=",", header="u1,y1,u2,y2", comments="")
    (tmp_path / "state_module.py").write_text(MODULE)
    (tmp_path / "case.toml").write_text(CASE)
    return tmp_path


@pytest.mark.slow
def test_state_equations_are_fitted_and_generate(folder: Path, tmp_path: Path, call) -> None:
    case, data, out = folder / "case.toml", folder / "d.csv", tmp_path / "model"
    given = ("--real", data, "--dynamics", "--no-yardstick", "--out", out, "--json")
    code, printed, _ = call("fit", case, *given)
    assert code == 0
    found = json.loads(printed)
    learned = found["dynamics"]
    assert learned["figures"]["rms_after"] < 0.2 * learned["figures"]["rms_before"]
    assert next(iter(learned["terms"])).startswith("level: ")
    assert learned["parameters"] == {}  # which keep the values that were identified
    assert set(found["parameters"]) == {"gain", "leak"}
    assert all(alone == now != before for before, alone, now in found["parameters"].values())
    scores = {each["name"]: each for each in found["candidates"]}
    assert found["chosen"] == "dynamics"
    assert scores["dynamics"]["rmse"]["level"] < 0.5 * scores["parameters"]["rmse"]["level"]
    white = found["one_step_errors"]["level"]
    assert white["p"] > 1e-3
    assert abs(white["autocorrelation"]) < 0.2
    assert DynamicsTwin.load(out).case == str(case.resolve())
    code, _, err = call("generate", out, "--out", tmp_path / "g.npz", "--per-class", 4)
    assert (code, len(rt.load(tmp_path / "g.npz"))) == (0, 4), err
    code, printed, _ = call("twin", "info", out)
    assert (code, "level" in printed) == (0, True)
    code, _, err = call("bundle", "save", out, tmp_path / "g.npz", "--out", tmp_path / "bundle")
    assert (code, "retwin export fmu" in err) == (2, True)


FUNCTION = """
import numpy as np


def level(valve, rate, gain=0.1, leak=0.05):
    x, levels = np.zeros(valve.shape[::2]), []
    for u in valve.swapaxes(0, 1):
        levels.append(x)
        x = x + (gain * u - leak * x) / rate
    return np.stack(levels, axis=1)
"""

BLACK_BOX = """
rate = 1.0
inputs = { valve = { unit = "1" } }
outputs = { level = { unit = "m" } }
[parameters]
gain = { unit = "m", low = 0.05, high = 0.2, start = 0.1 }
leak = { unit = "1/s", low = 0.02, high = 0.1, start = 0.05 }
[state_surrogate]
states = 1
hidden = 4
simulations = 30
[records]
"""


@pytest.mark.slow
def test_equations_of_a_function_are_learned_first(folder: Path, tmp_path: Path, call) -> None:
    (folder / "tank_function.py").write_text(FUNCTION)
    case, out = folder / "function.toml", tmp_path / "model"
    written = CASE.replace("state_module:tank", "tank_function:level")
    case.write_text(written.replace("[records]\n", BLACK_BOX.lstrip()))
    given = ("--real", folder / "d.csv", "--dynamics", "--no-compare", "--out", out, "--json")
    code, printed, err = call("fit", case, *given)
    assert (code, "stand in for it" in err) == (0, True), err
    found = json.loads(printed)
    assert set(found["parameters"]) == {"gain", "leak"}
    assert found["surrogate"]["own_level"] < 0.1 * found["surrogate"]["discrepancy_level"]
    figures = found["dynamics"]["figures"]
    assert figures["rms_after"] < 0.2 * figures["rms_before"]
    code, _, err = call("generate", out, "--out", tmp_path / "g.npz", "--per-class", 4)
    assert (code, len(rt.load(tmp_path / "g.npz"))) == (0, 4), err


@pytest.mark.slow
def test_a_study_compares_them(folder: Path, tmp_path: Path, call) -> None:
    case, data, out = folder / "case.toml", folder / "d.csv", tmp_path / "study"
    compared = ("twin", "pi_ls", "dynamics", "arx", "narx")
    given = ("--sources", ",".join(compared), "--runs", 1, "--processes", 1)
    code, _, err = call("study", case, "--data", data, *given, "--out", out)
    assert code == 0, err
    sources = json.loads((out / "results.json").read_text())["sources"]
    error = {name: sources[name]["rmse"][0] for name in compared}
    assert error["dynamics"] < 0.3 * min(error["twin"], error["pi_ls"])
    assert error["narx"] < 0.5 * error["arx"]
    assert 0.75 < sources["dynamics"]["coverage90"][0] <= 1
    assert (sources["twin"]["nll"], sources["dynamics"]["nll"][0] < -2) == ([None], True)
    page = (out / "report.html").read_text()
    assert all(f'<section id="{section}">' in page for section in ("residuals", "delta"))
    with np.load(out / "arrays.npz") as arrays:
        low, high = arrays["simulation/range"]
        shape = arrays["delta/values"].shape
        assert arrays["delta/about"].tolist() == [
            ["level", "level", "m", "m/s"],
            ["level", "valve", "1", "m/s"],
        ]
    assert (low[0], high[0]) == pytest.approx((0, 1), abs=0.1)
    assert shape == (2, 121)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("folds = 8", "folds = 1", "folds"),
        ("degree = 3", "degree = -1", "degree"),
        ("folds = 8", "fold = 8", "fold"),
        ("knots = []", "knots = [2.0]", "knots"),
        ("folds = 8", 'states = ["nope"]', "states"),
        ("folds = 8", "folds = 8\n[state_surrogate]\nspread = 2", "spread"),
        ("folds = 8", "network = { hidden = 0 }", "hidden"),
        ("folds = 8", "monotone = { level = { level = 2 } }", "monotone"),
        ("folds = 8", 'depends = { level = ["nope"] }', "depends"),
    ],
)
def test_wrong_settings_are_refused_by_name(
    folder: Path, tmp_path: Path, call, old: str, new: str, named: str
) -> None:
    case, out = folder / "wrong.toml", tmp_path / "model"
    case.write_text(CASE.replace(old, new))
    given = ("fit", case, "--real", folder / "d.csv", "--dynamics", "--out", out)
    code, _, err = call(*given)
    assert (code, named in err) == (2, True), err
    assert not out.exists()


def test_forms_and_known_structure_are_read_from_a_case(folder: Path) -> None:
    file, known = folder / "known.toml", 'network = { hidden = 4 }\npassive = ["level"]'
    file.write_text(CASE.replace("folds = 8", f'{known}\ndepends = {{ level = ["level"] }}'))
    dynamics = read_case(file).dynamics
    assert (dynamics.network, dynamics.passive) == (TanhNetwork(4), ("level",))
    assert dynamics.depends == {"level": ("level",)}
    assert list(dynamics.forms)[-1] == TanhNetwork(4)


def test_states_that_the_twin_has_not_are_refused_when_the_case_is_read(folder: Path) -> None:
    file = folder / "unknown.toml"
    file.write_text(CASE.replace("folds = 8", 'states = ["nope"]'))
    with pytest.raises(rt.InputError, match=r"dynamics\.states.*one of level, got 'nope'"):
        rt.cases.get(str(file))


@pytest.mark.slow
def test_an_interrupt_of_the_yardstick_leaves_the_model(
    folder: Path, tmp_path: Path, call, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("retwin.evaluation.choice.fitting.with_yardstick", interrupt)
    out = tmp_path / "model"
    given = ("--real", folder / "d.csv", "--dynamics", "--no-compare", "--yardstick", "--out", out)
    code, _, err = call("fit", folder / "case.toml", *given)
    assert code == 130
    assert f"interrupted; {out} stays as it was saved, not compared" in err.splitlines()[-1]
    assert rt.load_twin(out).outputs.names == ("level",)


@pytest.mark.slow
def test_without_a_method_the_records_decide(folder: Path, tmp_path: Path, call) -> None:
    case, out = folder / "case.toml", tmp_path / "model"
    brisk = '[density]\nkind = "SequenceMixture"\nmembers = 2\ntraining = { max_epochs = 2 }\n'
    case = folder / "brisk.toml"
    case.write_text(CASE.replace("[records]", 'correction = "additive"\n[records]') + brisk)
    given = ("--real", folder / "d.csv", "--no-yardstick", "--out", out, "--json")
    code, printed, err = call("fit", case, *given)
    assert code == 0, err
    found = json.loads(printed)
    assert found["chosen"] == found["preferred"]
    assert found["chosen"] in ("dynamics", "dynamics_output")
    scores = {each["name"]: each for each in found["candidates"]}
    assert {"none", "parameters", "dynamics", "output", "dynamics_output"} <= set(scores)
    assert scores[found["chosen"]]["rmse"]["level"] < 0.5 * scores["parameters"]["rmse"]["level"]
    assert json.loads((out / "choice.json").read_text())["chosen"] == found["chosen"]
    assert (out / "report.html").stat().st_size > 1000
    records = read_case(case).records
    assert records is not None
    rt.save(records(folder / "d.csv")[1], tmp_path / "other.npz")
    other = tmp_path / "other.npz"
    code, printed, err = call("evaluate", out, "--real", other, "--horizon", "5s", "--json")
    assert code == 0, err
    rows = {each["who"]: each for each in json.loads(printed)["scores"]}
    assert set(rows) == {"model", "twin", "mean", "hold"}
    assert rows["model"]["rmse"] < 0.5 * min(rows["twin"]["rmse"], rows["mean"]["rmse"])
    # Scores of records that the model was fitted to are said to be no scores of others.
    used = tmp_path / "used.npz"
    rt.save(records(folder / "d.csv")[0], used)
    for file, seen in ((used, True), (other, False)):
        code, printed, err = call("evaluate", out, "--real", file, "--horizon", "5s")
        assert code == 0, err
        assert (
            "The model was fitted to these records, where its errors" in " ".join(printed.split())
        ) == seen
    bands = tmp_path / "bands.csv"
    code, _, err = call("generate", out, "--commands", other, "--bands", "--out", bands)
    assert code == 0, err
    head, first, *_ = bands.read_text().splitlines()
    assert head == "record,time,level_measured,level_mean,level_q05,level_q95"
    low, mean, high = (float(first.split(",")[i]) for i in (4, 3, 5))
    assert bands.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert low < mean < high
    alone, given = tmp_path / "alone.csv", rt.load(other)
    rows = [f"{t / given.rate},{u:.9g}" for t, u in enumerate(given.commands[0, :, 0])]
    alone.write_text("\n".join([f"time [s],{given.inputs.names[0]}", *rows]) + "\n")
    again = tmp_path / "again.csv"
    code, _, err = call("generate", out, "--commands", alone, "--bands", "--out", again)
    assert code == 0, err
    cells = again.read_text().splitlines()[1].split(",")
    assert (cells[2], float(cells[3])) == ("", pytest.approx(mean, rel=1e-4))
    code, _, err = call("generate", out, "--bands", "--out", bands)
    assert (code, "--bands: expected --commands FILE" in err) == (2, True)
