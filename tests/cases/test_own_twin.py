"""The tutorial: what docs/own_twin.md shows is in examples/, and runs."""

from __future__ import annotations

import os
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import retwin as rt

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "two_tanks"


def shown(language: str) -> list[str]:
    page = (ROOT / "docs" / "own_twin.md").read_text("utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.M | re.S)


def test_the_page_shows_the_files_of_the_example() -> None:
    heater, _, module, _ = shown("python")
    assert heater == (EXAMPLE.parent / "heater" / "heater.py").read_text("utf-8")
    (case,) = shown("toml")
    assert module == (EXAMPLE / "two_tanks.py").read_text("utf-8")
    assert case == (EXAMPLE / "case.toml").read_text("utf-8")
    assert sum(bool(line.strip()) for line in (module + case).splitlines()) <= 50


def test_a_function_of_one_run_becomes_a_twin(monkeypatch: pytest.MonkeyPatch) -> None:
    plant, names = ModuleType("plant"), {}
    vars(plant)["tank"] = lambda heater, flow, power, loss: np.stack(
        [power * heater, loss * flow], axis=1
    )
    monkeypatch.setitem(sys.modules, "plant", plant)
    exec(compile(shown("python")[1], "own_twin.md", "exec"), names)
    commands = np.random.default_rng(0).normal(size=(3, 20, 2))
    twin = rt.FunctionTwin(
        names["twin"],
        rt.Channels(("heater", "flow"), ("%", "l/min")),
        rt.Channels(("low", "up"), ("degC", "degC")),
        0.2,
    )
    np.testing.assert_allclose(twin.simulate(commands, seed=0).observed, commands * [3000, 5])


def test_what_happens_in_the_last_run_of_the_heater_is_said_alike() -> None:
    for place in ("README.md", "docs/own_twin.md", "examples/heater/measure.py"):
        text = (ROOT / place).read_text("utf-8")
        assert "In `run6.csv` the heater loses half of its power after 600 s" in text, place


def write_record(file: Path, case: rt.Case) -> None:
    """A record in the benchmark's layout, made by the example's own function with other numbers."""
    sampler = replace(case.sampler, duration=4096.0)
    rng = np.random.default_rng(1)
    pump = sampler.sample(2, rng=rng).astype(float)
    other = {"edge": 7.0, "spill": 0.6, "upper": 0.045}
    level = case.parametric.with_values(other).simulate(pump, seed=0).observed
    level = level + rng.normal(0, 0.02, level.shape)
    columns = np.stack([pump[0], pump[1], level[0], level[1]], axis=1)[..., 0]
    np.savetxt(file, columns, delimiter=",", header='"uEst","uVal","yEst","yVal"', comments="")


@pytest.mark.slow
def test_the_code_of_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    for file in EXAMPLE.iterdir():
        if file.is_file():
            shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    real = Path(os.environ.get("RETWIN_DATA", "")) / "cascaded_tanks" / "dataBenchmark.csv"
    if real.is_file():
        shutil.copy(real, tmp_path)
    else:
        write_record(tmp_path / "dataBenchmark.csv", rt.cases.get("case.toml"))
    names: dict[str, Any] = {}
    try:
        exec(compile(shown("python")[3], "own_twin.md", "exec"), names)
    finally:
        sys.modules.pop("two_tanks", None)
    print(printed := capsys.readouterr().out)
    assert "in the 90 % band" in printed
    assert names["surrogate"].fitted.figures["nrmse_level"] < 0.05
    assert names["after"] < names["before"]
    assert 0.6 < names["inside"] <= 1
    made = rt.load("made.npz")
    assert (len(made), made.inputs, made.outputs) == (
        100,
        *(names["case"].inputs, names["case"].outputs),
    )
