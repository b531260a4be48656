"""The live monitor: what happens to samples, alarms, and what survives a restart."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from leaking_tank import TANK, recorded

import retwin as rt
from retwin.errors import InputError
from retwin.monitor import (
    Explanations,
    FalseAlarmTest,
    Gate,
    Live,
    Monitor,
    Registry,
    Samples,
    Store,
    compare,
    decide,
    export_log,
    fit_monitor,
    verify,
)
from retwin.monitor.live.explanations import _Turns
from retwin.monitor.live.machine import Counts
from retwin.monitor.live.stream_machine import PLACES, StreamMachine
from retwin.monitor.models.cause import is_due
from retwin.monitor.models.state import Layout
from retwin.monitor.program import _offer
from retwin.monitor.settings import TwinSettings
from retwin.monitor.store.audit import Entry
from retwin.monitor.store.gridded import gridded
from retwin.monitor.store.samples import Asset, Update
from retwin.twins import ParameterShift
from retwin.update import Dynamics, Library, fit_dynamics

SECOND = 10**9
BEGIN = 1_700_000_000 * SECOND
STEPS = 400


def rows(record: rt.Trajectories, i: int = 0) -> np.ndarray:
    return np.concatenate([record.commands[i], record.observed[i]], axis=1).astype(float)


@pytest.fixture(scope="module")
def monitor() -> Monitor:
    twin = fit_dynamics(TANK, recorded(0), Dynamics(Library(0, (), False))).twin
    return fit_monitor(twin, recorded(1, count=2), "1 per day")


@pytest.fixture(scope="module")
def folder(monitor: Monitor, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("live") / "watch"
    monitor.save(made)
    return made


@pytest.fixture
def store(folder: Path, tmp_path: Path) -> Iterator[Store]:
    with Store(tmp_path / "store") as opened:
        registry = Registry(opened, "tank")
        registry.promote(registry.propose(folder, "first").number)
        yield opened


def opened(store: Store, *assets: str, **settings: object) -> Live:
    live = Live(store, **settings)  # type: ignore[arg-type]
    for name in assets or ("a",):
        live.add(name, "tank")
    return live


def samples(values: np.ndarray, first: int = 0, asset: str = "a", begin: int = BEGIN) -> Samples:
    times = begin + SECOND * np.arange(first, first + len(values))
    return Samples(asset, times, values)


def alarms(store: Store) -> list[dict]:
    return [entry.data for entry in store.log("alarm")]


def events(store: Store) -> list[str]:
    return [entry.data["what"] for entry in store.log("event")]


LEAK = ParameterShift("drain", size=0.2, onset=200.0)


def test_alarms_are_those_of_the_monitor(store: Store, monitor: Monitor) -> None:
    live, made = opened(store), recorded(5, LEAK)
    watched = monitor.watch(made)
    expected = watched.alarms
    assert len(expected) > len(watched.events) > 0
    (found,) = live.submit([samples(rows(made))])
    assert (found.counts.used, found.alarms) == (STEPS, len(watched.events))
    logged = alarms(store)
    assert [each["sample"] for each in logged] == [each.sample for each in expected]
    assert [each["event"] for each in logged] == [BEGIN + SECOND * each.event for each in expected]
    first = logged[0]
    assert first["time"] == BEGIN + SECOND * expected[0].sample
    assert (first["asset"], first["output"], first["version"]) == ("a", "level", 1)
    assert first["evidence"] == expected[0].evidence
    recent = live.recent("a")
    assert recent.mean.shape == (len(recent.times), 1) == recent.commands.shape
    (status,) = live.status()
    assert (status.time, status.alarms) == (BEGIN + SECOND * (STEPS - 1), len(watched.events))
    assert status.event == watched.event[0, -1]
    live.acknowledge(next(store.log("alarm")).sequence, "me", "a leak")
    with pytest.raises(InputError, match="sequence"):
        live.acknowledge(0, "me")
    assert not verify(store.log()).reason


@pytest.mark.slow
def test_machines_and_samples_grouped_in_any_way_give_the_same_bytes(
    folder: Path, tmp_path: Path
) -> None:
    streams = {f"m{i}": rows(recorded(5 + i, LEAK if i % 2 else None)) for i in range(4)}
    found = []
    for kind, sizes in (("one", [STEPS]), ("cut", [7, 1, 92, 300]), ("apart", [50] * 8)):
        with Store(tmp_path / kind) as store:
            registry = Registry(store, "tank")
            registry.promote(registry.propose(folder, "first").number)
            live, first = opened(store, *streams), 0
            for size in sizes:
                batch = [samples(v[first : first + size], first, k) for k, v in streams.items()]
                for part in [[each] for each in batch] if kind == "apart" else [batch]:
                    live.submit(part)
                first += size
            states = [store.state(name) for name in streams]
            assert all(each is not None for each in states)
            arrays = [{k: v.tobytes() for k, v in each[1].items()} for each in states]
            logged = sorted((each["time"], str(each)) for each in alarms(store))
            found.append((arrays, logged))
    assert found[0] == found[1] == found[2]
    assert found[0][1]


def test_a_restart_continues_with_held_samples(store: Store, monitor: Monitor) -> None:
    made = rows(recorded(5, LEAK))
    live = opened(store, wait=30.0)
    live.submit([samples(made[:100])])
    live.submit([samples(made[110:120], 110)])  # ten places are waited for
    live = Live(store, wait=30.0)
    (again,) = live.submit([samples(made[90:120], 90)])
    assert vars(again.counts) == {
        "used": 10, "repeated": 20, "late": 0, "ahead": 0, "extra": 0, "unknown": 0, "refused": 0,
    }  # fmt: skip
    live.submit([samples(made[120:], 120)])
    whole = monitor.watch(recorded(5, LEAK)).alarms
    assert [each["sample"] for each in alarms(store)] == [each.sample for each in whole]


def test_a_place_without_a_sample_is_missing_after_the_wait(store: Store) -> None:
    live, made = opened(store), rows(recorded(2))
    live.submit([samples(made[:10])])
    live.submit([samples(made[11:12], 11)])
    assert len(live.recent("a").times) == 10
    (late,) = live.submit([samples(made[12:20], 12), samples(made[10:11], 10)])[1:]
    assert (late.counts.late, late.counts.used) == (1, 0)
    recent = live.recent("a")
    assert len(recent.times) == 20
    assert np.isnan(recent.measured[10]).all()
    assert np.isfinite(recent.mean).all()
    (in_time,) = live.submit([samples(made[[21, 20, 22]])])  # repeated times of the begin
    assert in_time.counts.repeated == 3


def test_samples_out_of_order_within_the_wait_are_used(store: Store) -> None:
    live, made = opened(store, wait=5.0), rows(recorded(2))
    order = np.concatenate([np.arange(10), [12, 11, 14, 10, 13]])
    times = BEGIN + SECOND * order
    (found,) = live.submit([Samples("a", times, made[order])])
    assert found.counts.used == 15
    np.testing.assert_array_equal(live.recent("a").measured[:, 0], made[:15, 1])


def test_every_sample_has_one_behaviour(store: Store) -> None:
    now = [BEGIN + 1000 * SECOND]
    live, made = opened(store, clock=lambda: now[0]), rows(recorded(2))
    unknown = made[:2].copy()
    unknown[:, 0] = np.nan
    (found,) = live.submit([samples(unknown)])
    assert found.counts.unknown == 2
    live.submit([samples(made[:50])])
    (found,) = live.submit([samples(made[50:51], 2000)])
    assert found.counts.ahead == 1
    half = Samples("a", BEGIN + SECOND * np.arange(50, 60) + SECOND // 3, made[50:60])
    live.submit([samples(made[50:60], 50)])
    (found,) = live.submit([half])
    assert found.counts.extra + found.counts.late == 10
    with pytest.raises(InputError, match="channels"):
        live.submit([Samples("a", np.array([BEGIN]), np.zeros((1, 3)))])
    with pytest.raises(InputError, match="'b'"):
        live.submit([samples(made[:1], 60), samples(made[:1], asset="b")])
    (found,) = live.submit([samples(made[60:61], 60)])  # nothing of the refused batch was used
    assert found.counts.used == 1


def test_a_long_pause_begins_anew(store: Store) -> None:
    live, made = opened(store), rows(recorded(2))
    live.submit([samples(made[:100])])
    live.submit([samples(made[100:200], 100 + 3700)])
    assert events(store) == ["gap"]
    state = store.state("a")
    assert state is not None
    assert int(state[1]["stream"][1]) == 99


def test_a_clock_that_is_set_back_is_logged_once(store: Store) -> None:
    live, made = opened(store), rows(recorded(2))
    live.submit([samples(made[:200])])
    (found,) = live.submit([samples(made[:50], begin=BEGIN + SECOND // 4)])
    assert found.counts.late == 50
    assert events(store) == ["clock"]
    assert live.submit([samples(made[200:210], 200)])[0].counts.used == 10


def test_another_sample_rate_is_a_status_and_an_event(store: Store) -> None:
    live, made = opened(store), rows(recorded(2))
    half = np.arange(0, 150, 2)
    live.submit([Samples("a", BEGIN + SECOND * half, made[half])])
    assert "instead of 1 Hz" in live.status()[0].rate
    live.submit([samples(made[150:380], 150)])
    assert not live.status()[0].rate
    assert events(store) == ["rate", "rate"]
    tenth = BEGIN + 380 * SECOND + np.arange(1200) * SECOND // 10
    live.submit([Samples("a", tenth, np.repeat(made[:120], 10, axis=0))])
    assert live.status()[0].rate.startswith("10 Hz")


def test_an_impossible_value_is_named_and_not_used(store: Store, monitor: Monitor) -> None:
    made = rows(recorded(2))
    made[100:103, 1] = -40.0
    limits = {"limits": {"level": [-1.0, 5.0]}}
    live = Live(store)
    live.add("a", "tank", limits)
    live.submit([samples(made[:101])])
    assert live.status()[0].impossible == (
        "level is outside its limits -1 to 5 m: the sensor or its line is at fault"
    )
    live = Live(store)  # it is not logged again after a restart
    assert live.status()[0].impossible
    live.submit([samples(made[101:150], 101)])
    expected = made.copy()
    expected[100:103, 1] = np.nan
    commands, measured = np.split(expected[None, :150], [1], axis=2)
    assert alarms(store) == []
    assert live.status()[0].ratio == (
        monitor.step(monitor.start(1), commands, measured)[1].evidence[0, -1] / monitor.arl
    )
    _, found = gridded(store, "a", monitor.twin, BEGIN, BEGIN + 150 * SECOND)
    np.testing.assert_array_equal(found, expected[:150])
    live.submit([samples(made[150:204], 150)])
    assert not live.status()[0].impossible
    first, last = (entry.data for entry in store.log("event"))
    assert first["text"] == (
        "impossible: level -40 m is outside its limits -1 to 5 m: the sensor or its line is at "
        "fault; it is not used"
    )
    assert (first["time"], last["time"]) == (BEGIN + 100 * SECOND, BEGIN + 202 * SECOND)
    assert last["text"] == "level is within its limits again"
    for wrong in ({"air": [0.0, 1.0]}, {"level": [5.0, -1.0]}):
        with pytest.raises(InputError, match="limits"):
            live.add("b", "tank", {"limits": wrong})
    live.add("c", "tank", {"limits": {"pump": [0.0, 10.0]}})
    impossible = np.array([[99.0, 0.5]])
    assert live.submit([samples(impossible, asset="c")])[0].counts.unknown == 1


def test_a_new_version_begins_anew(store: Store, monitor: Monitor, tmp_path: Path) -> None:
    live, made = opened(store), rows(recorded(2))
    live.submit([samples(made[:100])])
    replace(monitor, alpha=0.02).save(tmp_path / "other")
    registry = Registry(store, "tank")
    registry.shadow(registry.propose(tmp_path / "other", "wider").number)
    live.refresh()
    assert live.status()[0].version == 1
    crps = np.random.default_rng(0).random((1, 5000))
    registry.promote(2, decide(crps + 0.1, crps, FalseAlarmTest(0, 5000, monitor.arl)))
    live.refresh()
    live.submit([samples(made[100:150], 100)])
    assert (live.status()[0].version, events(store)) == (2, ["version"])
    state = store.state("a")
    assert state is not None
    assert int(state[1]["stream"][1]) == 49


def test_status_and_events_continue_after_a_restart(store: Store) -> None:
    live, made = opened(store), rows(recorded(5, LEAK))
    half = np.arange(0, 202, 2)
    live.submit([Samples("a", BEGIN + SECOND * half, made[half])])
    live.submit([samples(made[202:204], 202)])
    before = live.status()[0]
    assert before.ratio > 0
    assert before.rate
    live = Live(store)
    after = live.status()[0]
    assert (after.ratio, after.rate) == (before.ratio, before.rate)
    live.submit([Samples("a", BEGIN + SECOND * (204 + half), made[half])])
    assert events(store) == ["rate"]  # not once more
    state = store.state("a")
    assert state is not None
    arrays = {name: state[1][name] for name in ("stream", "monitor")}
    store.commit([Update("a", state=arrays, time=state[0])])  # as an earlier program stored it
    assert Live(store).submit([samples(made[:1], 410)])[0].counts.used == 1


def test_another_twin_of_the_same_version_number_begins_anew(
    store: Store, monitor: Monitor, tmp_path: Path
) -> None:
    live, made = opened(store), rows(recorded(2))
    live.submit([samples(made[:100])])
    replace(monitor, alpha=0.02).save(tmp_path / "other")
    registry = Registry(store, "other")
    registry.promote(registry.propose(tmp_path / "other", "another").number)
    live.add("a", "other")
    live.submit([samples(made[100:110], 100)])
    state = store.state("a")
    assert state is not None
    assert int(state[1]["stream"][1]) == 9
    assert events(store) == ["version"]


def test_a_first_start_that_was_cut_off_is_finished_by_the_next_one(
    folder: Path, tmp_path: Path
) -> None:
    with Store(tmp_path / "store") as store:
        registry, twin, lines = Registry(store, "tank"), TwinSettings(monitor=folder), []
        registry.propose(folder, "and killed before it was promoted")
        _offer(registry, twin, lines.append)
        assert registry.active == registry.versions()[0]
        assert "is version 1" in lines[0]


def test_a_store_that_fails_acknowledges_nothing(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    live, made = opened(store), rows(recorded(2))
    live.submit([samples(made[:50])])

    def broken(*_: object) -> None:
        raise InputError("store", expected="a disk with room", got="a full one", remedy="clean up")

    with monkeypatch.context() as patch:
        patch.setattr(store, "commit", broken)
        patch.setattr(store, "state", broken)  # the store cannot be read either
        for _ in range(2):
            with pytest.raises(InputError, match="full"):
                live.submit([samples(made[50:60], 50)])
    (found,) = live.submit([samples(made[50:60], 50)])
    assert found.counts.used == 10


def test_the_earliest_and_the_latest_time_are_restarted_from(store: Store) -> None:
    made = rows(recorded(2))[:2]
    with pytest.raises(InputError, match="ahead"):
        Live(store, ahead=1e300)
    live = opened(store, "a", "b", ahead=9e9)
    live.submit([Samples("a", np.array([1 - 2**63]), made[:1])])
    live.submit([Samples("b", np.array([2**63 - 1]), made[:1])])
    again = Live(store).submit([Samples("a", np.array([1 - 2**63, SECOND - 2**63]), made)])
    assert (again[0].counts.used, again[0].counts.repeated) == (1, 1)


@pytest.mark.slow
def test_samples_with_many_holes_are_taken_in_parts(store: Store, monitor: Monitor) -> None:
    asset = Asset("a", 2, {"twin": "tank"}, 1)
    machine, counts = StreamMachine(asset, monitor, Layout(monitor.start(1)), None), Counts()
    left = Samples("a", BEGIN + 3500 * SECOND * np.arange(50), np.ones((50, 2)))
    while len(left.times):
        left, places = machine.accept(left, BEGIN + 10**18, set(), counts), 0
        while work := machine.next_work():
            places += len(work.values)
        assert places < PLACES + 3600
    assert counts.used == 50


def test_producers_share_commits_and_one_that_is_refused_fails_alone(store: Store) -> None:
    live, made = opened(store, "a", "b"), rows(recorded(2))
    before = live.revision
    with Gate(live) as gate:
        with store.lock:
            sent = [
                gate.send(samples(made[i : i + 1], i, name))
                for i in range(50)
                for name in ("a", "b")
            ]
        assert all(each.result(10).counts.used == 1 for each in sent)
        assert live.revision - before < 20
        refused = gate.send(samples(made[:1], asset="c"))
        with pytest.raises(InputError, match="'c'"):
            refused.result(10)
    assert sum(len(times) for times, _ in store.samples("b")) == 50
    with pytest.raises(InputError, match="closed"):
        gate.send(samples(made[:1], 50))


@pytest.mark.slow
def test_alarms_are_explained_beside_the_stream_and_after_a_restart(store: Store) -> None:
    live, made = opened(store), rows(recorded(5, LEAK))
    reported = []
    with Explanations(live, report=lambda alarm, cause: reported.append(cause)) as explanations:
        live.submit([samples(made[:210])])
        explanations.wait()
    live.submit([samples(made[210:], 210)])
    cause, *further = [entry.data for entry in store.log("cause")]
    assert cause == reported[0]
    assert not cause["same"]
    assert all(each["same"] for each in further)  # of the event that the leak has opened
    assert (cause["name"], cause["alarm"]) == (
        "drain changed",
        next(iter(store.log("alarm"))).sequence,
    )
    assert abs(cause["onset"][0] - (BEGIN + 200 * SECOND)) < 2 * SECOND
    with Explanations(Live(store)) as explanations:
        explanations.wait()
    explained = [entry.data["alarm"] for entry in store.log("cause")]
    assert len(explained) > 1
    assert explained == due(store)


def due(store: Store) -> list[int]:
    """The alarms at which the cause of their event is inferred."""
    found = dict[int, list[Entry]]()
    for entry in store.log("alarm"):
        own = found.setdefault(entry.data["event"], [])
        if is_due([each.data["sample"] for each in own], entry.data["sample"]):
            own.append(entry)
    return [entry.sequence for own in found.values() for entry in own]


def test_machines_take_turns_and_the_newest_event_is_explained_first() -> None:
    turns = _Turns()
    backfill = [("a", event, event + alarm) for event in (0, 100, 200) for alarm in (0, 5)]
    alarms = [*backfill, ("b", 50, 50), ("b", 50, 60)]
    for number, (asset, event, moment) in enumerate(alarms):
        data = {"asset": asset, "time": moment, "event": event}
        turns.put([Entry(number, "alarm", json.dumps(data), "", "")])
    taken = [turns.get() for _ in range(turns.qsize())]
    order = [(each[-1].data["asset"], each[-1].data["time"]) for each in taken if each]
    assert order[:4] == [("a", 200), ("b", 50), ("a", 205), ("b", 60)]
    assert order[4:] == [("a", 100), ("a", 105), ("a", 0), ("a", 5)]


@pytest.mark.parametrize("who", ["", "  "])
def test_an_alarm_is_acknowledged_by_somebody_with_a_name(store: Store, who: str) -> None:
    live = opened(store)
    live.submit([samples(rows(recorded(5, LEAK)))])
    first = next(iter(store.log("alarm")))
    with pytest.raises(InputError, match="who: expected who has seen it"):
        live.acknowledge(first.sequence, who)
    assert not list(store.log("acknowledge"))


@pytest.mark.slow
def test_a_report_that_fails_and_the_end_leave_no_alarm_waited_for(store: Store) -> None:
    live, made = opened(store), rows(recorded(5, LEAK))

    def failing(*_: object) -> None:
        raise RuntimeError

    with Explanations(live, report=failing) as explanations:
        live.submit([samples(made[:230])])
        explanations.wait()
    assert [each.data["alarm"] for each in store.log("cause")] == due(store) != []
    explanations = Explanations(live)
    live.submit([samples(made[230:], 230)])
    explanations.close()
    explanations.wait()


def test_an_alarm_whose_samples_were_removed_says_so(folder: Path, tmp_path: Path) -> None:
    with Store(tmp_path / "store", max_samples=5) as store:
        registry = Registry(store, "tank")
        registry.promote(registry.propose(folder, "first").number)
        live = opened(store)
        with Explanations(live) as explanations:
            live.submit([samples(rows(recorded(5, LEAK)))])
            explanations.wait()
        first = next(store.log("cause")).data
        assert first["name"] == "unknown"
        assert "max_samples" in first["note"]


@pytest.mark.slow
def test_a_stored_stream_gives_the_same_alarms_again(
    store: Store, folder: Path, tmp_path: Path
) -> None:
    """Though it came with holes, out of order, repeated, late, at another rate and in two runs."""
    values = rows(recorded(5, LEAK))
    values[50:60, 1] = np.nan
    rng = np.random.default_rng(0)
    given = samples(values)
    order = np.argsort(np.arange(STEPS) + rng.uniform(0, 1.5, STEPS))
    order = order[~np.isin(order, rng.choice(STEPS, 40, replace=False))]
    times = given.times[order] + rng.integers(-(10**8), 10**8, len(order))
    for part in np.array_split(np.arange(len(order)), 3):
        live = opened(store)
        for i in np.concatenate([part, part[::7], part[3:8] - 3]):  # some are repeated or late
            live.submit([Samples("a", times[[i]], given.values[order[[i]]])])
    counts = live.status()[0].counts
    assert counts["repeated"], counts
    assert alarms(store)
    files = [tmp_path / "one.jsonl", tmp_path / "two.jsonl"]
    export_log(store.log(), files[0], kind="alarm", order=("time", "asset"))
    with Store(tmp_path / "again") as again:
        registry = Registry(again, "tank")
        registry.promote(registry.propose(folder, "first").number)
        live = opened(again)
        for part_times, part_values in store.samples("a"):
            live.submit([Samples("a", part_times, part_values)])
        export_log(again.log(), files[1], kind="alarm", order=("time", "asset"))
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.slow
def test_the_reference_shows_what_an_update_has_learned(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fault that grew slowly: the second version takes it for healthy, the first one does not."""
    grown = ParameterShift("drain", size=0.05)

    def changed(seed: int, count: int = 1) -> rt.Trajectories:
        return recorded(seed, grown, count).replace(labels=None)

    twin = fit_dynamics(TANK, changed(0), Dynamics(Library(0, (), False))).twin
    fit_monitor(twin, changed(1, 2), "1 per day").save(tmp_path / "newer")
    registry = Registry(store, "tank")
    for _ in range(2):
        registry.shadow(registry.propose(tmp_path / "newer", "newer").number)
    worse = np.random.default_rng(0).gamma(9.0, size=1000)
    registry.promote(2, decide(worse, worse - 1, FalseAlarmTest(0, 1000, 86_400)))
    registry.shadow(3)
    opened(store).submit([samples(rows(changed(6)))])
    assert not alarms(store)
    found = compare(store, "tank", 3)
    assert (found.difference, found.false_alarms.alarms) == (0, 0)
    assert found.reference is not None
    assert found.reference.alarms
    assert "alarms of the first active version in the same samples" in found.summary
