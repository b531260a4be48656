"""Monitors of machines whose work is trajectories: alarms, causes, and the promise."""

from __future__ import annotations

import json

import numpy as np
import pytest

import retwin as rt
from retwin.diagnosis.inversion.states import StateInversionDiagnoser
from retwin.errors import InputError
from retwin.monitor.models.trajectory.monitor import TrajectoryMonitor, fit_trajectory_monitor
from retwin.twins import ActuatorGain, Parameter, ParameterShift, SensorBias, State, StateTwin
from retwin.twins.faults.actuator_faults import Fault
from retwin.update import Dynamics, Library, fit_dynamics

pytestmark = pytest.mark.slow  # the command line's test is fast

NOISE = 0.02
TANK = StateTwin(
    (State("level", "m", 0.0),),
    lambda x, u: x.level,
    rt.Channels(("pump",), ("V",)),
    rt.Channels(("level",), ("m",)),
    10.0,
    derivative=lambda x, u, p: (u.pump - p.drain * x.level,),
    parameters=(Parameter("drain", "1/s", 0.05, 10.0, 1.0),),
)
FAULTS: dict[str, Fault | None] = {
    "Healthy": None,
    "leak": ParameterShift("drain", size=(0.1, 1.0), onset=(0.0, 5.0)),
    "weak pump": ActuatorGain(0, size=(-0.6, -0.1)),
}


def runs(count: int, seed: int, fault: Fault | None = None, noise: float = NOISE):
    rng = np.random.default_rng(seed)
    commands = np.repeat(rng.uniform(0.2, 2, size=(count, 5, 1)), 12, axis=1)
    made = TANK.simulate(commands, faults=[fault] * count, seed=0, parameters={"drain": 1.3})
    return made.replace(observed=made.observed + noise * rng.normal(size=made.observed.shape))


@pytest.fixture(scope="module")
def diagnoser() -> StateInversionDiagnoser:
    twin = fit_dynamics(TANK, runs(4, 0), Dynamics(Library(0, (), False))).twin
    return StateInversionDiagnoser(twin, FAULTS)


@pytest.fixture(scope="module")
def monitor(diagnoser: StateInversionDiagnoser) -> TrajectoryMonitor:
    return fit_trajectory_monitor(diagnoser, runs(20, 1), "500 trajectories")


def test_the_healthy_machine_raises_no_alarm(monitor: TrajectoryMonitor) -> None:
    state, watched = monitor.watch(runs(25, 2))
    assert not watched.alarms
    assert not watched.void.any()
    assert (state.count, np.isfinite(watched.score).all()) == (25, True)
    assert "at least 500 trajectories (50 minutes of 6 s each)" in monitor.promise


def test_a_fault_is_named_in_the_trajectory_in_which_it_begins(monitor: TrajectoryMonitor) -> None:
    state, _ = monitor.watch(runs(5, 3))
    leak = ParameterShift("drain", size=0.6, onset=3.0)
    _, watched = monitor.watch(runs(3, 4, leak), state)
    first = watched.alarms[0]
    assert (first.number, first.name) == (5, "leak")
    assert first.evidence >= 500


def test_evidence_accumulates_over_trajectories(monitor: TrajectoryMonitor) -> None:
    weak = ActuatorGain(0, size=-0.013)  # less than any that the diagnoser knows
    _, watched = monitor.watch(runs(15, 5, weak))
    assert watched.alarms
    assert watched.alarms[0].number > 0


def test_further_causes_are_watched_for(
    diagnoser: StateInversionDiagnoser, monitor: TrajectoryMonitor
) -> None:
    biased = SensorBias(0, size=0.1)
    wider = fit_trajectory_monitor(
        diagnoser, runs(8, 1), 500, causes={"sensor": SensorBias(0, size=(0.05, 0.5))}
    )
    assert wider.watch(runs(3, 6, biased))[1].alarms[0].name == "sensor"
    assert "sensor" not in monitor.diagnoser.classes


def test_a_machine_that_is_another_one_alarms_or_voids_the_promise(
    monitor: TrajectoryMonitor,
) -> None:
    _, watched = monitor.watch(runs(8, 7, noise=5 * NOISE))
    assert watched.alarms[0].name == "unknown"
    assert watched.void[-1]


def test_trajectories_one_by_one_give_the_same_bytes(monitor: TrajectoryMonitor) -> None:
    made = runs(6, 8, ActuatorGain(0, size=-0.03))
    _, whole = monitor.watch(made)
    state, parts = None, []
    for i in range(len(made)):
        state, watched = monitor.watch(made[[i]], state)
        parts.append(watched)
    for name in ("score", "evidence", "void"):
        joined = np.concatenate([getattr(each, name) for each in parts])
        assert joined.tobytes() == getattr(whole, name).tobytes()
    assert [a for each in parts for a in each.alarms] == whole.alarms


def test_it_is_saved_and_refuses_what_is_damaged(monitor: TrajectoryMonitor, tmp_path) -> None:
    monitor.save(tmp_path / "watch")
    loaded = TrajectoryMonitor.load(tmp_path / "watch")
    assert loaded.promise == monitor.promise
    made = runs(3, 9, FAULTS["leak"])
    assert loaded.watch(made)[1].alarms == monitor.watch(made)[1].alarms
    about = json.loads((tmp_path / "watch" / "model.json").read_text())
    (tmp_path / "watch" / "model.json").write_text(json.dumps(about | {"slack": [0.5, -1]}))
    with pytest.raises(InputError, match="kappa"):
        TrajectoryMonitor.load(tmp_path / "watch")


def test_what_cannot_calibrate_is_refused(diagnoser: StateInversionDiagnoser) -> None:
    with pytest.raises(InputError, match=r"healthy: expected .*at least 8"):
        fit_trajectory_monitor(diagnoser, runs(7, 1))
    leaking = runs(10, 1, ParameterShift("drain", size=0.5))
    with pytest.raises(InputError, match="some labelled Fault"):
        fit_trajectory_monitor(diagnoser, leaking)
    with pytest.raises(InputError, match="look like leak"):
        fit_trajectory_monitor(diagnoser, leaking.replace(labels=None))
    with pytest.raises(InputError, match="diagnoser by inversion"):
        fit_trajectory_monitor(diagnoser.twin, runs(10, 1))  # type: ignore[arg-type]
