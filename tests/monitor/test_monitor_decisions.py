"""Each comparison by which monitors, streams and versions decide, at its limit."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from leaking_tank import TANK, recorded

import retwin as rt
from retwin.cli.monitor import _rates
from retwin.errors import InputError
from retwin.monitor.detect.detector import DetectorState
from retwin.monitor.detect.events import CHANGED, FOLLOWS, Course
from retwin.monitor.detect.promise import FalseAlarmTest
from retwin.monitor.detect.scores import fit_scores
from retwin.monitor.detect.slack import Slack
from retwin.monitor.live.machine import AssetStatus, Counts
from retwin.monitor.live.stream_machine import BEHIND, TOLERATED, WINDOW, StreamMachine, Work
from retwin.monitor.live.trajectory_machine import Diagnosed, TrajectoryMachine
from retwin.monitor.models import cause, visibility
from retwin.monitor.models.cause import (
    MIN_WINDOW,
    PROBABLE,
    Cause,
    CauseSearch,
    cause_data,
    cause_text,
    is_due,
)
from retwin.monitor.models.fitting import fit_monitor
from retwin.monitor.models.monitor import BEYOND, Monitor
from retwin.monitor.models.state import SHARE, Alarm, Ending, Part, Visible
from retwin.monitor.models.trajectory import monitor as trajectories
from retwin.monitor.models.trajectory.evidence import Compared
from retwin.monitor.models.trajectory.monitor import COMPARABLE, SHOWN, TrajectoryMonitor
from retwin.monitor.server import journal, views
from retwin.monitor.store.samples import Asset, Samples, Trajectory
from retwin.monitor.versions import comparison
from retwin.monitor.versions.decision import MIN_SAMPLES, decide
from retwin.monitor.versions.recalibration import _events, _parts
from retwin.scores.bootstrap import MIN_RECORDS, bootstrap_means
from retwin.twins import ParameterShift
from retwin.update import Dynamics, Library, fit_dynamics


@pytest.fixture(scope="module")
def monitor() -> Monitor:
    twin = fit_dynamics(TANK, recorded(0), Dynamics(Library(0, (), False))).twin
    return fit_monitor(twin, recorded(1), "1 per day")


def course(event: int = -1, samples: int = 50, quiet: int = 0) -> Course:
    """One of which no evidence says that its change lasts."""
    counts = (np.array([each]) for each in (samples, 0, event, quiet))
    return Course(*counts, np.zeros((1, 2), dtype=int), np.array([1e250]))


def part_of(monitor: Monitor, state: Any, steps: int = 1, **changes: bool) -> Part:
    """What is found in so many samples that are measured, but for what the test decides."""
    made = monitor._part(state, np.full((1, steps, 1), 1.0), np.full((1, steps, 1), 0.7))
    flags = ("alarm", "ended", "changed", "outside")
    given = {name: np.full((1, steps), changes.get(name, False)) for name in flags}
    return replace(made, **given)


# The monitor of samples: what its flags decide.


@pytest.mark.parametrize(("event", "learns"), [(-1, True), (0, False), (7, False)])
def test_the_scale_of_noise_is_learned_outside_of_events_alone(
    monitor: Monitor, event: int, learns: bool
) -> None:
    state = replace(monitor.start(1), course=course(event))
    after = part_of(monitor, state).after
    assert (after.scale != state.scale).any() == learns


@pytest.mark.parametrize(
    ("evidence", "age", "flags"),
    [
        (0.0, 50, (False, True, False)),
        (0.0, 10**9, (False, True, False)),  # it ends, so it is no change
        (1e9, 50, (True, False, False)),  # evidence that is little beside so many quiet samples
        (1e9, 10**9, (True, False, True)),
    ],
)
def test_an_alarm_goes_before_the_end_of_an_event_and_that_before_a_change(
    monitor: Monitor, evidence: float, age: int, flags: tuple[bool, bool, bool]
) -> None:
    start = monitor.start(1)
    full = np.full_like(start.detector.evidence, evidence)
    detector = DetectorState(full, start.detector.previous)
    state = replace(start, detector=detector, course=course(0, age, 10**12))
    made = monitor._part(state, np.full((1, 1, 1), 1.0), np.full((1, 1, 1), 0.5))
    assert (made.alarm[0, 0], made.ended[0, 0], made.changed[0, 0]) == flags


@pytest.mark.parametrize("event", [-1, 0, 7])
@pytest.mark.parametrize("void", [False, True])
@pytest.mark.parametrize("outside", [False, True])
def test_an_alarm_opens_an_event_and_is_promised_in_the_range_of_a_valid_promise(
    monitor: Monitor, event: int, void: bool, outside: bool
) -> None:
    state = replace(monitor.start(1), course=course(event), void=np.array([void]))
    alarms, endings = list[Alarm](), list[Ending]()
    part = part_of(monitor, state, alarm=True, outside=outside)
    part = replace(part, after=replace(part.after, void=np.array([void])))
    after, shown = monitor._after(state, part, ["a"], alarms, endings)
    (alarm,), lasts = alarms, shown[-2]
    assert (alarm.opens, alarm.event) == (event < 0, 50 if event < 0 else event)
    assert alarm.promised == (not void and not outside)
    assert lasts.all()
    assert after.course.event[0] == alarm.event
    # The promise is about alarms that open an event, within the range of the calibration.
    assert (after.validity.runs[0] != state.validity.runs[0]) == (event < 0 and not outside)
    assert not after.detector.evidence.any()


@pytest.mark.parametrize("event", [-1, 0, 7])
@pytest.mark.parametrize("outside", [False, True])
def test_samples_test_the_promise_outside_of_events_and_in_range(
    monitor: Monitor, event: int, outside: bool
) -> None:
    state = replace(monitor.start(1), course=course(event))
    part = part_of(monitor, state, outside=outside)
    part = replace(part, low=np.zeros_like(part.low), high=np.zeros_like(part.high))
    after, shown = monitor._after(state, part, ["a"], [], [])
    assert (after.validity.samples > 0).all() == (event < 0 and not outside)
    assert shown[-2].all() == (event >= 0)


@pytest.mark.parametrize(("share", "void"), [(0.999, False), (1.0, True), (2.0, True)])
def test_the_promise_is_void_where_the_evidence_against_it_reaches_its_limit(
    monitor: Monitor, share: float, void: bool
) -> None:
    start = monitor.start(1)
    both = np.full_like(start.validity.quiet, share / monitor.alpha)
    state = replace(start, validity=replace(start.validity, quiet=both, runs=both))
    part = part_of(monitor, state, outside=True)  # so that the sample adds nothing
    after, shown = monitor._after(state, part, ["a"], [], [])
    assert after.void[0] == shown[-1].all() == void


@pytest.mark.parametrize("changed", [False, True])
def test_after_a_change_the_detector_begins_anew_and_the_ending_says_so(
    monitor: Monitor, changed: bool
) -> None:
    start, endings = monitor.start(1), list[Ending]()
    state = replace(start, course=course(7), scale=np.ones_like(start.scale))
    part = part_of(monitor, state, ended=not changed, changed=changed)
    after, _ = monitor._after(state, part, ["a"], [], endings)
    assert [each.how for each in endings] == [CHANGED if changed else FOLLOWS]
    assert not after.detector.evidence.any()
    assert after.scale.any() != changed  # the noise of the machine of now is learned anew


def test_commands_at_the_ends_of_their_range_are_within_it(monitor: Monitor) -> None:
    low, high = (each[len(monitor.twin.process) :] for each in monitor.twin.bounds)
    margin = BEYOND * (monitor.noise.high[0] - monitor.noise.low[0])
    least = float(min(low[0], monitor.noise.low[0] - margin))
    largest = float(max(high[0], monitor.noise.high[0] + margin))
    given = [least, largest, np.nextafter(least, -np.inf), np.nextafter(largest, np.inf)]
    found = monitor._outside(np.array(given).reshape(1, 4, 1))
    assert found.tolist() == [[False, False, True, True]]


# A stream: what is done with each sample.

SECOND = 10**9


class Stream:
    """A stream of a monitor that is not asked: one command, one output, at 1 Hz."""

    def __init__(self, **settings: Any) -> None:
        channels = {"inputs": rt.Channels(("pump",), ("V",))}
        channels["outputs"] = rt.Channels(("level",), ("m",))
        twin = SimpleNamespace(rate=1.0, **channels)
        layout = SimpleNamespace(start=np.zeros(1), digest=np.zeros(0))
        asset = Asset("a", 2, {}, 1)
        wait = settings.get("wait")
        self.machine = StreamMachine(asset, SimpleNamespace(twin=twin), layout, wait)  # type: ignore[arg-type]

    def give(self, *times: float, limit: float = 1e6, known: tuple[float, ...] = ()) -> str:
        """What is done with samples at these times in s, as names of counts."""
        counts, told = Counts(), []
        for each in times:
            before = Counter(vars(counts))
            at = np.array([round(each * SECOND)])
            self.machine.accept(
                Samples("a", at, np.ones((1, 2))),
                round(limit * SECOND),
                {round(known_ * SECOND) for known_ in known},
                counts,
            )
            told += (Counter(vars(counts)) - before).elements()
        return " ".join(told)

    @property
    def logged(self) -> list[str]:
        return [data.get("what", kind) for kind, data in self.machine.entries]


@pytest.mark.parametrize(
    ("times", "last", "what"),
    [
        ([100], 1000, "used"),  # at the limit
        ([100], 1000.001, "ahead"),
        ([100], 100, "repeated"),
        ([100, 101], 101.2, "extra"),  # newer than all, at a place that has a sample
        ([100, 101, 102], 101.2, "late"),
        ([100, 101], 103, "used"),  # place 2 is waited for,
        ([100, 101, 103], 102, "used"),
        ([100, 101, 103, 104], 102, "late"),  # until two places later
        ([100, 101, 103], 103.2, "extra"),  # at the place of one that waits
    ],
)
def test_what_is_done_with_a_sample(times: list[float], last: float, what: str) -> None:
    stream = Stream()
    stream.give(*times)
    assert stream.give(last, limit=1000.0) == what


@pytest.mark.parametrize(("wait", "last", "done"), [(3.0, 104, 1), (3.0, 105, 2), (0.0, 105, 5)])
def test_a_place_is_waited_for_as_long_as_is_set(wait: float, last: float, done: int) -> None:
    stream = Stream(wait=wait)
    stream.give(100, 101, last)
    assert stream.machine._done == done


def test_stored_samples_are_held_from_the_first_that_was_not_stepped() -> None:
    stream = Stream()
    stream.give(100, 101)
    stream.machine.hold(np.array([101, 102, 104]) * SECOND, np.ones((3, 2)))
    assert list(stream.machine._pending) == [2, 4]


@pytest.mark.parametrize(("pause", "anew"), [(3600, False), (3601, True)])
def test_a_stream_begins_anew_after_the_longest_gap(pause: int, anew: bool) -> None:
    stream = Stream()
    stream.give(100, 100 + pause)
    assert stream.logged.count("gap") == anew


def test_a_first_sample_is_late_where_a_newer_or_the_same_one_is_stored() -> None:
    for newest, what in ((99, "used"), (100, "late"), (101, "late")):
        stream = Stream()
        stream.machine.newest = newest * SECOND
        assert stream.give(100) == what
    stream = Stream()
    stream.give(100, 101)
    stream.machine.committed()
    assert stream.give(101) == "late"  # the newest one again, which the store was not asked for


@pytest.mark.parametrize(("late", "logged"), [(BEHIND - 1, 0), (BEHIND, 1), (BEHIND + 1, 1)])
def test_a_clock_is_set_back_after_late_samples_in_a_row(late: int, logged: int) -> None:
    times = [100.1 - each / 1000 for each in range(late)]
    for between in ([], [1001.0]):
        stream = Stream()
        stream.give(100, *range(101, 105))
        stream.machine.newest = 1000 * SECOND
        stream.give(*times[: BEHIND // 2], *([105.0] if between else []), *times[BEHIND // 2 :])
        assert stream.logged.count("clock") == (0 if between else logged)


@pytest.mark.parametrize(("wrong", "told"), [(TOLERATED, False), (TOLERATED + 1, True)])
@pytest.mark.parametrize("missing", [True, False])
def test_a_rate_is_another_one_beyond_what_is_tolerated(
    wrong: int, told: bool, missing: bool
) -> None:
    stream = Stream(wait=0.0)
    places = list(range(100, 100 + WINDOW))
    times = places[:1] + places[1 + wrong :] if missing else places
    stream.give(*times[:-1])
    stream.give(*[times[-2] + 0.1 + each / 1000 for each in range(0 if missing else wrong)])
    assert not stream.logged  # the window has one place less than it needs
    stream.give(times[-1])
    assert stream.logged == ["rate"] * told


@pytest.mark.parametrize(
    ("event", "promised", "ends", "log", "counted"),
    [
        (1, True, False, ["alarm"], 1),
        (0, True, False, ["alarm"], 0),
        (1, False, False, ["remark"], 0),
        (0, False, False, ["remark"], 0),
        (1, True, True, ["alarm", "end"], 1),
    ],
)
def test_what_a_stream_logs_and_counts(
    event: int, promised: bool, ends: bool, log: list[str], counted: int
) -> None:
    machine = Stream().machine
    work = Work(0, 0, np.ones((2, 2)), True)
    both = np.zeros((1, 2, 1))
    found = {"mean": both, "deviation": both, "evidence": np.zeros((1, 2))}
    found |= {"event": np.array([[True, True]]), "outside": np.array([False])}
    alarm = Alarm("a", 1, 1.0, "level", "higher than predicted", 1e6, event, promised)
    endings = [Ending("a", 1, 1, FOLLOWS)] if ends else []

    def step(alarms: list[Alarm], endings: list[Ending], *void: bool) -> None:
        watched = SimpleNamespace(**found, alarms=alarms, endings=endings, void=np.array([void]))
        machine.stepped(work, np.zeros(1), watched, 0)  # type: ignore[arg-type]

    step([alarm], endings, False, False)
    assert ([kind for kind, _ in machine.entries], machine.alarms) == (log, counted)
    assert machine.event is not ends
    for void in ((False, True), (True, True)):  # is logged once
        step([], [], *void)
    assert [kind for kind, _ in machine.entries].count("void") == 1


@pytest.mark.parametrize(
    ("version", "digest", "state", "again"),
    [(1, 0, 1, True), (2, 0, 1, False), (1, 1, 1, False), (1, 0, 2, False)],
)
def test_a_stored_stream_is_of_the_same_version_and_monitor(
    version: int, digest: int, state: int, again: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Stream().machine
    arrays = {
        "stream": np.array([0, 5, 5 * SECOND, version, 0, 0, 0]),
        "status": np.zeros(4),
        "digest": np.ones(digest),
        "monitor": np.zeros(state),
    }
    before = SimpleNamespace(void=np.array([False]), course=SimpleNamespace(event=np.array([0])))
    machine.layout.state = lambda _: before  # type: ignore[method-assign]
    assert machine.restore(arrays) is again
    assert machine.event is again  # one of the first sample


# Trajectories.


@pytest.mark.parametrize(
    ("begin", "limit", "known", "what"),
    [
        (11, 11, set(), "used"),
        (12, 11, set(), "ahead"),
        (11, 20, {11}, "repeated"),
        (10, 20, set(), "late"),
        (9, 20, set(), "late"),
    ],
)
def test_what_is_done_with_a_trajectory(begin: int, limit: int, known: set[int], what: str) -> None:
    twin = SimpleNamespace(inputs=("pump",))
    machine = SimpleNamespace(newest=10, monitor=SimpleNamespace(twin=twin))
    given = Trajectory("a", begin, np.ones((2, 2)))
    assert TrajectoryMachine.placed(machine, given, limit, known) == what  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("before", "now", "logged"),
    [(False, False, []), (False, True, ["void"]), (True, True, [])],
)
def test_a_promise_about_trajectories_that_becomes_void_is_logged_once(
    before: bool, now: bool, logged: list[str]
) -> None:
    state = SimpleNamespace(arrays=dict)
    machine = TrajectoryMachine(Asset("a", 2, {}, 1), SimpleNamespace(start=lambda: state))  # type: ignore[arg-type]
    machine.void = before
    no = np.array([False])
    flags = dict.fromkeys(("unmeasured", "unranked", "implausible", "outside"), no)
    numbers = {"evidence": np.zeros(1), "score": np.zeros(1)}
    watched = SimpleNamespace(alarms=[], void=np.array([now]), **numbers, **flags)
    samples = Samples("a", np.arange(2), np.ones((2, 2)))
    found = Diagnosed(samples, state, watched)  # type: ignore[arg-type]
    assert machine.take(found) == 0
    assert [kind for kind, _ in machine.entries] == logged


def of_trajectories(**changes: Any) -> TrajectoryMonitor:
    """A monitor of trajectories whose diagnoser is not asked."""
    errors = np.random.default_rng(0).normal(size=(1, 40))
    diagnoser = SimpleNamespace(faults={"Healthy": None, "leak": None, "bias": None})
    made = TrajectoryMonitor(
        diagnoser,  # type: ignore[arg-type]
        fit_scores(errors),
        Slack(),
        kappa=1.0,
        arl=100.0,
        duration=6.0,
        measured=np.array([[8.0], [8.0]]),
    )
    return replace(made, **changes)


def evidence_of(ratio: list[float], **changes: Any) -> Compared:
    """What a trajectory is evidence of, whose faults have these likelihood ratios."""
    made = Compared(
        np.log(np.array([ratio])),
        np.zeros(1),
        np.full((1, 1), 8),
        np.full((1, 0, 1), np.nan),
        np.zeros(1, dtype=bool),
        np.zeros(1, dtype=bool),
    )
    return replace(made, **changes)


def watched(monitor: TrajectoryMonitor, found: Compared, patch: pytest.MonkeyPatch) -> Any:
    names = ["leak", "bias"]
    patch.setattr(trajectories, "alternatives", lambda _: names)
    patch.setattr(trajectories, "compared", lambda *_: found)
    patch.setattr(trajectories, "is_bias", lambda _: False)
    return monitor.watch(Named())  # type: ignore[arg-type]


class Named:
    """A trajectory of which the name alone is asked."""

    ids = ("1",)

    def __len__(self) -> int:
        return 1


@pytest.mark.parametrize(("share", "alarms"), [(0.99, 0), (1.0, 1), (2.0, 1)])
def test_trajectories_alarm_at_the_run_length(
    share: float, alarms: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = evidence_of([50.0, 50.0])
    arl = float(watched(of_trajectories(), found, monkeypatch)[1].evidence[0])
    state, seen = watched(of_trajectories(arl=arl / share), found, monkeypatch)
    assert len(seen.alarms) == alarms
    # After an alarm everything begins anew, and the promise is tested by it.
    assert (state.evidence.any(), state.detector.evidence.any()) == (not alarms, not alarms)
    assert state.validity.length[0] == (0 if alarms else 1)


def test_an_alarm_states_causes_from_their_smallest_share_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monitor = of_trajectories()
    shares = {"leak": 1 - 3 * SHOWN, "bias": SHOWN, "other": np.nextafter(SHOWN, 0)}
    monkeypatch.setattr(TrajectoryMonitor, "_shares", lambda *_: shares)
    (alarm,) = watched(monitor, evidence_of([1e6, 1.0]), monkeypatch)[1].alarms
    assert list(alarm.shares) == ["leak", "bias"]


@pytest.mark.parametrize(
    ("measured", "unranked"),
    [(0, False), (5, True), (8 / COMPARABLE, False), (8 * COMPARABLE, False), (11, True)],
)
def test_a_trajectory_is_ranked_among_those_measured_alike(measured: float, unranked: bool) -> None:
    found = evidence_of([1.0, 1.0], measured=np.array([[measured]]))
    assert of_trajectories()._unranked(found).tolist() == [unranked]


@pytest.mark.parametrize(
    ("measured", "implausible", "used"), [(8, False, True), (0, False, False), (8, True, False)]
)
def test_evidence_is_that_of_plausible_measured_trajectories(
    measured: int, implausible: bool, used: bool
) -> None:
    found = evidence_of([2.0, 1.0], measured=np.array([[measured]]))
    found = replace(found, implausible=np.array([implausible]))
    ((own, _),) = of_trajectories()._factors(found)
    assert (own is not None) is used


def test_a_promise_names_trajectories_that_were_not_used() -> None:
    for used, named in ((9, True), (10, False)):
        assert ("were used" in of_trajectories(used=used, given=10).promise) is named


# The cause of an alarm.


def test_there_is_more_to_a_cause_where_the_unknown_is_probable() -> None:
    for unknown, more in ((PROBABLE, False), (np.nextafter(PROBABLE, 1), True)):
        text = cause_text(cause_data("leak", 0.9, unknown, {}), "noon")
        assert ("more than that" in text) is ("among the known causes" in text) is more


LEAK = ParameterShift("drain", size=(0.1, 1.0), onset=(0.0, 5.0))
PUMP = replace(LEAK, parameter="other")


def test_a_size_at_an_end_of_its_range_is_told() -> None:
    margin = cause.AT_LIMIT * 0.9
    for low, high, there in ((0.5, 1 - 0.9 * margin, True), (0.5, 1 - 1.1 * margin, False)):
        assert cause._at_limit(LEAK, (0.7, low, high)) is there
    assert cause._at_limit(LEAK, (0.2, 0.1 + 0.9 * margin, 0.3))
    none = replace(LEAK, size=(0.0, 1.0))  # no change is the end of the fault, and not of its range
    assert not cause._at_limit(none, (0.1, 0.0, 0.2))
    data = cause_data("leak", 0.9, 0.1, {}, (0.9, 0.8, 1.0), "m2") | {"limit": True}
    assert (
        "(0.8 to 1) at the end of its range, so that it may be something else, prob"
        in cause_text(data, "")
    )


def found_cause(
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    probability: float,
    unknown: float,
    *,
    samples: tuple[int, ...] = (200, 300),
    earlier: int | None = None,
    better: bool = False,
    current: str = "leak",
    unexplained: float = 0.0,
    onset: float = 0.0,
    found: dict | None = None,
) -> tuple[bool, list[int]]:
    """Whether a further alarm is of the same cause, and the windows that it was found from."""
    classes = ["Healthy", "leak", "pump"]
    steps: list[int] = []

    class Diagnoser:
        def __init__(self, *_: object) -> None:
            """Nothing is asked of the twin."""

        def diagnose(self, window: rt.Trajectories, **_: object) -> object:
            steps.append(window.steps)
            rest = (1 - probability) / 2
            none, since = (
                SimpleNamespace(**dict.fromkeys(("value", "low", "high"), np.full((1, 3), each)))
                for each in (0.0, onset)
            )
            given = np.array([[probability if each == name else rest for each in classes]])
            own = {"probabilities": given, "unknown": [unknown], "classes": classes}
            return SimpleNamespace(**own, size=none, onset=since)

    monkeypatch.setattr(cause, "StateInversionDiagnoser", Diagnoser)
    monkeypatch.setattr(cause, "moved", lambda twin, _: twin)
    monkeypatch.setattr(cause, "size_unit", lambda *_: "")
    monkeypatch.setattr(CauseSearch, "_better", lambda *_: better)
    alarms = [Alarm("0", each, float(each), "level", "", 1e6, samples[0]) for each in samples]
    if earlier is not None:
        alarms.insert(0, Alarm("0", earlier, float(earlier), "level", "", 1e6, earlier))
    faults = {"Healthy": None, "leak": LEAK, "pump": PUMP}
    record = recorded(0)
    search = CauseSearch(None, record, faults)  # type: ignore[arg-type]
    made = search.find(alarms, (current, unexplained))
    if found is not None:
        found |= vars(made)
    return made.same, steps


@pytest.mark.parametrize("samples", [0, 1, 2])
def test_an_onset_at_the_begin_of_what_was_looked_at_may_be_earlier(
    samples: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: dict = {}
    period = 1 / recorded(0).rate
    found_cause(monkeypatch, "leak", 0.9, 0.0, samples=(200,), onset=samples * period, found=found)
    assert found["earlier"] is (samples <= 1)
    assert ("from noon or earlier;" in cause_text(found, "noon")) is (samples <= 1)


@pytest.mark.parametrize(
    ("name", "probability", "unknown", "better", "same"),
    [
        ("leak", 0.9, 0.0, True, True),  # the one that the event has
        ("Healthy", 0.9, 0.0, True, True),  # no other one
        ("pump", 0.9, 0.0, False, True),  # not more evidence than the first one alone
        ("pump", 0.9, 0.0, True, False),
        ("pump", 0.5, 0.0, True, True),  # not probable
        ("pump", 0.51, 0.0, True, False),
        ("pump", 0.9, 0.5, True, True),  # not one of the classes
    ],
)
def test_a_further_alarm_has_a_cause_of_its_own_where_that_is_probable_and_better(
    name: str,
    probability: float,
    unknown: float,
    better: bool,
    same: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    windows = [201] if probability * (1 - unknown) > PROBABLE else [201, 100]
    found = found_cause(monkeypatch, name, probability, unknown, better=better)
    assert found == (same, windows)
    older = found_cause(monkeypatch, name, probability, unknown, samples=(200, 301), better=better)
    assert older == (same, [101])


def test_a_cause_of_the_newest_samples_explains_no_more_than_the_one_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for last, unknown in ((300, 0.1), (301, 0.8)):
        found = {}
        given = ("pump", 0.9, 0.1)
        samples = (200, last)
        found_cause(monkeypatch, *given, samples=samples, better=True, unexplained=0.8, found=found)
        assert (found["same"], found["unknown"]) == (False, unknown)


def test_the_first_alarm_of_an_event_has_its_own_cause(monkeypatch: pytest.MonkeyPatch) -> None:
    assert found_cause(monkeypatch, "Healthy", 0.9, 0.0, samples=(200,)) == (False, [101])


@pytest.mark.parametrize(
    ("after", "steps"),
    [(1, MIN_WINDOW + 1), (MIN_WINDOW + 1, MIN_WINDOW + 1), (20, 20), (101, 101)],
)
def test_a_window_begins_after_the_event_before_it(
    after: int, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = found_cause(monkeypatch, "pump", 0.9, 0.0, samples=(200,), earlier=200 - after)
    assert found == (False, [steps])


def test_a_window_begins_after_the_alarm_that_was_explained(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = found_cause(monkeypatch, "pump", 0.9, 0.0, samples=(200, 280, 320), better=True)
    assert found == (False, [40])


@pytest.mark.parametrize(
    ("inferred", "sample", "due"),
    [
        ([], 200, True),
        ([200], 200 + MIN_WINDOW, False),
        ([200], 200 + MIN_WINDOW + 1, True),
        ([200, 240], 250, False),
        ([200, 240], 251, True),
        ([200, 240, 260], 275, False),
        ([200, 240, 260], 276, True),
    ],
)
def test_a_cause_is_inferred_again_when_its_event_is_a_quarter_older(
    inferred: list[int], sample: int, due: bool
) -> None:
    assert is_due(inferred, sample) is due


def test_alarms_at_which_nothing_is_inferred_have_the_cause_of_their_event(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An event of any length has few inferences; the next one begins after its last alarm."""
    asked: list[list[int]] = []

    def found(_search: object, alarms: list[Alarm], *_: object) -> Cause:
        asked.append([each.sample for each in alarms])
        return Cause(alarms[-1], f"{len(asked)}", 1.0, 0.0, *[(0.0,) * 3] * 2, {}, len(asked) == 2)

    monkeypatch.setattr(CauseSearch, "find", found)
    record = recorded(0)
    (name,) = record.ids.tolist()
    alarms = [Alarm(name, each, float(each), "level", "", 1e6, 200) for each in range(200, 380, 5)]
    alarms.append(Alarm(name, 395, 395.0, "level", "", 1e6, 395))
    causes = cause.find_causes(None, record, alarms, {})  # type: ignore[arg-type]
    inferred = [200, 215, 230, 245, 260, 280, 305, 335, 370]
    assert asked == [*(inferred[: i + 1] for i in range(9)), [375, 395]]
    assert [each.alarm for each in causes] == alarms
    assert [each.alarm.sample for each in causes if not each.same] == [200, *inferred[2:], 395]
    assert [each.name for each in causes[:7]] == ["1", "1", "1", "2", "2", "2", "3"]


@pytest.mark.parametrize(
    ("until", "again", "instead", "begin", "better"),
    [
        (0.0, 12.0, None, 300, False),  # not more than the first fault alone, but for the penalty
        (0.0, 12.1, None, 300, True),
        (0.1, 12.0, None, 300, True),
        (0.0, 100.0, None, 100 + MIN_WINDOW - 1, False),  # too little before to tell
        (0.0, 100.0, None, 100 + MIN_WINDOW, True),
        (0.0, -1e6, 10.0, 300, False),  # not more than the first fault
        (0.0, -1e6, 10.1, 300, True),
        (0.0, -1e6, -1e6, 100 + MIN_WINDOW - 1, True),  # all there is is the window
    ],
)
@pytest.mark.parametrize("alone", ["lasts", "ended", "states unknown again"])
def test_another_fault_has_more_evidence_than_the_first_alone(
    alone: str,
    until: float,
    again: float,
    instead: float | None,
    begin: int,
    better: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = {"until": until, "lasts": -1e6, "ended": -1e6, "as it was": 0.0}
    known |= {"states unknown again": -1e6, "again": again, "instead": instead}
    known[alone] = 10.0 if alone == "lasts" else 10.0 - until
    values = iter(known.values())

    class Model:
        def integral(self, _: object) -> object:
            return SimpleNamespace(best=(0.5, 3.0, None))

        def tolerated(self, _fault: object, _found: object) -> object:
            return SimpleNamespace(evidence=next(values))

    monkeypatch.setattr(cause, "FaultEvidence", SimpleNamespace(of=lambda *_, **__: Model()))
    monkeypatch.setattr(cause, "moved", lambda twin, _: twin)
    window = (100, begin, Alarm("0", 310, 310.0, "level", "", 1e6, 200))
    search = CauseSearch(None, recorded(0), {})  # type: ignore[arg-type]
    assert search._better(window, (LEAK, PUMP), 2.0, instead is not None) is better


# What a monitor sees.


@pytest.mark.parametrize(("share", "seen"), [(np.nextafter(SHARE, 0), False), (SHARE, True)])
def test_a_fault_is_seen_at_the_stated_share(
    share: float, seen: bool, monitor: Monitor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(visibility, "_share", lambda *_: share)
    (found,) = visibility.visible_sizes(monitor, recorded(1), {"leak": LEAK})
    assert (found.size is not None) is seen
    assert ("not seen" in str(Visible("leak", None, None, share, 1.0))) is not seen
    assert found.hidden is not seen


@pytest.mark.parametrize(("size", "hidden"), [(0.049, False), (0.05, True), (None, False)])
def test_a_fault_as_large_as_what_it_changes_is_no_better_than_hidden(
    size: float | None, hidden: bool
) -> None:
    found = Visible("leak", size, 0.1, 1.0, 5.0, "1/s", 0.05)
    assert found.hidden is hidden
    assert ("98% of the value" in str(found)) is (size == 0.049)
    assert "0.1 1/s, 0.042% of the value" in str(replace(found, size=0.1, value=240.0))


def test_a_replay_without_events_names_what_is_seen_only_where_it_is_large(
    monitor: Monitor,
) -> None:
    small = Visible("level: sensor offset", 0.49, 1.0, 1.0, 5.0, "m", 1.0, "range")
    faults = {"leak changed": 0.5, "pump: another effect": 1.53}
    some = [replace(small, fault=name, size=size) for name, size in faults.items()]
    unseen = Visible("leak drifting", None, 1.0, 0.1, 5.0)
    made = replace(monitor, visible=(small, *some, unseen))
    data = recorded(2)
    text = _rates(made, [(data, SimpleNamespace(events=[]))])  # type: ignore[list-item]
    assert "Not seen: leak drifting." in text
    assert text.endswith(
        "Seen only from 50% of the parameter, command or output range on: leak changed (50%), "
        "pump: another effect (153%)."
    )


# The page.


@pytest.mark.parametrize(("idle", "state"), [(30.0, "ok"), (30.1, "stopped"), (60.0, "stopped")])
def test_a_machine_has_stopped_after_a_time_without_samples(
    idle: float, state: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(views.time, "monotonic", lambda: 1000.0 + idle)
    twin = SimpleNamespace(twin=SimpleNamespace(rate=1.0), duration=1.0)
    own = SimpleNamespace(
        _newest={"a": (5, 1000.0)}, _live=SimpleNamespace(monitor=lambda _: twin), journal=None
    )
    status = AssetStatus("a", "tank", 1, 5, 0.1, 0, None, False, False, False, "", {})
    found = views.Views._status(own, status, {}, {})  # type: ignore[arg-type]
    assert (found["state"], found["idle"]) == (state, pytest.approx(idle))


@pytest.mark.parametrize(
    ("name", "onset", "refines"),
    [
        ("leak", 9 * SECOND, True),
        ("leak", 10 * SECOND, True),
        ("leak", 11 * SECOND, False),  # it is inferred from what came last
        ("leak", None, False),
        ("pump", 9 * SECOND, False),
    ],
)
def test_the_cause_that_opened_an_event_becomes_more_certain(
    name: str, onset: int | None, refines: bool
) -> None:
    found = {"name": name, "onset": [onset] * 3}
    assert journal._refines(found, {"time": 10.0, "cause": {"name": "leak"}}) is refines
    assert not journal._refines(found, {"time": 10.0, "cause": None})


# Versions.


def test_a_comparison_needs_as_many_samples_as_blocks_have() -> None:
    passed, rng = FalseAlarmTest(0, 1000, 1e4), np.random.default_rng(0)
    for records, samples, enough in (
        (1, MIN_SAMPLES, True),
        (1, MIN_SAMPLES - 1, False),
        (MIN_RECORDS - 1, 20, False),
        (MIN_RECORDS, 20, True),
        (MIN_RECORDS, 1, True),
    ):
        old, new = rng.random((2, records, samples))
        if enough:
            made = decide(old, new, passed)
        else:
            with pytest.raises(InputError, match="at least"):
                decide(old, new, passed)
    draws = bootstrap_means((old - new)[:, :, None], draws=4000, seed=0)
    assert made.high - made.low == pytest.approx(2 * 1.96 * np.std(draws))


class Log:
    """A store that has a log alone, of events of a machine."""

    def __init__(self, *entries: tuple[str, int, int, str]) -> None:
        about = {"asset": "a", "output": "level", "change": "higher than predicted"}
        self._entries = [
            SimpleNamespace(
                kind=kind, sequence=i, data={**about, "event": event, "time": at, "how": how}
            )
            for i, (kind, event, at, how) in enumerate(entries)
        ]

    def log(self, kind: str | None = None) -> list[Any]:
        return [each for each in self._entries if kind in (None, each.kind)]


@pytest.mark.parametrize(
    ("entries", "begun"),
    [
        ([], None),
        ([("alarm", 5, 5, ""), ("end", 5, 9, FOLLOWS)], None),
        ([("alarm", 5, 5, "")], 5),
        ([("remark", 5, 5, "")], 5),
        ([("alarm", 5, 5, ""), ("end", 5, 9, CHANGED)], 5),
    ],
)
def test_a_machine_that_has_changed_needs_a_word(entries: list[Any], begun: int | None) -> None:
    if begun is None:
        _events(Log(*entries), "a", "")  # type: ignore[arg-type]
    else:
        with pytest.raises(InputError, match="new_normal"):
            _events(Log(*entries), "a", "")  # type: ignore[arg-type]
        later = ("alarm", 20, 20, ""), ("end", 20, 25, FOLLOWS)
        found = _events(Log(*entries, *later), "a", "Ada")  # type: ignore[arg-type]
        assert found == (begun, [(20, 25)])


def test_quiet_parts_are_those_before_and_after_events() -> None:
    times = np.arange(4 * MIN_SAMPLES)
    (whole,) = _parts(times, times[:, None], [], 3)
    assert len(whole) == len(times)
    first = MIN_SAMPLES + 3  # the event begins three samples after the last quiet one
    for start, end, expected in (
        (first, first + 10, [(0, MIN_SAMPLES - 1), (first + 11, len(times) - 1)]),
        (first - 1, first + 10, [(first + 11, len(times) - 1)]),
        (first - 1, len(times) - MIN_SAMPLES - 1, [(len(times) - MIN_SAMPLES, len(times) - 1)]),
        (first - 1, len(times) - MIN_SAMPLES, []),
    ):
        found = [
            (int(each[0, 0]), int(each[-1, 0]))
            for each in _parts(times, times[:, None], [(start, end)], 3)
        ]
        assert found == expected


@pytest.mark.parametrize(
    ("samples", "events", "compared"),
    [(2 * MIN_SAMPLES - 1, 0, False), (2 * MIN_SAMPLES, 0, True), (2 * MIN_SAMPLES, 1, False)],
)
def test_versions_are_compared_on_long_parts_without_events_of_the_active_one(
    samples: int, events: int, compared: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def version(own: int) -> Any:
        def step(_: object, __: object, measured: np.ndarray) -> tuple[None, object]:
            zeros = np.zeros_like(measured)
            return None, SimpleNamespace(
                score=zeros, mean=zeros, deviation=zeros + 1, events=[None] * own
            )

        twin = SimpleNamespace(inputs=("pump",))
        return SimpleNamespace(twin=twin, arl=1e4, start=lambda _: None, step=step)

    part = np.random.default_rng(0).normal(size=(samples, 2))
    monkeypatch.setattr(comparison, "_healthy_samples", lambda *_: [part])
    if compared:
        _, (test,) = comparison._of_samples(None, "tank", [version(0), version(2)])  # type: ignore[arg-type]
        assert test.alarms == 2
    else:
        with pytest.raises(InputError, match="without an alarm"):
            comparison._of_samples(None, "tank", [version(events), version(0)])  # type: ignore[arg-type]
