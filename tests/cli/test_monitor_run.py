"""`retwin monitor run`: from a file or a broker to stored samples, alarms and causes."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

import numpy as np
import paho.mqtt.client as paho
import pytest

import retwin as rt
from retwin.monitor import Registry, Store

sys.path.append(str(Path(__file__).parents[1] / "monitor"))
from broker import Broker

SETTINGS = """
store = "store"
[twins.tank]
monitor = "watch"
case = "case.toml"
[assets.tank1]
twin = "tank"
"""
SERVER = """
[server]
port = 0
token_file = "token"
"""
FOLDER = """
[[sources]]
type = "folder"
files = "logs/{asset}.csv"
"""


@pytest.fixture
def place(watched: Path, tmp_path: Path) -> Path:
    """A folder with a monitor, and a monitor.toml without sources."""
    os.symlink(watched / "watch", tmp_path / "watch")
    for name in ("case.toml", "watched_module.py"):
        shutil.copy(watched / name, tmp_path)
    (tmp_path / "monitor.toml").write_text(SETTINGS)
    (tmp_path / "logs").mkdir()
    return tmp_path


@pytest.fixture
def watching(start) -> Callable:
    """Start `retwin monitor run`."""

    def run(folder: Path):
        with (folder / "out").open("w") as out:
            made = start("monitor", "run", "--config", folder / "monitor.toml", stdout=out)
        made.out = lambda: (folder / "out").read_text()
        return made

    return run


def stopped(running, number: int = signal.SIGTERM) -> None:
    os.kill(running.process.pid, number)
    assert running.process.wait(60) == 0, running.stderr
    assert "Traceback" not in running.stderr


def rows(record: rt.Trajectories, first: int, last: int, begin: float) -> str:
    values = np.concatenate([record.commands[0], record.observed[0]], axis=1)
    return "".join(f"{begin + k},{values[k, 0]},{values[k, 1]}\n" for k in range(first, last))


@pytest.mark.slow
def test_alarms_and_causes_are_lines_and_a_changed_monitor_is_proposed(
    watched: Path, place: Path, watching
) -> None:
    notify = '[notify.shift]\nfile = "events.jsonl"\n'
    (place / "monitor.toml").write_text(SETTINGS + FOLDER + SERVER + notify)
    (place / "token").write_text("a token of many characters")
    leak, begin = rt.load(watched / "leak.npz"), round(time.time()) - 1000
    log = place / "logs" / "tank1.csv"
    log.write_text("time,valve,level\n" + rows(leak, 0, 200, begin))
    running = watching(place)
    running.wait(lambda: "watching" in running.out())
    with log.open("a") as file:
        file.write(rows(leak, 200, 330, begin))
    running.wait(lambda: "cause of alarm" in running.out())
    (page,) = re.findall("page: (.*)", running.out())
    metrics = urllib.request.urlopen(page + "metrics").read().decode()
    assert re.search("source.*tank1.*[}] 1", metrics) or "logs/{asset}.csv" in metrics, metrics
    stopped(running)
    lines = running.out().splitlines()
    assert "is version 1" in lines[0]
    alarm = next(line for line in lines if "ALARM" in line)
    assert alarm.startswith("tank1: ALARM ")
    assert "level, lower than predicted" in alarm
    assert "leaking from" in next(line for line in lines if "cause of alarm" in line)
    written = (place / "events.jsonl").read_text().splitlines()
    told = [json.loads(line)["text"] for line in written]
    assert told[0] == alarm
    assert "leaking from" in told[1]
    with Store(place / "store", read_only=True) as store:
        stored = sum(len(times) for times, _ in store.samples("tank1"))
    assert stored == 330

    os.unlink(place / "watch")
    shutil.copytree(watched / "watch", place / "watch")
    (place / "watch" / "notes.txt").write_text("another one")
    with log.open("a") as file:
        file.write(rows(leak, 330, 340, begin))
    for _ in range(2):  # it is proposed once
        running = watching(place)
        running.wait(lambda running=running: "watching" in running.out())
        stopped(running, signal.SIGINT)
    with Store(place / "store", read_only=True) as store:
        assert [each.state for each in Registry(store, "tank").versions()] == ["active", "proposed"]
        stored = sum(len(times) for times, _ in store.samples("tank1"))
    assert stored == 340


@pytest.mark.slow
def test_a_page_without_a_token_is_read_only(
    place: Path, watching, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RETWIN_MONITOR_TOKEN", raising=False)
    (place / "monitor.toml").write_text(SETTINGS + "[server]\nport = 0\n")
    running = watching(place)
    running.wait(lambda: "watching" in running.out())
    (page,) = re.findall("page: (.*) [(]read only", running.out())
    assert json.loads(urllib.request.urlopen(page + "assets").read())
    for token in ("", "Bearer ", "Bearer None"):
        asked = urllib.request.Request(page + "samples", b"{}", {"Authorization": token})
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(asked)
    stopped(running)


@pytest.mark.slow
def test_a_growing_table_is_read_by_the_mapping_that_data_map_wrote(
    watched: Path, place: Path, watching, call
) -> None:
    healthy, begin = rt.load(watched / "healthy.npz"), round(time.time()) - 1000
    valve, level = healthy.commands[0, :, 0], healthy.observed[0, :, 0]
    lines = [
        f"{begin + k};{u};{100 * y:.17g}\n"
        for k, (u, y) in enumerate(zip(valve, level, strict=True))
    ]
    log = place / "logs" / "tank1.csv"
    log.write_text("# line 7\ntime;valve;level [cm]\n" + "".join(lines[:300]).replace(".", ","))
    mapping = place / "mapping.toml"
    code, _, err = call("data", "map", log, "--case", watched / "case.toml", "--out", mapping)
    assert code == 0, err
    settings = SETTINGS.replace("case.toml", str(watched / "case.toml"))
    source = FOLDER + 'mapping = "mapping.toml"\n'
    (place / "monitor.toml").write_text(settings + source)
    running = watching(place)
    running.wait(lambda: "watching" in running.out())
    with log.open("a") as file:
        file.write("".join(lines[300:350]).replace(".", ","))
    with Store(place / "store", read_only=True) as store:

        def stored() -> np.ndarray:
            return np.concatenate([np.empty((0, 2)), *(each for _, each in store.samples("tank1"))])

        running.wait(lambda: len(stored()) == 350)
        np.testing.assert_allclose(stored(), np.stack([valve, level], 1)[:350], rtol=1e-12)
    stopped(running)
    mapping.write_text(mapping.read_text().replace("rate = 1.0", "rate = 2.0"))
    code, _, err = call("monitor", "run", "--config", place / "monitor.toml")
    assert (code, err.count("\n"), "that of the twin, 1 Hz" in err) == (2, 1, True), err


@pytest.mark.slow
def test_nothing_published_is_lost_by_a_kill(watched: Path, place: Path, watching) -> None:
    broker = Broker(place / "broker").start()
    client = paho.Client(paho.CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
    try:
        source = f'type = "mqtt"\nhost = "127.0.0.1"\nport = {broker.port}\ntopic = "t/{{asset}}"'
        (place / "monitor.toml").write_text(f"{SETTINGS}[[sources]]\n{source}\n")
        client.connect("127.0.0.1", broker.port)
        client.loop_start()
        healthy, begin = rt.load(watched / "healthy.npz"), round(time.time()) - 1000
        values = np.concatenate([healthy.commands[0], healthy.observed[0]], axis=1)
        running = watching(place)
        running.wait(lambda: "connected" in running.out())
        for k in range(300):
            sample = dict(zip(("valve", "level"), values[k].tolist(), strict=True))
            client.publish("t/tank1", json.dumps({"time": begin + k, "values": sample}), qos=1)
            time.sleep(0.002)
            if k == 150:
                running.process.kill()
                running.process.wait()
                running = watching(place)
        with Store(place / "store", read_only=True) as store:

            def stored() -> list[int]:
                return [int(t) for times, _ in store.samples("tank1") for t in times]

            running.wait(lambda: len(stored()) == 300)
            assert stored() == [(begin + k) * 10**9 for k in range(300)]
        stopped(running)
    finally:
        client.disconnect()
        client.loop_stop()
        broker.stop()


def test_what_is_wrong_is_refused_before_the_store_is_made(tmp_path: Path, call) -> None:
    for text, message in (
        (SETTINGS.replace('"watch"', '"none"'), "none"),
        (SETTINGS.replace("[assets.tank1]", "[assets]"), "assets.twin"),
        (SETTINGS + SERVER, "token"),
        (SETTINGS + SERVER.replace('"token"', '"short"'), "at least 16 ASCII characters"),
    ):
        (tmp_path / "short").write_text("short")
        (tmp_path / "monitor.toml").write_text(text)
        code, printed, err = call("monitor", "run", "--config", tmp_path / "monitor.toml")
        assert (code, printed, err.count("\n"), message in err) == (2, "", 1, True), err
        assert not (tmp_path / "store").exists()
    code, _, err = call("monitor", "run", "--config", tmp_path / "other.toml")
    assert (code, "other.toml" in err) == (2, True), err
