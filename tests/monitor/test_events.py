"""Each line that decides about an alarm, an event or a promise, at its limit."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from retwin.monitor.detect import promise
from retwin.monitor.detect.detector import Detector
from retwin.monitor.detect.events import CERTAIN, Course, Rules
from retwin.monitor.detect.predictors import IMPLAUSIBLE, Predictor, agreeing, implausible
from retwin.monitor.detect.promise import SIGNIFICANCE, FalseAlarmTest, Tried, shortest
from retwin.monitor.detect.slack import Slack
from retwin.monitor.detect.validity import Validity
from retwin.monitor.versions.decision import Decision

RULES = Rules(arl=1000.0, wanted=5, lasting=20)
OVER = np.full((1, 1), np.inf)
AFTER = np.zeros((1, 2), dtype=int), np.ones(1)


def course(event: int = -1, quiet: int = 0, samples: int = 100) -> Course:
    return Course(*(np.array([each]) for each in (samples, 0, event, quiet)), *AFTER)


def test_an_alarm_is_raised_at_the_run_length_and_not_below() -> None:
    assert RULES.alarms(np.array([999.9, 1000.0, 1000.1])).tolist() == [False, True, True]


def test_an_event_needs_as_many_samples_as_show_a_shift_of_one_deviation() -> None:
    rules = Rules.of(1e6, 100)
    assert rules.wanted == 28  # 2 log(1e6) = 27.6
    for steps in (4, 5, 6):
        counted = np.ones((1, steps), dtype=bool)
        ends = RULES.ends(course(event=90), np.zeros((1, steps)), OVER, counted)[0]
        assert ends.tolist() == [place >= 4 for place in range(steps)]
    counted = np.array([[True, False, True]])
    assert RULES.ends(course(event=90, quiet=3), np.zeros((1, 3)), OVER, counted)[0].tolist() == [
        False,
        False,
        True,
    ]
    assert not RULES.ends(course(), np.zeros((1, 9)), OVER, np.ones((1, 9), dtype=bool)).any()
    unseen = RULES.ends(
        course(event=90, quiet=9), np.zeros((1, 1)), OVER, np.zeros((1, 1), dtype=bool)
    )
    assert not unseen.any()  # an event ends with a sample that is measured


def test_an_event_of_the_first_sample_is_one() -> None:
    yes, no, counted = np.array([True]), np.array([False]), np.ones((1, 1), dtype=bool)
    assert RULES.ends(course(event=0, quiet=9), np.zeros((1, 1)), OVER, counted).all()
    assert RULES.changes(course(event=0), 1).all()
    assert RULES.after(course(event=0), counted, yes, no, no, *AFTER).event[0] == 0


def test_an_event_does_not_end_while_there_is_evidence() -> None:
    counted = np.ones((1, 1), dtype=bool)
    for evidence, ended in ((5 / CERTAIN - 1, True), (5 / CERTAIN, False)):
        found = RULES.ends(course(event=90, quiet=4), np.array([[evidence]]), OVER, counted)
        assert found.tolist() == [[ended]]


def test_an_event_does_not_end_while_its_change_may_last() -> None:
    counted = np.ones((1, 1), dtype=bool)
    for over, ended in ((5 / CERTAIN - 1, False), (5 / CERTAIN, True)):
        given = np.zeros((1, 1)), np.array([[over]]), counted
        assert RULES.ends(course(event=90, quiet=4), *given).tolist() == [[ended]]


def test_evidence_that_a_change_is_over_begins_anew_with_each_alarm() -> None:
    yes, no, counted = np.array([True]), np.array([False]), np.ones((1, 3), dtype=bool)
    change, over = np.array([[1, 7]]), np.array([30.0])
    alarmed = RULES.after(course(), counted, yes, no, no, change, over)
    assert (alarmed.change.tolist(), alarmed.end_evidence.tolist()) == ([[1, 7]], [1.0])
    later = RULES.after(alarmed, counted, no, no, no, np.zeros((1, 2), dtype=int), over)
    assert (later.change.tolist(), later.end_evidence.tolist()) == ([[1, 7]], [30.0])


def test_an_event_is_a_change_after_the_stated_time() -> None:
    assert RULES.changes(course(event=90), 12)[0].tolist() == [False] * 10 + [True] * 2
    assert not RULES.changes(course(), 50).any()


def test_an_alarm_opens_an_event_and_a_further_one_belongs_to_it() -> None:
    yes, no, counted = np.array([True]), np.array([False]), np.ones((1, 3), dtype=bool)
    opened = RULES.after(course(quiet=7), counted, yes, no, no, *AFTER)
    assert (opened.event[0], opened.begun[0], opened.quiet[0]) == (102, 103, 0)
    assert opened.samples[0] == 103
    further = RULES.after(opened, counted, yes, no, no, *AFTER)
    assert (further.event[0], further.begun[0], further.quiet[0]) == (102, 106, 0)
    calm = RULES.after(opened, counted, no, no, no, *AFTER)
    assert (calm.event[0], calm.begun[0], calm.quiet[0]) == (102, 103, 3)
    ended = RULES.after(calm, counted, no, yes, no, *AFTER)
    assert (ended.event[0], ended.begun[0], ended.quiet[0]) == (-1, 103, 0)
    changed = RULES.after(calm, counted, no, no, yes, *AFTER)
    assert (changed.event[0], changed.begun[0], changed.quiet[0]) == (-1, 109, 0)


def test_a_promise_is_void_at_its_evidence_and_not_below() -> None:
    validity = Validity(Detector(Slack()), 1000.0, alpha=0.01)
    state = validity.start(3)
    highest = np.array([99.9, 100.0, 100.1])
    assert validity.void(type(state)(**{**vars(state), "highest": highest})).tolist() == [
        False,
        True,
        True,
    ]


def test_a_block_without_an_alarm_is_evidence_once_it_is_full() -> None:
    validity = Validity(Detector(Slack()), 1000.0, block=5)
    for steps, blocks in ((4, 0), (5, 1), (6, 1)):
        state, _ = validity.run(validity.start(1), np.zeros((1, steps)), np.zeros((1, steps)))
        assert state.blocks[0] == blocks
    rare = validity.start(1)
    rare = replace(rare, products=1e6 * rare.products, samples=np.array([4.0]))
    for alarm, evidence in ((True, 0.5), (False, 1.0)):  # it doubles that of a block, at most
        state, _ = validity.run(rare, np.array([[alarm]]), np.zeros((1, 1)))
        assert state.quiet[0] == pytest.approx(evidence)


@pytest.mark.parametrize(("share", "widened"), [(0.99, False), (1.0, True), (2.0, True)])
def test_a_slack_is_widened_where_evidence_reaches_its_limit(
    monkeypatch: pytest.MonkeyPatch, share: float, widened: bool
) -> None:
    limit = 10 * 1 / 0.05  # samples, of one part

    def run(detector: Detector, state: object, low: np.ndarray, high: np.ndarray) -> object:
        evidence = share * limit if detector.slack[0] == Slack() else 0.0  # type: ignore[index]
        return state, np.full(low.shape, evidence)

    monkeypatch.setattr(Detector, "run", run)
    scores = np.zeros((1, 10))
    assert (agreeing((Slack(),), [(scores, scores)]) != (Slack(),)) is widened


def test_the_samples_of_the_warm_up_are_not_used() -> None:
    used = Predictor(warm_up=3.0).used(np.array([0, 2]), 4, 1.0)
    assert used.tolist() == [[False, False, False, True], [False, True, True, True]]


@pytest.mark.parametrize("below", [True, False])
def test_a_command_is_implausible_beyond_a_hundred_ranges(below: bool) -> None:
    domain = SimpleNamespace(low=np.array([-2.0]), high=np.array([1.0]))
    twin = SimpleNamespace(process=(), domain=domain)
    far = IMPLAUSIBLE * 3.0
    limit = -2.0 - far if below else 1.0 + far
    given = np.array([limit, np.nextafter(limit, 2 * limit), 2 * limit]).reshape(1, 3, 1)
    assert implausible(twin, given)[0, :, 0].tolist() == [False, True, True]  # type: ignore[arg-type]


def test_the_rate_of_records_left_out_has_the_exact_bound() -> None:
    assert shortest(0, 3.0) == pytest.approx(3.0 / 2.9957, rel=1e-4)
    assert shortest(2, 3.0) == pytest.approx(3.0 / 6.2958, rel=1e-4)
    none = Tried({"a": 0, "b": 0}, {"a": 600, "b": 600})
    assert none.kept(1e9)
    assert "0 events in 0.333 h" in none.text(1.0)
    one = Tried({"a": 0, "b": 1}, {"a": 600, "b": 600})
    assert one.kept(1200 / 0.06)  # one or more of 0.06 expected: 5.8 %
    assert not one.kept(1200 / 0.05)  # 4.9 %
    assert one.run_length == pytest.approx(1200 / 4.7439, rel=1e-4)
    assert "1 of them in b" in one.text(1.0)


def test_a_version_is_better_above_zero_and_with_alarms_as_promised(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    passed = FalseAlarmTest(0, 100, 1000.0)
    limit = Decision(1.0, 1.0, 0.0, 0.0, 0.1, passed)
    assert not limit.better
    assert Decision(1.0, 1.0, 0.0, 1e-9, 0.1, passed).better
    monkeypatch.setattr(promise, "SIGNIFICANCE", passed.p)
    assert passed.passed  # at the limit
    monkeypatch.undo()
    broken = FalseAlarmTest(3, 100, 1000.0)
    assert broken.p < SIGNIFICANCE
    assert not Decision(1.0, 0.5, 0.5, 0.4, 0.6, broken).better
