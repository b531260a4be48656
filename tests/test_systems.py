"""The benchmark of all methods on all systems: its scores, and the folds of a row."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = str(Path(__file__).parents[1] / "benchmarks")


@pytest.fixture
def modules(monkeypatch):
    """The package and the command, which are no part of retwin."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    import systems
    from systems import cart, methods

    yield systems, cart, methods
    for name in [each for each in sys.modules if each.split(".")[0] == "systems"]:
        del sys.modules[name]


def test_a_twin_that_is_right_has_no_error_once_its_start_is_inferred(modules):
    _, cart, methods = modules
    force = np.random.default_rng(0).normal(size=(1, 200, 1))
    start = {"start_position": 1.0, "start_speed": 0.5}
    record = cart.CART.simulate(force, seed=0, parameters=start)
    right = cart.CART.parametric()
    assert methods.averaged(right, record, None, 20)[0] < 1e-4
    assert methods.averaged(right, record, None, 0)[0] > 1.0


def test_constants_are_scored_at_the_samples_after_the_warm_up(modules):
    _, cart, methods = modules
    position = np.arange(50.0) ** 2
    record = cart.trajectory(cart.CART, np.zeros(50), position)
    system = replace(cart.cart(Path()), calibration=record, tests={}, scale=1.0, horizon=None)
    mean, hold = (methods.Constant(system, hold=hold) for hold in (False, True))
    later = position[10:]
    system = replace(system, warm_up=0.5)  # 10 samples
    found = methods.score(mean, system, record)
    assert found["rmse"] == pytest.approx(np.sqrt(np.mean((later - position.mean()) ** 2)))
    assert found["crps"] == pytest.approx(np.mean(np.abs(later - position.mean())))
    found = methods.score(hold, system, record)
    assert found["rmse"] == pytest.approx(np.sqrt(np.mean((later - position[9]) ** 2)))
    assert found["ahead 10"] == pytest.approx(np.sqrt(np.mean((later - position[:-10]) ** 2)))


def test_the_table_pools_squares_of_folds(modules, monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    import runpy

    command = runpy.run_path(str(Path(BENCHMARKS) / "systems.py"))
    folds = [
        {"rmse": rmse, "crps": rmse, "coverage": None, "width": None, "seconds": 2.0, "note": "a"}
        for rmse in (3.0, 4.0)
    ]
    found = command["pooled"](folds)
    assert found["rmse"] == pytest.approx(np.sqrt(12.5))
    assert (found["crps"], found["seconds"], found["note"]) == (3.5, 4.0, "a")
    rows = {"row": {"unit": "m", "methods": {"twin": found}}}
    assert command["table"](rows, command["rmse"]).splitlines()[-1].split() == [
        "|",
        "row",
        "|",
        "m",
        "|",
        "3.54",
        "|",
    ]


def test_the_last_value_is_the_first_one_that_is_scored_where_none_is_before(modules):
    _, cart, methods = modules
    position = np.arange(50.0) ** 2
    position[:5] = np.nan
    record = cart.trajectory(cart.CART, np.zeros(50), position)
    system = replace(cart.cart(Path()), calibration=record, scale=1.0, horizon=None, warm_up=0.0)
    found = methods.score(methods.Constant(system, hold=True), system, record)
    assert found["rmse"] == pytest.approx(np.sqrt(np.mean((position[5:] - position[5]) ** 2)))
