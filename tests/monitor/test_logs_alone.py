"""Monitors of logs without a twin, and what they say that they see."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

import retwin as rt
from retwin.monitor import Monitor, fit_monitor, possible_causes, visible_sizes
from retwin.twins import ParameterShift, SensorBias

COUNT = 3


def sensors(seed: int, steps: int) -> rt.Trajectories:
    """Three sensors without commands, autocorrelated."""
    noise = np.random.default_rng(seed).normal(size=(1, steps, COUNT))
    observed = lfilter([1], [1, -0.6], noise, axis=1) + np.array([0.0, 20.0, -5.0])
    return rt.Trajectories(
        commands=np.zeros((1, steps, 0)),
        nominal=np.zeros_like(observed),
        observed=observed,
        rate=1.0,
        inputs=rt.Channels((), ()),
        outputs=rt.Channels(("a", "b", "c"), ("1",) * COUNT),
    )


@pytest.fixture(scope="module")
def monitor() -> Monitor:
    return fit_monitor(None, sensors(0, 400))


def test_a_level_that_differs_is_an_event_until_it_ends(monitor: Monitor) -> None:
    run = sensors(1, 600)
    observed = run.observed.copy()
    observed[:, 200:400, 1] += 6.0
    found = monitor.watch(run.replace(observed=observed))
    first, end = found.events[0], found.endings[0]
    assert first.output == "b"
    assert 200 <= first.sample < 230
    assert 395 < end.sample < 450
    assert not found.void.any()
    assert not monitor.watch(run).alarms


@pytest.mark.slow
def test_what_is_seen_is_saved_and_true(monitor: Monitor, tmp_path: Path) -> None:
    found = visible_sizes(monitor, sensors(2, 1200), possible_causes(monitor.twin))
    rows = {each.fault: each for each in found}
    offset = rows["b: sensor offset"]
    assert offset.size is not None
    assert offset.share >= 0.9
    made = sensors(3, 300 + round(offset.within))
    observed = made.observed.copy()
    observed[:, 300:, 1] += offset.size
    assert monitor.watch(made.replace(observed=observed)).alarm[0, 300:].any()
    replace(monitor, visible=tuple(found)).save(tmp_path / "watch")
    assert Monitor.load(tmp_path / "watch").visible == tuple(found)
    assert "from" in str(offset)


@pytest.mark.slow
def test_causes_of_a_case_are_not_those_of_a_black_box() -> None:
    monitor = fit_monitor(None, sensors(0, 600), "1 per day")
    name = monitor.twin.equations.parameters[0].name
    offset = SensorBias(0, size=(0.1, 1.0))
    for parameter, known in (("drain", False), (name, True)):
        causes = {"leak": ParameterShift(parameter, size=(0.5, 1.0)), "offset": offset}
        found = possible_causes(monitor.twin, causes)
        assert ([*found] == ["Healthy", "leak", "offset"]) == known
        assert f"{monitor.twin.outputs.names[0]}: sensor drift" in found or known
