"""Monitors of running machines: alarms, promises, and what they remember."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.errors import InputError
from retwin.monitor.detect.detector import Detector
from retwin.monitor.detect.events import FOLLOWS
from retwin.monitor.detect.predictors import SLOWER, agreeing
from retwin.monitor.detect.slack import Slack
from retwin.monitor.models.cause import CauseSearch, find_causes, possible_causes
from retwin.monitor.models.fitting import fit_monitor
from retwin.monitor.models.monitor import Monitor
from retwin.monitor.models.state import MonitorState, Watched
from retwin.twins import (
    ActuatorGain,
    Parameter,
    ParameterDrift,
    ParameterShift,
    SensorBias,
    SensorGain,
    State,
    StateTwin,
    Stuck,
)
from retwin.twins.faults.actuator_faults import Fault
from retwin.update import Dynamics, DynamicsTwin, Library, fit_dynamics

RATE = 10.0
NOISE = 0.02
TANK = StateTwin(
    (State("level", "m", 0.0, 0.0, 2.0),),
    lambda x, u: (x.level, 2 * x.level),
    rt.Channels(("pump",), ("V",)),
    rt.Channels(("level", "pressure"), ("m", "kPa")),
    RATE,
    derivative=lambda x, u, p: (u.pump - p.drain * x.level,),
    parameters=(Parameter("drain", "1/s", 0.05, 10.0, 1.0),),
)


def record(
    count: int, seed: int, steps: int = 600, faults: list | None = None, **truth: float
) -> rt.Trajectories:
    rng = np.random.default_rng(seed)
    commands = np.repeat(rng.uniform(0, 2, size=(count, steps // 20, 1)), 20, axis=1)
    made = TANK.simulate(commands, faults=faults, seed=0, parameters={"drain": 1.3, **truth})
    noise = NOISE * rng.normal(size=made.observed.shape)
    return made.replace(observed=made.observed + noise)


@pytest.fixture(scope="module")
def twin() -> DynamicsTwin:
    settings = Dynamics(Library(0, (), False))
    return fit_dynamics(TANK, record(1, 0), settings).twin


@pytest.fixture(scope="module")
def monitor(twin: DynamicsTwin) -> Monitor:
    return fit_monitor(twin, record(2, 1), "1 per hour")


def test_a_record_that_the_twin_does_not_follow_is_named(twin: DynamicsTwin) -> None:
    faults = [None, ParameterShift("drain", size=1.3, onset=12.0), None]
    named = r"in 00001 errors of (level|pressure) are .* the largest of .*, from 1[0-9.]+ s to"
    with pytest.warns(UserWarning, match=named) as given:
        fit_monitor(twin, record(3, 7, steps=240, faults=faults), "1 per hour")
    assert len([each for each in given if "errors of" in str(each.message)]) == 1
    fit_monitor(twin, record(3, 7, steps=240), "1 per hour")  # warnings are errors


def test_free_simulation_shows_what_changes(monitor: Monitor, tmp_path: Path) -> None:
    monitor.save(tmp_path / "watch")
    again = Monitor.load(tmp_path / "watch")
    assert again.find_free_errors(record(2, 9)) == {}
    slow = record(1, 9, faults=[ParameterDrift("drain", size=0.02, onset=20.0)])
    found = again.find_free_errors(slow)
    assert found == monitor.find_free_errors(slow)
    first, largest, usual = found["level"]
    assert (20 < first < 60, largest > 2 * usual, usual < 3 * NOISE) == (True, True, True)
    assert replace(again, free=()).find_free_errors(slow) == {}  # it diverged in calibration


def test_nothing_is_promised_before_outputs_are_in_the_range_of_the_calibration(
    monitor: Monitor,
) -> None:
    high = monitor.noise.high[-2:]
    whole = record(2, 4)
    assert monitor.find_begin(whole) == 0
    # A machine that begins far above, with a fault: first a remark, and an event from 20 s on.
    observed = whole.observed.copy()
    observed[1, :200] = 3 * high
    observed[1, 200:220] = whole.observed[1, 200:220]
    observed[1, 220:, 0] += 0.5
    begun = whole.replace(observed=observed)
    assert monitor.find_begin(begun) == 20.0
    found = monitor.watch(begun).events
    assert {each.trajectory for each in found} == {begun.ids[1]}
    assert [each.promised for each in found] == [each.time >= 20 for each in found]
    assert {each.promised for each in found} == {True, False}
    state, measured = monitor.start(2), begun.measured
    for part in np.split(np.arange(600), [1, 150, 201]):
        state, _ = monitor.step(state, begun.commands[:, part], measured[:, part], begun.ids)
    assert (state.entered == 2).all()
    again = MonitorState.of_arrays(state.arrays())
    np.testing.assert_array_equal(again.entered, state.entered)


def leaking(seed: int = 5) -> rt.Trajectories:
    """Three machines of which the second one leaks from 30 s on, without some samples."""
    leak = ParameterShift("drain", size=1.3, onset=30.0)
    whole = record(3, seed, faults=[None, leak, None])
    return whole.replace(mask=np.random.default_rng(0).random(whole.observed.shape) > 0.05)


def arrays_of(watched: Watched) -> list[np.ndarray]:
    names = (each.name for each in fields(watched))
    lists = ("alarms", "endings", "outside")
    return [getattr(watched, each) for each in names if each not in lists]


def cut(monitor: Monitor, whole: rt.Trajectories, places: list[int]) -> tuple[list, list, list]:
    state, arrays, alarms = monitor.start(len(whole)), [], []
    measured = np.where(whole.mask, whole.observed, np.nan)
    parts = (np.split(each, places, axis=1) for each in (whole.commands, measured))
    for part in zip(*parts, strict=True):
        state, found = monitor.step(state, *part, whole.ids)
        arrays.append(arrays_of(found))
        alarms += [*found.alarms, *found.endings]
    joined = [np.concatenate(each, axis=1).tobytes() for each in zip(*arrays, strict=True)]
    return joined, alarms, [each.tobytes() for each in state.arrays().values()]


def test_a_leak_is_found_in_the_machine_that_leaks_alone(monitor: Monitor) -> None:
    found = monitor.watch(leaking())
    assert {each.trajectory for each in found.alarms} == {leaking().ids[1]}
    first = found.alarms[0]
    assert 30.0 < first.time < 33.0
    assert first.change == "lower than predicted"
    assert first.evidence >= monitor.arl
    assert found.alarm[1].sum() == len(found.alarms)
    assert found.mean.shape == (3, 600, 2)
    assert found.score.shape == (3, 600, 2)


@pytest.mark.slow
def test_however_samples_are_cut_the_results_are_the_same_bytes(monitor: Monitor) -> None:
    whole = leaking()
    wanted = cut(monitor, whole, [])
    assert wanted[1]
    assert cut(monitor, whole, [1, 2, 305, 311, 590]) == wanted
    assert cut(monitor, whole, list(range(1, 600))) == wanted


@pytest.mark.slow
def test_a_machine_is_watched_the_same_beside_others(monitor: Monitor) -> None:
    whole = leaking()
    for both in zip(
        arrays_of(monitor.watch(whole)), arrays_of(monitor.watch(whole[[1]])), strict=True
    ):
        np.testing.assert_array_equal(both[0][1], both[1][0])


def pulse(until: float) -> rt.Trajectories:
    """A machine that leaks from 30 s on, until a time in s."""
    leak = ParameterShift("drain", size=1.3, onset=30.0, end=until)
    return record(1, 5, steps=1200, faults=[leak])


def test_an_event_lasts_until_the_twin_follows_again(monitor: Monitor) -> None:
    found = monitor.watch(pulse(40.0))
    (first,), (end,) = found.events, found.endings
    assert 30.0 < first.time < 33.0
    assert (end.event, end.how) == (first.sample, FOLLOWS)
    assert 40.0 < end.sample / RATE < 60.0
    assert all(each.event == first.sample for each in found.alarms)
    np.testing.assert_array_equal(
        np.flatnonzero(found.event[0]), np.arange(first.sample, end.sample + 1)
    )
    assert not found.void.any()


@pytest.mark.slow
def test_an_event_that_does_not_end_is_a_change_and_new_faults_alarm(monitor: Monitor) -> None:
    soon = replace(monitor, lasting=10.0)
    found = soon.watch(
        record(1, 5, steps=1200, faults=[ParameterShift("drain", size=1.3, onset=30.0)])
    )
    changed = [each for each in found.endings if each.how == "changed"]
    assert changed
    assert changed[0].sample - changed[0].event == 100
    whole = pulse(1e9)
    offset = whole.replace(observed=whole.observed + 0.5 * (np.arange(1200) >= 1000)[None, :, None])
    late = [each.time for each in soon.watch(offset).alarms if each.time >= 100.0]
    assert late
    assert late[0] < 103.0


@pytest.mark.slow
def test_the_state_is_arrays_that_are_joined_and_divided(monitor: Monitor) -> None:
    whole = leaking()
    measured = np.where(whole.mask, whole.observed, np.nan)
    now, later = slice(0, 310), slice(310, 600)
    state, _ = monitor.step(monitor.start(3), whole.commands[:, now], measured[:, now])
    arrays = {name: each[[2, 1]] for name, each in state.arrays().items()}
    again = MonitorState.of_arrays(arrays)
    own = monitor.step(again, whole.commands[[2, 1], later], measured[[2, 1], later])[1]
    wanted = monitor.step(state, whole.commands[:, later], measured[:, later])[1]
    np.testing.assert_array_equal(own.evidence, wanted.evidence[[2, 1]])


@pytest.mark.slow
def test_a_machine_that_was_rebuilt_voids_the_promise(monitor: Monitor) -> None:
    found = replace(monitor, lasting=5.0).watch(record(1, 7, steps=1200, drain=2.6))
    assert "changed" in {each.how for each in found.endings}
    assert found.void[0, -1]
    assert not found.void[0, 0]
    # What is seen from then on are remarks.
    assert {each.promised for each in found.alarms} == {True, False}
    assert all(each.promised != found.void[0, each.sample] for each in found.alarms)
    assert not monitor.watch(record(4, 8, steps=1200)).void.any()


def test_what_is_not_measured_is_no_evidence(monitor: Monitor) -> None:
    whole = record(1, 3)
    found = monitor.watch(whole.replace(mask=whole.mask & False))
    assert (found.evidence == 0).all()
    assert np.isnan(found.score).all()


def test_a_missing_command_is_the_one_before(monitor: Monitor) -> None:
    whole = record(1, 3)
    commands = whole.commands.astype(float).copy()
    commands[0, 105:115] = np.nan  # within 20 equal samples
    state = monitor.start(1)
    found = monitor.step(state, commands, whole.observed)[1]
    np.testing.assert_array_equal(found.score, monitor.watch(whole).score)
    commands[0, 0] = np.nan
    with pytest.raises(InputError, match="commands"):
        monitor.step(state, commands, whole.observed)


@pytest.mark.parametrize("wrong", [1e6, -1e12, 3.4e38, 1e308, np.inf])
def test_a_command_that_cannot_be_one_is_the_one_before(monitor: Monitor, wrong: float) -> None:
    whole = record(1, 3)
    commands, measured = whole.commands.astype(float), whole.observed
    commands[0, 301] = wrong
    held = commands.copy()
    held[0, 301] = held[0, 300]
    expected = monitor.step(monitor.start(1), held, measured)[1]
    state, first = monitor.step(monitor.start(1), commands[:, :302], measured[:, :302])
    found = monitor.step(state, commands[:, 302:], measured[:, 302:])[1]
    joined = np.concatenate([first.evidence, found.evidence], axis=1)
    assert joined.tobytes() == expected.evidence.tobytes()
    assert first.outside[0] == np.isfinite(wrong)
    assert not found.outside[0]
    assert not expected.alarms


def test_a_first_command_that_cannot_be_one_is_taken_as_it_is(monitor: Monitor) -> None:
    whole = record(1, 3, steps=200)
    commands = whole.commands.astype(float)
    commands[0, 0] = 1e9
    found = monitor.step(monitor.start(1), commands, whole.observed)[1]
    assert found.outside[0]
    assert np.isfinite(found.evidence).all()


@pytest.mark.parametrize("value", [1e300, -1e300, np.inf, np.nan])
def test_hostile_outputs_leave_the_monitor_usable(monitor: Monitor, value: float) -> None:
    whole = record(1, 3)
    observed = whole.observed.astype(float).copy()
    observed[0, 300] = value
    found = monitor.step(monitor.start(1), whole.commands, observed)[1]
    assert np.isfinite(found.evidence).all()
    assert np.isfinite(found.mean).all()
    assert np.isfinite(found.score[0, 500:]).all()


@pytest.mark.slow
def test_a_saved_monitor_is_the_same(monitor: Monitor, tmp_path) -> None:
    monitor.save(tmp_path / "monitor")
    again = Monitor.load(tmp_path / "monitor")
    assert again.promises == monitor.promises
    for both in zip(
        arrays_of(again.watch(leaking())), arrays_of(monitor.watch(leaking())), strict=True
    ):
        np.testing.assert_array_equal(*both)


def test_the_promise_is_a_sentence_with_its_assumption(monitor: Monitor) -> None:
    text = str(monitor.promises["level"])
    assert "36000" in text
    assert "slack" not in text
    assert str(monitor.slack[0]) in text


def test_other_channels_and_too_few_samples_are_refused(
    monitor: Monitor, twin: DynamicsTwin
) -> None:
    with pytest.raises(InputError, match="measured"):
        monitor.step(monitor.start(2), np.zeros((2, 5, 1)), np.zeros((2, 5, 1)))
    with pytest.raises(InputError, match="measured"):
        monitor.step(monitor.start(1), np.zeros((2, 5, 1)), np.zeros((2, 5, 2)))
    other = replace(record(1, 0), rate=5.0)
    with pytest.raises(InputError, match="rate"):
        monitor.watch(other)
    with pytest.raises(InputError, match="longer"):
        fit_monitor(twin, record(1, 0, steps=40))
    with pytest.raises(InputError, match="fit_dynamics"):
        fit_monitor(monitor, record(1, 0))  # type: ignore[arg-type]


@pytest.mark.slow
def test_values_that_no_healthy_machine_gives_are_named(twin: DynamicsTwin) -> None:
    healthy = record(1, 1)
    huge, frozen = healthy.observed.copy(), healthy.observed.copy()
    huge[0, 300, 1] = 1e300
    with pytest.raises(InputError, match=r"got 1e\+300 of pressure"):
        fit_monitor(twin, replace(healthy, observed=huge))
    frozen[..., 1] = 1.0
    with pytest.warns(UserWarning, match="healthy: pressure, never changes"):
        fit_monitor(twin, replace(healthy, observed=frozen))


def test_the_cause_of_an_alarm_is_named_with_its_onset_and_size(
    twin: DynamicsTwin, monitor: Monitor
) -> None:
    watched = leaking()
    first = monitor.watch(watched).alarms[:1]
    faults = {
        "Healthy": None,
        "leak": ParameterShift("drain", size=(0.1, 5.0)),
        "weak pump": ActuatorGain(0, size=(-0.9, -0.1)),
        "level sensor": SensorBias(0, size=(-1.0, 1.0)),
    }
    (cause,) = find_causes(twin, watched, first, faults)
    assert cause.name == "leak"
    assert cause.probability > 0.99
    assert abs(cause.onset[0] - 30.0) < 0.5
    assert cause.size[1] < 1.3 < cause.size[2]
    with pytest.raises(InputError, match="alarms"):
        find_causes(twin, watched[[0]], first, faults)


def named_causes(monitor: Monitor, watched: rt.Trajectories) -> tuple[list[str], int]:
    """The causes of the first event until 42 s, and the number of its alarms."""
    alarms = monitor.watch(watched).alarms
    event = [each for each in alarms if each.event == alarms[0].event and each.time < 42]
    found = find_causes(monitor.twin, watched, event, possible_causes(monitor.twin))
    return [each.name for each in found if not each.same], len(found)


@pytest.mark.slow
@pytest.mark.parametrize("end", [None, 40.0])
def test_a_fault_that_lasts_or_ends_is_the_only_cause_of_its_event(
    monitor: Monitor, end: float | None
) -> None:
    leak = ParameterShift("drain", size=1.3, onset=30.0, end=end)
    names, count = named_causes(monitor, record(1, 5, faults=[leak]))
    assert names == ["drain changed"]
    assert count > 1, "further alarms belong to the event"


def test_an_alarm_just_after_the_first_one_names_no_second_fault(monitor: Monitor) -> None:
    """Its window has the onset of the first fault, which it may explain by another class."""
    leaking = record(1, 5, faults=[ParameterShift("drain", size=1.3, onset=30.0)])
    alarms = monitor.watch(leaking).alarms[:2]
    assert alarms[1].sample - alarms[0].sample <= 10
    first, further = find_causes(monitor.twin, leaking, alarms, possible_causes(monitor.twin))
    assert (first.name, first.same) == ("drain changed", False)
    assert further == replace(first, alarm=alarms[1], same=True)


def test_a_wrong_cause_is_replaced_by_the_one_that_explains_the_event(monitor: Monitor) -> None:
    leaking = record(1, 5, faults=[ParameterShift("drain", size=1.3, onset=30.0)])
    first, *further = monitor.watch(leaking).alarms
    alarms = [first, next(each for each in further if each.sample - first.sample > 10)]
    causes, other = possible_causes(monitor.twin), "pump: another effect"
    for current, same in ((other, False), ("drain changed", True)):
        cause = CauseSearch(monitor.twin, leaking, causes).find(alarms, (current, 0.0))
        assert (cause.name, cause.same, cause.unit) == ("drain changed", same, "1/s")
        assert cause.size[1] < 1.3 < cause.size[2]
    assert cause.onset[0] < first.time


@pytest.mark.slow
def test_a_second_fault_in_an_event_is_named(monitor: Monitor) -> None:
    leak = ParameterShift("drain", size=1.3, onset=30.0, end=33.0)
    one = record(1, 5, faults=[leak])
    both = one.observed.copy()
    both[:, 345:, 1] += 1.0
    names, _ = named_causes(monitor, one.replace(observed=both))
    assert names == ["drain changed", "pressure: sensor offset"]


@pytest.mark.parametrize(
    ("fault", "name"),
    [
        (ParameterShift("drain", size=1.3, onset=30.0), "drain changed"),
        (ActuatorGain(0, size=-0.4, onset=30.0), "pump: another effect"),
        (SensorBias(1, size=0.3, onset=30.0), "pressure: sensor offset"),
        (ParameterDrift("drain", size=0.1, onset=30.0), "drain drifting"),
    ],
)
def test_causes_are_any_change_where_no_faults_are_known(
    monitor: Monitor, fault: Fault, name: str
) -> None:
    watched = record(1, 5, faults=[fault])
    first = monitor.watch(watched).alarms[:1]
    (cause,) = find_causes(monitor.twin, watched, first, possible_causes(monitor.twin))
    assert cause.name == name
    assert cause.onset[1] - 0.5 < 30.0 < cause.onset[2] + 0.5
    known = {"Healthy": None, "leak": ParameterShift("drain", size=1.0), "stuck": Stuck(0)}
    assert [*possible_causes(monitor.twin, known)] == ["Healthy", "leak"]


@pytest.mark.parametrize(
    ("fault", "kind", "other"),
    [
        (SensorGain(1, size=0.15, onset=30.0), "gain", "offset"),
        (SensorGain(1, size=-0.15, onset=30.0), "gain", "offset"),
        (SensorBias(1, size=0.3, onset=30.0), "offset", "gain"),
    ],
)
def test_a_gain_of_a_sensor_differs_from_an_offset_once_the_output_varies(
    monitor: Monitor, fault: SensorGain | SensorBias, kind: str, other: str
) -> None:
    watched, causes = record(1, 5, faults=[fault]), possible_causes(monitor.twin)
    first, *further = monitor.watch(watched).alarms
    (early,) = find_causes(monitor.twin, watched, [first], causes)
    both = [early.probabilities[f"pressure: sensor {each}"] for each in (kind, other)]
    assert sum(both) > 0.95, "either, until the level has changed"
    assert max(both) < 0.8
    later = [next(each for each in further if each.time > 36)]
    (cause,) = find_causes(monitor.twin, watched, later, causes)
    assert cause.name == f"pressure: sensor {kind}"
    assert cause.probability > 0.99
    assert cause.size[1] < fault.size < cause.size[2]
    assert cause.unit == ("of the true value" if kind == "gain" else "kPa")


def test_larger_noise_of_a_machine_at_rest_is_no_gain_of_a_sensor(monitor: Monitor) -> None:
    rng, noise = np.random.default_rng(5), np.ones((600, 2))
    noise[350:, 1] = 2.5
    still = TANK.simulate(np.zeros((1, 600, 1)), seed=0)
    watched = still.replace(observed=NOISE * noise * rng.normal(size=(1, 600, 2)))
    alarm = [each for each in monitor.watch(watched).alarms if each.time > 35][:1]
    (cause,) = find_causes(monitor.twin, watched, alarm, possible_causes(monitor.twin))
    assert cause.unknown > 0.9
    assert cause.probabilities["pressure: sensor gain"] < 0.5


def test_a_dead_time_is_no_cause() -> None:
    late = Parameter("late", "s", 0.0, 0.5, 0.2)
    delayed = replace(TANK, parameters=(*TANK.parameters, late), delays={"pump": "late"})
    twin = fit_dynamics(delayed, record(1, 0), Dynamics(Library(0, (), False))).twin
    names = [*possible_causes(twin)]
    assert "drain changed" in names
    assert not any(each.startswith("late") for each in names)


def test_a_filter_that_diverges_voids_the_promise_and_begins_anew(monitor: Monitor) -> None:
    whole = record(2, 3)
    commands = whole.commands.astype(float).copy()
    commands[0, 0] = 1e308  # no plausible one is before it
    state, found = monitor.step(monitor.start(2), commands, whole.observed)
    assert found.outside.tolist() == [True, False]
    assert found.void[:, -1].tolist() == [True, False]
    assert all(np.isfinite(each).all() for each in vars(state.filters[0]).values())
    again = monitor.step(state, whole.commands, whole.observed)[1]
    assert np.isfinite(again.mean).all()
    assert not np.isnan(again.score[:, 100:]).any()


@pytest.mark.slow
def test_evidence_is_the_mean_of_two_models(
    twin: DynamicsTwin, monitor: Monitor, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert len(monitor.slack) == 2 * len(twin.outputs)
    assert [each.process for each in monitor.predictors] == [1.0, SLOWER[0]]
    assert "slower" in str(monitor.promises["pressure"])
    monkeypatch.setattr("retwin.monitor.models.fitting.SLOWER", (1.0,))  # the same model twice
    twice = fit_monitor(twin, record(2, 1), "1 per hour")
    monkeypatch.setattr("retwin.monitor.models.fitting._slower", lambda *_: [])
    once = fit_monitor(twin, record(2, 1), "1 per hour")
    found = [each.watch(leaking()) for each in (once, twice)]
    np.testing.assert_allclose(found[1].evidence, found[0].evidence, rtol=1e-9)
    assert [each.time for each in found[0].alarms] == [each.time for each in found[1].alarms]


@pytest.mark.slow
def test_the_slower_model_follows_as_fast_as_a_disturbance_demands(
    twin: DynamicsTwin, monitor: Monitor
) -> None:
    """A level that wanders: by the equations alone it is tens of deviations from predicted."""
    record_of = record(2, 1)
    walk = np.cumsum(np.random.default_rng(3).normal(size=record_of.observed.shape), axis=1)
    wanders = record_of.replace(observed=record_of.observed + 0.05 * walk)
    slower = [each.process for each in fit_monitor(twin, wanders).predictors[1:]]
    assert slower != [SLOWER[0]]
    assert [each.process for each in monitor.predictors[1:]] == [SLOWER[0]]


def test_slack_is_widened_where_variance_clusters() -> None:
    """Marginally Gaussian scores whose size persists, which no single alarm contradicts yet."""
    rng = np.random.default_rng(0)
    sizes = np.repeat(rng.permutation(np.linspace(0.5, 1.5, 60)), 50)
    scores = np.stack([rng.normal(size=3000), rng.normal(size=3000) * sizes])
    scores[1] /= scores[1].std()
    given = (Slack(1.1, 0.1), Slack(1.1, 0.1))
    first, second = agreeing(given, [(scores[:, :1500],) * 2, (scores[:, 1500:],) * 2])
    assert first == given[0]
    assert second.kappa > 1.15


def test_slack_is_widened_where_the_calibration_contradicts_it() -> None:
    scores = np.random.default_rng(0).normal(size=(2, 2000))
    scores[1, 1000:1040] = 2.0
    given = (Slack(1.1, 0.1), Slack(1.1, 0.1))
    first, second = agreeing(given, [(scores, scores)])
    assert first == given[0]
    assert (second.kappa, second.shift) > (1.1, 0.1)
    detector = Detector(second)
    _, evidence = detector.run(detector.start(1), scores[1:], scores[1:])
    assert evidence.max() < 2000 / 0.05
