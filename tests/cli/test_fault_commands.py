"""Faults of a system with states by the command line alone: fit, invert, predict, study."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.results import read_results

MODULE = """
import retwin as rt
from retwin.twins import Parameter, State, StateTwin

TWIN = StateTwin(
    (State("inner", "K", 0.0), State("outer", "K", 0.0)),
    lambda x, u: x.outer,
    rt.Channels(("heat",), ("W",)),
    rt.Channels(("air",), ("K",)),
    2.0,
    derivative=lambda x, u, p: (
        p.power * u.heat - p.between * (x.inner - x.outer),
        p.between * (x.inner - x.outer) - p.loss * x.outer,
    ),
    parameters=(
        Parameter("power", "K/(W s)", 0.01, 1.0, start=0.1),
        Parameter("between", "1/s", 0.01, 1.0, start=0.2),
        Parameter("loss", "1/s", 0.01, 1.0, start=0.1),
    ),
)
"""
CASE = """
name = "oven"
twin = "MODULE:TWIN"
sensor_rate = 1.0
[commands]
kind = "HoldSampler"
low = [0.0]
high = [2.0]
duration = 60.0
hold_durations = [5.0, 20.0]
[dynamics]
library = { degree = 1, knots = [] }
[faults]
leak = { kind = "ParameterShift", parameter = "loss", size = [0.05, 0.1], onset = [10, 30] }
weak = { kind = "ActuatorGain", actuator = "heat", size = [-0.5, -0.3], onset = [10, 30] }
biased = { kind = "SensorBias", output = "air", size = [0.2, 0.4], onset = [10, 30] }
"""


@pytest.fixture
def oven(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> rt.Trajectories:
    """The folder of the case, with measured records of every class."""
    monkeypatch.chdir(tmp_path)
    # A process imports a module of one name once.
    module = f"oven_{tmp_path.name}"
    Path(f"{module}.py").write_text(MODULE)
    Path("oven.toml").write_text(CASE.replace("MODULE", module))
    case = rt.cases.get("oven.toml")
    noisy = rt.twins.NoisyTwin(case.twin, np.array([0.02]))
    real = rt.generate(noisy, case, per_class=3, seed=1)
    rt.save(real, "real.npz")
    rt.save(real.with_label("Healthy"), "healthy.npz")
    return real


@pytest.mark.slow
def test_faults_are_diagnosed_with_their_size(call, oven) -> None:
    for words in (
        ("fit", "oven.toml", "--dynamics", "--real", "healthy.npz", "--out", "model"),
        ("diagnose", "fit", "--from", "model", "--out", "physics"),
    ):
        code, _, err = call(*words)
        assert code == 0, err
    code, out, err = call("diagnose", "predict", "physics", "real.npz", "--json")
    assert code == 0, err
    found = json.loads(out)["trajectories"]
    assert np.mean([each["diagnosis"] == each["label"] for each in found]) >= 0.9
    leaks = [each for each in found if each["label"] == "leak" == each["diagnosis"]]
    assert all(0.05 <= each["size"] <= 0.1 and 10 <= each["onset in s"] <= 30 for each in leaks)
    healthy = next(each for each in found if each["label"] == "Healthy")
    assert healthy["size"] is None
    assert 0 <= healthy["unknown"] < 0.5
    code, out, err = call("diagnose", "predict", "physics", "real.npz")
    assert code == 0, err
    assert "unknown" in out
    assert "nan" not in out.lower()


def test_a_twin_in_command_space_needs_its_calibration(call, oven) -> None:
    code, _, err = call("diagnose", "fit", "--from", "no model", "--out", "physics")
    assert code == 2
    assert "no model" in err


@pytest.mark.slow
def test_a_study_of_a_system_with_states_and_faults(call, oven) -> None:
    sources = "dt,dynamics,inversion_dynamics"
    words = ("study", "oven.toml", "--real", "real.npz", "--folds", 2, "--sources", sources)
    code, _, err = call(*words, "--runs", 1, "--per-class", 40, "--processes", 1, "--out", "study")
    assert code == 0, err
    results = read_results("study")
    assert set(results.sources) == set(sources.split(","))
    assert results.sources["inversion_dynamics"].runs("macro_f1")[0] >= 0.8
