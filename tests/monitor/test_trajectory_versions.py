"""Versions of a monitor of trajectories: compared, promoted and rolled back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from monitor.test_live_trajectories import APART, BEGIN, trajectories
from monitor.test_trajectory_monitor import NOISE, TANK, runs

from retwin.diagnosis.inversion.states import StateInversionDiagnoser
from retwin.errors import InputError
from retwin.monitor import Live, Registry, Store, compare, fit_monitor, verify
from retwin.monitor.models.trajectory.monitor import TrajectoryMonitor, fit_trajectory_monitor
from retwin.twins import ParameterShift
from retwin.update import Dynamics, Library, fit_dynamics

pytestmark = pytest.mark.slow
HEALTHY = 36


def fitted(noise: float) -> TrajectoryMonitor:
    """With the right promise, and simulations that are too wide if `noise` is too large."""
    twin = fit_dynamics(TANK, runs(4, 0, noise=noise), Dynamics(Library(0, (), False))).twin
    faults = {"Healthy": None, "leak": ParameterShift("drain", size=(0.1, 1.0))}
    return fit_trajectory_monitor(StateInversionDiagnoser(twin, faults), runs(9, 1), 100)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Version 1, whose twin is too uncertain, with what it watched; 2, the better one; and both."""
    folder = tmp_path_factory.mktemp("versions")
    made = {"1": fitted(3 * NOISE), "2": fitted(NOISE)}
    for name, monitor in made.items():
        monitor.save(folder / name)
    fit_monitor(made["2"].diagnoser.twin, runs(20, 5), 1000).save(folder / "samples")
    with Store(folder / "store") as opened:
        registry = Registry(opened, "robot")
        registry.promote(registry.propose(folder / "1", "first").number)
        live = Live(opened)
        live.add("a", "robot")
        live.submit(trajectories(runs(HEALTHY, 6)))
        for name in ("2", "1", "samples"):
            registry.shadow(registry.propose(folder / name, name).number)
    return folder / "store"


def test_the_better_version_is_promoted_and_rolled_back(store: Path) -> None:
    with Store(store) as opened:
        registry, live = Registry(opened, "robot"), Live(opened)
        found = compare(opened, "robot", 2)
        assert found.better, found.summary
        assert found.old_crps > found.new_crps > 0
        assert (found.false_alarms.samples, found.false_alarms.unit) == (HEALTHY, "trajectories")
        assert "0 alarms in 36 trajectories" in found.summary
        same = compare(opened, "robot", 3)
        assert (same.difference, same.better) == (0, False)
        with pytest.raises(InputError, match="evidence: expected a difference in CRPS"):
            registry.promote(3, same)
        with pytest.raises(InputError, match="monitor of trajectories, as version 1 is"):
            compare(opened, "robot", 4)
        more = trajectories(runs(3, 7), first=HEALTHY)
        before = live.monitor("a").watch(runs(3, 7))[1].evidence.tobytes()
        registry.promote(2, found)
        live.refresh()
        assert live.submit(more[:1])[0].counts.used == 1
        assert live.status()[0].version == 2
        assert len(opened.state("a")[1]["trajectories"]) == HEALTHY + 1, "of both versions"
        registry.rollback("a test")
        live.refresh()
        assert live.monitor("a").watch(runs(3, 7))[1].evidence.tobytes() == before
        assert live.submit(more[1:2])[0].counts.used == 1
        steps = [entry.data["step"] for entry in opened.log("version")]
        assert steps[-2:] == ["promote", "rollback"]
        assert not verify(opened.log(), opened.head).reason


def test_too_few_healthy_trajectories_decide_nothing(store: Path) -> None:
    leaking = trajectories(runs(1, 8, ParameterShift("drain", size=0.6)), first=HEALTHY + 10)
    with Store(store) as opened:
        live = Live(opened)
        assert live.submit(leaking)[0].alarms == 1
        known = opened.state("a")[1]["trajectories"]
        assert known[0].tolist() == [BEGIN, BEGIN + round(5.9e9), 60]
        assert (np.diff(known[: HEALTHY + 2, 0]) == APART).all()
        with pytest.raises(InputError, match=r"trajectories: expected at least 32.*got 28"):
            compare(opened, "robot", 3)
