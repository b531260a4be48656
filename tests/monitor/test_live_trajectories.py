"""Machines that work in trajectories, watched as these are completed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from time import sleep

import httpx
import numpy as np
import pytest
from collecting import running, wait
from monitor.test_trajectory_monitor import TANK, runs

import retwin as rt
from retwin.diagnosis.inversion.states import StateInversionDiagnoser
from retwin.errors import InputError
from retwin.monitor import Explanations, Gate, Live, Registry, Samples, Store, export_log, verify
from retwin.monitor.live.machine import Counts
from retwin.monitor.live.trajectory_machine import Diagnosed, TrajectoryMachine
from retwin.monitor.models.trajectory.monitor import TrajectoryMonitor, fit_trajectory_monitor
from retwin.monitor.program import run
from retwin.monitor.server import create_app, listening, serving
from retwin.monitor.settings import FolderSource, read_settings
from retwin.monitor.sources.folder import TrajectoryFolder
from retwin.monitor.store.samples import SECOND, Trajectory, parse
from retwin.twins import ParameterShift
from retwin.update import Dynamics, Library, fit_dynamics

BEGIN = 1_700_000_000 * SECOND
LENGTH = 6 * SECOND
APART = 10 * SECOND
LEAK = ParameterShift("drain", size=0.6)


def fitted() -> TrajectoryMonitor:
    twin = fit_dynamics(TANK, runs(4, 0), Dynamics(Library(0, (), False))).twin
    faults = {"Healthy": None, "leak": ParameterShift("drain", size=(0.1, 1.0))}
    return fit_trajectory_monitor(StateInversionDiagnoser(twin, faults), runs(9, 1), 100)


@pytest.fixture(scope="module")
def monitor() -> TrajectoryMonitor:
    return fitted()


@pytest.fixture(scope="module")
def folder(monitor: TrajectoryMonitor, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("live") / "watch"
    monitor.save(made)
    return made


@pytest.fixture(scope="module")
def work() -> rt.Trajectories:
    """Three healthy trajectories, and two with a leak."""
    return rt.Trajectories.concatenate([runs(3, 3), runs(2, 4, LEAK)])


@pytest.fixture
def opened(folder: Path, tmp_path: Path) -> Callable:
    @contextmanager
    def open_(name: str = "store", *assets: str) -> Iterator[Live]:
        with Store(tmp_path / name) as store:
            registry = Registry(store, "robot")
            if registry.active is None:
                registry.promote(registry.propose(folder, "first").number)
            live = Live(store)
            for asset in assets or ("a",):
                live.add(asset, "robot")
            yield live

    return open_


def trajectories(made: rt.Trajectories, asset: str = "a", first: int = 0) -> list[Trajectory]:
    values = np.concatenate([made.commands, made.observed], axis=2)
    return [Trajectory(asset, BEGIN + APART * (first + i), each) for i, each in enumerate(values)]


def stored(store: Store, asset: str = "a") -> list[bytes]:
    found = store.state(asset)
    assert found is not None
    parts = [array.tobytes() for pair in store.samples(asset) for array in pair]
    return [*(found[1][name].tobytes() for name in sorted(found[1])), *parts]


def alarm_log(store: Store, path: Path) -> bytes:
    export_log(store.log(), path, kind="alarm", order=("time", "asset"))
    return path.read_bytes()


def test_alarms_have_causes_and_do_not_depend_on_grouping_or_restarts(
    opened: Callable, monitor: TrajectoryMonitor, work: rt.Trajectories, tmp_path: Path
) -> None:
    expected = monitor.watch(work)[1]
    assert [alarm.number for alarm in expected.alarms] == [3, 4]
    with opened("whole") as live, Explanations(live) as explanations:
        found = live.submit(trajectories(work))
        assert [each.counts.used for each in found] == [1] * 5
        assert [each.alarms for each in found] == [0, 0, 0, 1, 1]
        (status,) = live.status()
        assert (status.alarms, status.time) == (2, BEGIN + 4 * APART + LENGTH - SECOND // 10)
        assert live.recent("a").measured[:, 0].tobytes() == expected.score.tobytes()
        assert live.recent("a").evidence.tobytes() == expected.evidence.tobytes()
        explanations.wait()
        assert not list(live.store.log("cause")), "the cause is in the alarm"
        first = next(live.store.log("alarm")).data
        assert (first["cause"]["name"], first["begin"]) == ("leak", BEGIN + 3 * APART)
        assert first["cause"]["probabilities"] == expected.alarms[0].shares
        assert not verify(live.store.log(), live.store.head).reason
        whole = stored(live.store), alarm_log(live.store, tmp_path / "whole.jsonl")
    for each in trajectories(work):
        with opened("parts") as live, Gate(live) as gate:
            assert gate.send(each).result(60).counts.used == 1
            parts = stored(live.store), alarm_log(live.store, tmp_path / "parts.jsonl")
    assert parts == whole


def test_each_trajectory_has_one_behaviour(opened: Callable, work: rt.Trajectories) -> None:
    first, second, third, *_ = trajectories(work)
    unknown = third.values.copy()
    unknown[0, 0] = np.nan
    with opened() as live:
        live.submit([second])
        state = stored(live.store)
        given = [
            (second, "repeated"),
            (Trajectory("a", second.begin + SECOND + 1, second.values), "late"),  # it overlaps
            (first, "late"),
            (Trajectory("a", 2**62, third.values), "ahead"),
            (Trajectory("a", third.begin, unknown), "unknown"),
            (Trajectory("a", third.begin, third.values[:1]), "refused"),
            (Samples("a", np.array([third.begin]), third.values[:1]), "refused"),
        ]
        for each, what in given:
            (found,) = live.submit([each])
            assert [name for name, n in vars(found.counts).items() if n] == [what]
        assert stored(live.store) == state
        texts = [entry.data["text"] for entry in live.store.log("event")]
        assert len(texts) == 5
        assert texts[0].endswith("it begins before the newest one ends")
        with pytest.raises(InputError, match="2 channels"):
            live.submit([Trajectory("a", third.begin, third.values[:, :1])])
        gap = third.values.copy()
        gap[5] = np.nan  # a command is the one before, an output is missing
        (found,) = live.submit([Trajectory("a", third.begin, gap)])
        assert found.counts.used == 1


def test_trajectories_that_are_not_used_as_usual_are_events_once(
    opened: Callable, work: rt.Trajectories
) -> None:
    given = trajectories(rt.Trajectories.concatenate([work[:3], work[:2]]))
    for k, wrong in ((1, -1e300), (2, -1e300), (3, np.nan)):
        given[k].values[:, 1] = wrong
    for each in given:  # a restart before each
        with opened() as live:
            assert live.submit([each])[0].counts.used == 1
    with opened() as live:
        texts = [entry.data["text"] for entry in live.store.log("event")]
    assert texts == [
        "trajectory with readings that no healthy machine can have caused",
        "trajectory without measured samples, which are no evidence",
        "trajectory measured as those of the calibration again",
    ]


def test_a_commit_that_fails_is_repeated_with_the_same_result(
    opened: Callable, work: rt.Trajectories, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = trajectories(work)
    with opened("whole") as live:
        live.submit(given[2:5])
        whole = stored(live.store)
    with opened("failing") as live:
        live.submit(given[2:3])
        commit = live.store.commit

        def broken(*args: object) -> None:
            commit(*args)  # the database stored it, and its answer was lost
            raise InputError("store", expected="an answer", got="none", remedy="try again")

        monkeypatch.setattr(live.store, "commit", broken)
        with pytest.raises(InputError, match="store"):
            live.submit(given[3:4])
        monkeypatch.setattr(live.store, "commit", commit)
        assert [each.counts.repeated for each in live.submit(given[3:5])] == [1, 0]
        assert stored(live.store) == whole


def test_others_go_on_while_a_trajectory_is_diagnosed(
    opened: Callable, work: rt.Trajectories, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, resume, times = threading.Event(), threading.Event(), []
    diagnose = TrajectoryMachine.diagnose

    def slow(machine: TrajectoryMachine, given: Trajectory) -> Diagnosed | str:
        times.append(machine.asset.version)
        begun.set()
        assert resume.wait(60)
        return diagnose(machine, given)

    monkeypatch.setattr(TrajectoryMachine, "diagnose", slow)
    with opened() as live, Gate(live) as gate:
        sent = gate.send(trajectories(work)[3])
        assert begun.wait(60)
        assert live.status()[0].time is None
        live.store.add_asset(replace(live.store.assets()[0], settings={"twin": "robot", "of": 2}))
        live.refresh()  # the machine is another one since: it is diagnosed again
        resume.set()
        assert (sent.result(60).alarms, times) == (1, [1, 1])


def test_the_page_shows_trajectories_that_were_posted(
    opened: Callable, work: rt.Trajectories
) -> None:
    token = "t" * 16
    rows = [
        {
            "asset": each.asset,
            "time_ns": each.begin,
            "values": dict(zip(("pump", "level"), each.values.T.tolist(), strict=True)),
        }
        for each in trajectories(work)[2:4]
    ]
    with (
        opened() as live,
        Gate(live) as gate,
        listening("127.0.0.1", 0) as bound,
        serving(create_app(live, gate, token=token), bound),
        httpx.Client(
            base_url=f"http://127.0.0.1:{bound.getsockname()[1]}",
            headers={"authorization": f"Bearer {token}"},
            timeout=60,
        ) as client,
    ):
        answer = client.post("/samples", json=rows).json()["a"]
        assert (answer["used"], answer["alarms"]) == (2, 1)
        (asset,) = client.get("/assets").json()["assets"]
        alarm = asset["alarm"]
        assert (asset["state"], alarm["cause"]["name"]) == ("alarm", "leak")
        assert "drain" in alarm["cause"]["check"]
        shown = client.get("/assets/a").json()
        assert (shown["outputs"], len(shown["evidence"])) == ([["score", "1"]], 2)
        assert shown["kind"] == "scores"
        around = client.get(f"/alarms/{alarm['sequence']}/samples").json()
        assert (around["outputs"], around["kind"]) == ([["level", "m"]], "trajectory")
        fits = np.ravel(around["mean"]) - TANK.simulate(work.commands[[3]], seed=0).nominal.ravel()
        assert 0 < np.abs(fits).max() < 0.5, "the twin of the healthy machine, of another drain"
        np.testing.assert_allclose(np.ravel(around["measured"]), work.observed[3, :, 0])
        uneven = {**rows[0], "values": {"pump": [1, 2], "level": [1]}}
        refused = client.post("/samples", json=uneven)
        assert refused.status_code == 400
        assert "an array of 2 numbers" in refused.json()["error"]
        assert "retwin_alarms_total" in client.get("/metrics").text


def test_files_are_read_once_they_are_complete(
    opened: Callable, monitor: TrajectoryMonitor, work: rt.Trajectories, tmp_path: Path
) -> None:
    (tmp_path / "logs").mkdir()
    given = {"type": "folder", "files": str(tmp_path / "logs" / "*"), "asset": "a", "every": 0.02}
    settings = FolderSource.model_validate(given | {"settle": 1.5})
    lines: list[str] = []
    first, second, *_ = trajectories(work)
    table = "".join(
        f"{BEGIN // SECOND + k / 10},{pump!r},{level!r}\n"
        for k, (pump, level) in enumerate(first.values.tolist())
    )
    half = len(table) // 2
    (tmp_path / "logs" / "b.csv").write_text("time,pump,level\n" + table[:half])
    with opened() as live, Gate(live) as gate:
        source = TrajectoryFolder(settings, {"a": (monitor, None)}, {}, lines.append)
        with running(source, gate):
            (tmp_path / "logs" / "bad.npz").write_bytes(b"PK")
            sleep(0.1)
            assert live.status()[0].time is None, "it is not complete"
            with (tmp_path / "logs" / "b.csv").open("a") as file:
                file.write(table[half:])
            wait(lambda: live.status()[0].counts["used"] == 1, lines)
            rt.save(work[[1, 3]], tmp_path / "part.npz")
            os.utime(tmp_path / "part.npz", ns=(second.begin, second.begin))
            (tmp_path / "part.npz").rename(tmp_path / "logs" / "a.npz")
            wait(lambda: live.status()[0].counts["used"] == 3, lines)
            wait(lambda: sum("refused" in line for line in lines) == 1, lines)
        files = stored(live.store)
        again = TrajectoryFolder(
            settings, {"a": (monitor, None)}, {"a": live.status()[0].time}, lines.append
        )
        with running(again, gate):
            wait(lambda: sum("refused" in line for line in lines) == 2, lines)
        assert live.status()[0].counts == {**dict.fromkeys(vars(Counts()), 0), "used": 3}
        assert live.status()[0].alarms == 1
    with opened("other") as live:
        leak = trajectories(work)[3]
        live.submit([first, second, Trajectory("a", second.begin + LENGTH, leak.values)])
        assert stored(live.store) == files


def test_arrays_are_bounded_and_those_of_other_machines_are_samples() -> None:
    (made,) = parse(json.dumps({"asset": "b", "time": 2, "values": {"u": [1, 2]}}), lambda _: "uy")
    assert isinstance(made, Trajectory)
    single = made.samples(4.0)
    assert single.times.tolist() == [2 * SECOND, 2 * SECOND + SECOND // 4]
    np.testing.assert_array_equal(single.values, [[1, np.nan], [2, np.nan]])
    with pytest.raises(InputError, match="at most 100000"):
        parse(json.dumps({"asset": "b", "time": 2, "values": {"u": [0] * 100_001}}), lambda _: "uy")


@pytest.mark.parametrize(
    "kills",
    [pytest.param(5, marks=pytest.mark.slow), pytest.param(200, marks=pytest.mark.long)],
)
def test_kills(kills: int, tmp_path: Path) -> None:
    script = Path(__file__).with_name("killing_trajectories.py")
    command = [sys.executable, str(script), str(tmp_path), str(kills), "0"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    assert f"{kills} kills" in done.stderr


def test_the_program_watches_a_folder_and_refuses_sources_of_samples(
    folder: Path, work: rt.Trajectories, tmp_path: Path
) -> None:
    (tmp_path / "logs" / "a").mkdir(parents=True)
    for i in (2, 3):
        rt.save(work[[i]], path := tmp_path / "logs" / "a" / f"{i}.npz")
        begin = (BEGIN + APART * i) / SECOND
        os.utime(path, (begin, begin))
    config = f'store = "store"\n[twins.robot]\nmonitor = "{folder}"\n[assets.a]\ntwin = "robot"\n'
    config += "[[sources]]\n"
    (tmp_path / "opcua.toml").write_text(
        config + 'type = "opcua"\nurl = "opc.tcp://h"\nnodes.a = { pump = "ns=2;s=p" }\n'
    )
    lines: list[str] = []
    with pytest.raises(InputError, match="complete trajectories, for a"):
        run(read_settings(tmp_path / "opcua.toml"), lines.append, threading.Event())
    files = 'type = "folder"\nfiles = "logs/{asset}/*.npz"\nevery = 0.02\n'
    (tmp_path / "folder.toml").write_text(config + files)
    stop = threading.Event()

    def report(line: str) -> None:
        lines.append(line)
        if "ALARM" in line:
            stop.set()

    run(read_settings(tmp_path / "folder.toml"), report, stop)
    assert any("trajectory 2, unlike" in each and "cause: leak" in each for each in lines), lines
