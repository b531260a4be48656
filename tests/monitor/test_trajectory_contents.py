"""Whatever trajectories contain has one behaviour of their monitor, which the result states."""

from __future__ import annotations

import numpy as np
import pytest
from monitor.test_trajectory_monitor import TANK, runs

from retwin.data.trajectories import Trajectories
from retwin.diagnosis.inversion.states import StateInversionDiagnoser
from retwin.errors import InputError
from retwin.monitor.detect.offsets import OffsetModel, fit_offsets
from retwin.monitor.models.trajectory.evidence import checked
from retwin.monitor.models.trajectory.monitor import TrajectoryMonitor, fit_trajectory_monitor
from retwin.monitor.models.trajectory.state import TrajectoryState
from retwin.twins import ActuatorGain, ParameterShift
from retwin.twins.faults.actuator_faults import ActuatorBias
from retwin.update import Dynamics, Library, fit_dynamics


@pytest.fixture(scope="module")
def monitor() -> TrajectoryMonitor:
    twin = fit_dynamics(TANK, runs(4, 0), Dynamics(Library(0, (), False))).twin
    # A leak from the start, which is quicker to infer than one with an open onset.
    faults = {"Healthy": None, "leak": ParameterShift("drain", size=(0.1, 1.0))}
    return fit_trajectory_monitor(StateInversionDiagnoser(twin, faults), runs(9, 1), 100)


@pytest.fixture(scope="module")
def healthy() -> Trajectories:
    return runs(3, 3)


def masked(given: Trajectories, row: int) -> Trajectories:
    mask = given.mask.copy()
    mask[row] = False
    return given.replace(mask=mask)


def with_output(given: Trajectories, row: int, value: float) -> Trajectories:
    observed = given.observed.copy()
    observed[row] = value
    return given.replace(observed=observed)


@pytest.mark.slow
def test_a_trajectory_without_measurements_is_no_evidence_and_changes_nothing(
    monitor: TrajectoryMonitor, healthy: Trajectories
) -> None:
    state, watched = monitor.watch(masked(healthy, 1))
    others, without = monitor.watch(healthy[[0, 2]])
    assert watched.unmeasured.tolist() == [False, True, False]
    assert np.isnan(watched.score[1])
    assert watched.evidence[1] == watched.evidence[0]
    assert state.evidence.tobytes() == others.evidence.tobytes()
    assert watched.score[[0, 2]].tobytes() == without.score.tobytes()
    assert (state.count, others.count) == (3, 2)
    assert watched.remarks == ["1 without measured samples, which are no evidence"]
    many = runs(60, 4)
    quiet = monitor.watch(many.replace(mask=np.zeros_like(many.mask)))[1]
    assert not quiet.alarms
    assert not quiet.evidence.any()


@pytest.mark.slow
def test_a_trajectory_measured_otherwise_is_not_ranked_but_shows_faults(
    monitor: TrajectoryMonitor, healthy: Trajectories
) -> None:
    mask = healthy.mask.copy()
    mask[:, 30:] = False
    for given in (healthy.replace(mask=mask), healthy.between(0, 3)):
        watched = monitor.watch(given)[1]
        assert watched.unranked.all()
        assert np.isnan(watched.score).all()
        assert "measured otherwise than in the calibration" in watched.remarks[0]
    leaking = runs(3, 4, ParameterShift("drain", size=1.0)).between(0, 4)
    assert monitor.watch(leaking)[1].alarms[0].name == "leak"
    assert not monitor.watch(healthy.padded(90))[1].unranked.any()


@pytest.mark.slow
@pytest.mark.parametrize("value", [1e9, 1e300])
def test_readings_that_nothing_can_have_caused_are_named_and_are_no_fault(
    monitor: TrajectoryMonitor, healthy: Trajectories, value: float
) -> None:
    watched = monitor.watch(with_output(healthy, 1, value))[1]
    assert watched.implausible.tolist() == [False, True, False]
    assert watched.score[1] > watched.score[[0, 2]].max()
    assert np.isfinite(watched.evidence).all()
    before = monitor.watch(healthy[[0]])[0]
    after = monitor.watch(with_output(healthy, 1, value)[[1]], before)[0]
    assert after.evidence.tobytes() == before.evidence.tobytes()
    assert "no healthy machine can have caused" in watched.remarks[0]
    stuck = with_output(runs(60, 5), slice(None), value)  # type: ignore[arg-type]
    (first, *_) = monitor.watch(stuck)[1].alarms
    assert first.name == "unknown"


@pytest.mark.slow
def test_commands_outside_their_range_are_stated_in_the_alarm(
    monitor: TrajectoryMonitor, healthy: Trajectories
) -> None:
    _, watched = monitor.watch(healthy.replace(commands=5 * healthy.commands))
    assert watched.outside.all()
    assert watched.alarms[0].outside
    assert "commands stay in their range" in monitor.promise


@pytest.mark.slow
def test_no_trajectories_change_nothing_and_what_does_not_fit_is_refused(
    monitor: TrajectoryMonitor, healthy: Trajectories
) -> None:
    state = monitor.watch(healthy)[0]
    after, watched = monitor.watch(healthy[[]], state)
    assert (after.count, len(watched.evidence)) == (3, 0)
    with pytest.raises(InputError, match=r"trajectories.rate"):
        monitor.watch(healthy.replace(rate=5.0))
    arrays = {**state.arrays(), "evidence": np.zeros(7)}
    with pytest.raises(InputError, match="state: expected one of this monitor"):
        monitor.watch(healthy, TrajectoryState.of_arrays(arrays))


@pytest.mark.slow
def test_saved_states_continue_with_the_same_bytes(
    monitor: TrajectoryMonitor, healthy: Trajectories, tmp_path
) -> None:
    weak = runs(4, 6, ActuatorGain(0, size=-0.05))
    whole, expected = monitor.watch(weak)
    monitor.save(tmp_path / "watch")
    again = TrajectoryMonitor.load(tmp_path / "watch")
    state = TrajectoryState.of_arrays(monitor.watch(weak[[0, 1]])[0].arrays())
    last, found = again.watch(weak[[2, 3]], state)
    assert found.evidence.tobytes() == expected.evidence[2:].tobytes()
    assert found.alarms == [a for a in expected.alarms if a.number > 1]
    for name, each in whole.arrays().items():
        assert last.arrays()[name].tobytes() == each.tobytes(), name


@pytest.mark.slow
def test_what_calibrates_is_stated_and_faulty_labels_are_refused(
    monitor: TrajectoryMonitor,
) -> None:
    diagnoser, given = monitor.diagnoser, runs(9, 1)
    made = fit_trajectory_monitor(diagnoser, masked(given, 2), 100)
    assert (made.used, made.given) == (8, 9)
    assert "Of the 9 trajectories of the calibration 8 were used" in made.promise
    none = given.replace(mask=np.zeros_like(given.mask))
    with pytest.raises(InputError, match="9, of which 9 without measured samples"):
        fit_trajectory_monitor(diagnoser, none, 100)
    with pytest.raises(InputError, match="some labelled leak"):
        fit_trajectory_monitor(diagnoser, given.replace(labels=np.array(["leak"] * 9)), 100)
    with pytest.raises(InputError, match="alpha"):
        fit_trajectory_monitor(diagnoser, given, 100, alpha=2.0)


@pytest.mark.slow
def test_a_healthy_class_of_any_name_is_found_and_unknown_is_no_class(
    monitor: TrajectoryMonitor, healthy: Trajectories
) -> None:
    twin, leak = monitor.diagnoser.twin, monitor.diagnoser.faults["leak"]  # type: ignore[union-attr]
    named = StateInversionDiagnoser(twin, {"leak": leak, "in order": None})
    labelled = runs(9, 1).replace(labels=np.array(["in order"] * 9))
    made = fit_trajectory_monitor(named, labelled, 100)
    assert not made.watch(healthy)[1].alarms
    with pytest.raises(InputError, match="none called 'unknown'"):
        checked(StateInversionDiagnoser(twin, {"fine": None, "unknown": leak}))


@pytest.mark.slow
def test_equal_causes_share_the_probability_of_an_alarm(monitor: TrajectoryMonitor) -> None:
    twin, leak = monitor.diagnoser.twin, monitor.diagnoser.faults["leak"]  # type: ignore[union-attr]
    twice = StateInversionDiagnoser(twin, {"fine": None, "leak": leak, "also a leak": leak})
    watch = fit_trajectory_monitor(twice, runs(9, 1), 100)
    (alarm, *_) = watch.watch(runs(2, 4, ParameterShift("drain", size=1.0)))[1].alarms
    assert alarm.name == "leak"
    assert alarm.shares["leak"] == alarm.shares["also a leak"] == alarm.probability <= 0.5


def drawn(count: int, seed: int, bias: float = 0.0) -> np.ndarray:
    """Offsets of 2 actuators in 4 segments; a bias of the first has any sign in each."""
    rng = np.random.default_rng(seed)
    made = rng.standard_t(8, size=(count, 4, 2)) * (1.0, 3.0)
    made[..., 0] += bias * rng.choice((-1, 1), size=made.shape[:2])
    return made


def test_a_bias_as_small_as_two_offsets_shows_over_trajectories() -> None:
    faults = [None, ActuatorBias(0, (1.0, 4.0)), ActuatorBias(1, (3.0, 12.0))]
    model = fit_offsets(drawn(60, 0))
    assert (model.kappa > 1).all()
    assert (model.kappa < 1.5).all()
    biased = model.ratio(drawn(10, 1, bias=2.5), faults).sum(axis=0)
    assert biased[0].max() > 10 > 0 > biased[1].max()
    # The expectation of the ratio of healthy machines is at most 1, as of an e-value.
    healthy = np.exp(model.ratio(drawn(20_000, 2), faults)).mean(axis=0)
    assert (healthy < 1).all()


def test_offsets_that_were_never_estimated_are_no_evidence() -> None:
    given = drawn(12, 3)
    given[..., 1] = np.nan
    model = fit_offsets(given)
    faults = [ActuatorBias(0, (1.0, 4.0)), ActuatorBias(1, (3.0, 12.0))]
    ratio = model.ratio(drawn(3, 4, bias=1e200), faults)
    assert np.isfinite(ratio).all()
    assert not ratio[:, 1].any()
    assert not model.ratio(np.full((2, 4, 2), np.nan), faults).any()
    again = OffsetModel.of_arrays(model.arrays(), 2)
    assert again is not None
    assert again.ratio(given, faults).tobytes() == model.ratio(given, faults).tobytes()
    with pytest.raises(InputError, match="offsets of 3 actuators"):
        OffsetModel.of_arrays(model.arrays(), 3)
