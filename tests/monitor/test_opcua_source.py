"""Samples from an OPC UA server in a process of its own."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from broker import free_port
from certificates import Authority
from collecting import CollectingGate, running, wait

from retwin.data.logs.signals import nanoseconds
from retwin.errors import InputError
from retwin.monitor.settings import OpcUaSource
from retwin.monitor.sources.opcua import Assembly, OpcUa

SCRIPT = Path(__file__).with_name("opcua_server.py")
BEGIN = nanoseconds(datetime(2026, 1, 1, tzinfo=UTC))
MS = 10**6
NAN = float("nan")


class Server:
    def __init__(self, *folder: str) -> None:
        self.port = free_port()
        self.process: subprocess.Popen | None = None
        self._folder = folder

    def start(self) -> None:
        command = [sys.executable, str(SCRIPT), str(self.port), *self._folder]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
        assert self.process.stdout.readline() == "ready\n"

    def stop(self) -> None:
        self.process.kill()
        self.process.communicate()

    def write(self, node: str, value: float, milliseconds: int, status: str = "Good") -> None:
        self.process.stdin.write(f"{node} {value} {status} {milliseconds}\n")
        self.process.stdin.flush()


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    made = Server()
    made.start()
    yield made
    made.stop()


def source(port: int, lines: list[str], more: dict | None = None, **nodes: str) -> OpcUa:
    own = nodes or {"heater": "ns=2;s=heater", "T1": "ns=2;s=T1"}
    settings = {"type": "opcua", "url": f"opc.tcp://127.0.0.1:{port}/", "nodes": {"line1": own}}
    model = OpcUaSource.model_validate({**settings, "interval": 0.05, **(more or {})})
    return OpcUa(model, {"line1": ("heater", "T1")}, {"line1": 10.0}, lines.append)


@pytest.mark.slow
def test_values_become_samples_by_the_time_of_their_source(server) -> None:
    lines: list[str] = []
    gate = CollectingGate()
    with running(source(server.port, lines), gate):
        wait(lambda: bool(lines))
        for number in range(5):
            server.write("heater", number, 100 * number)
            server.write("T1", 20 + number, 100 * number + 3)  # a little later
        server.write("T1", 25, 500)  # the heater is as before
        server.write("T1", 25, 600)  # the same value at a later time
        server.write("T1", 99, 700, "BadSensorFailure")
        server.write("T1", 27, 800, "Uncertain")
        wait(lambda: len(gate.times("line1")) >= 9, lines)
    times = [(each - BEGIN) / MS for each in gate.times("line1")][-9:]
    assert times == [0, 100, 200, 300, 400, 500, 600, 700, 800]
    expected = [[n, 20 + n] for n in range(5)] + [[4, 25], [4, 25], [4, NAN], [4, 27]]
    np.testing.assert_array_equal(gate.values("line1")[-9:], expected)
    assert lines == [f"opcua opc.tcp://127.0.0.1:{server.port}/: connected"]


@pytest.mark.slow
def test_a_server_that_is_away(server) -> None:
    lines: list[str] = []
    gate = CollectingGate()
    with running(source(server.port, lines), gate):
        wait(lambda: bool(lines))
        server.write("heater", 1, 1000)
        server.write("T1", 20, 1000)
        wait(lambda: BEGIN + 1000 * MS in gate.held.get("line1", {}), lines)
        server.stop()
        wait(lambda: len(lines) == 2)
        server.start()
        assert wait(lambda: len(lines) == 3, lines) <= 10
        server.write("heater", 2, 9000)
        server.write("T1", 21, 9000)
        wait(lambda: BEGIN + 9000 * MS in gate.held["line1"], lines)
    assert gate.held["line1"][BEGIN + 9000 * MS] == [2, 21]
    assert [line.split(": ")[1].split(" (")[0] for line in lines] == ["connected", "lost", "back"]


@pytest.mark.slow
def test_messages_are_signed_and_encrypted_for_a_user(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("WATCH_PASSWORD", "secret")
    monkeypatch.setenv("OTHER_PASSWORD", "another")
    authority = Authority(tmp_path)
    cert, key = authority.certify("server", "urn:tests:server")
    cert.rename(tmp_path / "cert.pem")
    key.rename(tmp_path / "key.pem")
    own = authority.certify("own, name", "urn:tests:watch")
    files = {"cert_file": own[0], "key_file": own[1]}
    stranger, key = authority.certify("stranger", "urn:tests:stranger")
    (tmp_path / "trusted").mkdir()
    shutil.copy(files["cert_file"], tmp_path / "trusted")
    secure = Server(str(tmp_path))
    secure.start()
    good = {"security": "Basic256Sha256", "user": "watch", "password_env": "WATCH_PASSWORD"}
    good |= {**files, "server_file": tmp_path / "cert.pem"}
    bad = {
        "signed": {"security": None, "cert_file": None, "key_file": None, "server_file": None},
        "password": {"password_env": "OTHER_PASSWORD"},
        "trusted": {"cert_file": stranger, "key_file": key},
        "server": {"server_file": stranger},
        "key": {"key_file": own[0]},
    }
    try:
        gate = CollectingGate()
        lines: list[str] = []
        with running(source(secure.port, lines, good), gate):
            wait(lambda: bool(lines))
            assert "connected" in lines[0]
            secure.write("heater", 1, 1000)
            secure.write("T1", 20, 1000)
            wait(lambda: BEGIN + 1000 * MS in gate.held.get("line1", {}), lines)
        for what, change in bad.items():
            lines = []
            with running(source(secure.port, lines, good | change), gate):
                wait(lambda lines=lines: bool(lines))
            assert "lost" in lines[0], what
    finally:
        secure.stop()


def test_what_is_wrong_in_the_settings_is_named() -> None:
    missing = {"security": "Basic256Sha256", "cert_file": "none.pem", "key_file": "none.pem"}
    with pytest.raises(InputError, match=r"sources\.cert_file"):
        source(1, [], missing)
    with pytest.raises(InputError, match="a node for each of heater, T1"):
        source(1, [], heater="ns=2;s=heater")
    with pytest.raises(InputError, match="addresses of nodes"):
        source(1, [], heater="heater", T1="ns=2;s=T1")


@pytest.mark.slow
def test_a_node_that_is_not_there_is_named(server) -> None:
    lines: list[str] = []
    nodes = {"heater": "ns=2;s=heater", "T1": "ns=2;s=none"}
    with running(source(server.port, lines, **nodes), CollectingGate()):
        wait(lambda: bool(lines))
    assert "lost" in lines[0]
    assert "none" in lines[0]


def test_an_assembly_keeps_unchanged_values_and_waits_for_late_ones() -> None:
    made = Assembly(2, period=1.0, settle=5.0)
    second = 10**9
    made.hold(0, 7.0)  # a command that was given an hour ago
    assert made.take(1.0)[0].tolist() == []
    assert made.take(9.0)[0].tolist() == []
    made.add(1, 0, 1.0, now=1.0)
    times, values = made.take(6.0)
    assert (times.tolist(), values.tolist()) == ([0], [[7.0, 1.0]])
    made.add(1, second, 2.0, now=6.0)
    assert made.take(10.0)[0].tolist() == []
    made.add(0, second + 4 * 10**8, 8.0, now=10.0)  # less than half a period later
    times, values = made.take(10.0)
    assert (times.tolist(), values.tolist()) == ([second], [[8.0, 2.0]])
    made.add(0, 0, 9.0, now=10.0)  # after the sample of that time was taken
    assert made.take(10.0)[0].tolist() == [0]
    made.add(0, 2 * second, NAN, now=10.0)
    made.add(1, 2 * second, 3.0, now=10.0)
    times, values = made.take(10.0)
    np.testing.assert_array_equal(values, [[NAN, 3.0]])
