"""Samples from a real MQTT broker: nothing is lost, and what is malformed stops nothing."""

from __future__ import annotations

import gc
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import paho.mqtt.client as paho
import pytest
from broker import Broker
from certificates import Authority
from collecting import CollectingGate, running, wait

from retwin.errors import InputError
from retwin.monitor.settings import MqttSource
from retwin.monitor.sources.mqtt import Mqtt

CHANNELS = {"line1": ("heater", "T1"), "line2": ("heater", "T1")}
SECOND = 10**9
PASSWORD = (
    "watch:$7$101$cmV0d2luLXRlc3Rz$Kjivzy2dS5LwfxLqilWG9JQE45lc9pWRmJEkVantGOjNAFX+N70Di19oeMVeJT6s"
    "9p99JGIZ16QQ82wy7kLRIw==\n"
)
"""A line of Mosquitto's file of passwords: the user "watch" with the password "secret"."""


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    made = Broker(tmp_path / "broker").start()
    yield made
    made.stop()


@pytest.fixture
def publisher(broker: Broker) -> Iterator[paho.Client]:
    client = paho.Client(paho.CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
    client.reconnect_delay_set(1, 1)
    client.connect("127.0.0.1", broker.port)
    client.loop_start()
    wait(client.is_connected)
    yield client
    client.disconnect()
    client.loop_stop()


def source(broker: Broker, lines: list[str], **more: object) -> Mqtt:
    settings = {"type": "mqtt", "host": "127.0.0.1", "port": broker.port}
    settings |= {"topic": "plant/{asset}/samples", "client_id": "watch", **more}
    return Mqtt(MqttSource.model_validate(settings), CHANNELS, lines.append)


def message(number: int) -> bytes:
    values = {"heater": 1, "T1": number / 8}
    return json.dumps({"time_ns": number * SECOND, "values": values}).encode()


def publish(client: paho.Client, asset: str, payload: bytes, qos: int = 1) -> None:
    client.publish(f"plant/{asset}/samples", payload, qos)


def test_samples_come_by_topic_and_those_sent_meanwhile_are_kept(broker, publisher) -> None:
    lines: list[str] = []
    gate = CollectingGate()
    with running(source(broker, lines), gate):
        wait(lambda: bool(lines))
        for number in range(20):
            publish(publisher, f"line{1 + number % 2}", message(number), qos=number % 3 > 0)
        wait(lambda: len(gate.times("line1")) + len(gate.times("line2")) == 20, lines)
    assert gate.times("line2") == [number * SECOND for number in range(1, 20, 2)]
    assert gate.values("line1").tolist() == [[1.0, number / 8] for number in range(0, 20, 2)]
    for number in range(20, 30):  # the monitor is away
        publish(publisher, "line1", message(number))
    with running(source(broker, lines), gate):
        wait(lambda: 29 * SECOND in gate.held["line1"], lines)
    assert gate.order["line1"] == sorted(gate.order["line1"])
    assert lines == ["mqtt 127.0.0.1: connected"] * 2


def test_what_is_malformed_is_counted_and_stops_nothing(broker, publisher) -> None:
    lines: list[str] = []
    gate = CollectingGate()
    own = source(broker, lines)
    hostile = [b"", b"\xff\xfe", b"[" * 10_000, b'{"time_ns": "x"}', b"null", b"\x1b[2J" * 9, b"{}"]
    with running(own, gate):
        wait(lambda: bool(lines))
        for payload in hostile:
            publish(publisher, "line1", payload)
        publish(publisher, "nobody", message(1))
        publish(publisher, "line1", b" " * 2**21)  # larger than the broker may send
        publish(publisher, "line1", message(7))
        wait(lambda: gate.times("line1") == [7 * SECOND], lines)
    assert own.refused == len(hostile) + 1
    assert len(lines) == 2, "one line for all of them"
    with running(source(broker, lines), gate):  # acknowledged: they do not come again
        publish(publisher, "line1", message(8))
        wait(lambda: 8 * SECOND in gate.held["line1"] and len(lines) == 3, lines)


@pytest.mark.slow
def test_messages_are_acknowledged_when_they_are_stored(broker, publisher, monkeypatch) -> None:
    monkeypatch.setattr("retwin.monitor.sources.source.AGAIN", 0.1)
    lines: list[str] = []
    gate = CollectingGate(failing=10**9)
    with running(source(broker, lines), gate):
        wait(lambda: bool(lines))
        for number in range(5):
            publish(publisher, "line1", message(number))
        wait(lambda: any("not stored" in line for line in lines), lines)
    assert not gate.held
    gate.failing = 3
    with running(source(broker, lines), gate):  # after a crash, say
        wait(lambda: len(gate.times("line1")) == 5, lines)
        assert any("stored again" in line for line in lines)


@pytest.mark.slow
def test_a_user_and_a_password_from_the_environment(tmp_path, monkeypatch) -> None:
    words = tmp_path / "words"
    words.write_text(PASSWORD)
    words.chmod(0o644)
    broker = Broker(tmp_path / "broker", "allow_anonymous false", f"password_file {words}").start()
    try:
        monkeypatch.setenv("WATCH_PASSWORD", "secret")
        for user, expected in (("watch", "connected"), ("other", "lost (Not authorized)")):
            lines: list[str] = []
            own = source(broker, lines, user=user, password_env="WATCH_PASSWORD")
            with running(own, CollectingGate()):
                wait(lambda lines=lines: bool(lines))
            assert expected in lines[0]
    finally:
        broker.stop()
    monkeypatch.delenv("WATCH_PASSWORD")
    with pytest.raises(InputError, match="WATCH_PASSWORD"):
        source(broker, [], user="watch", password_env="WATCH_PASSWORD")


@pytest.mark.slow
# paho leaves the socket of a failed handshake to the collector of garbage.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_encrypted_connection_to_the_broker_that_is_trusted(tmp_path) -> None:
    authority, other = Authority(tmp_path), tmp_path / "other"
    other.mkdir()
    Authority(other)
    cert, key = authority.certify("broker", "urn:tests:broker")
    own = dict(
        zip(("cert_file", "key_file"), authority.certify("watch", "urn:tests:watch"), strict=False)
    )
    tls = [f"cafile {tmp_path / 'ca.pem'}", f"certfile {cert}", f"keyfile {key}"]
    tls += ["require_certificate true", "allow_anonymous true"]
    broker = Broker(tmp_path / "broker", *tls).start()
    trusted = {"tls": True, "ca_file": tmp_path / "ca.pem"}
    try:
        for more, expected in (
            (trusted | own, "connected"),
            (trusted, "lost"),
            (trusted | own | {"ca_file": other / "ca.pem"}, "lost"),
            ({}, "lost"),
        ):
            lines: list[str] = []
            with running(source(broker, lines, **more), CollectingGate()):
                wait(lambda lines=lines: bool(lines))
            assert expected in lines[0], more
    finally:
        broker.stop()
        gc.collect()
    with pytest.raises(InputError, match="PEM"):
        source(broker, [], tls=True, ca_file=tmp_path / "none.pem")


@pytest.mark.parametrize(
    "away",
    [pytest.param(15.0, marks=pytest.mark.slow), pytest.param(600.0, marks=pytest.mark.long)],
)
def test_a_broker_that_is_away(away: float, broker, publisher) -> None:
    """Machines publish on, at least once; nothing is lost, and the source is back in time."""
    lines: list[str] = []
    gate = CollectingGate()
    ended = threading.Event()
    published: list[int] = []

    def stream() -> None:
        while not ended.wait(0.05):
            publish(publisher, "line1", message(len(published)))
            published.append(len(published))

    thread = threading.Thread(target=stream, daemon=True)
    with running(source(broker, lines), gate):
        wait(lambda: bool(lines))
        thread.start()
        wait(lambda: len(gate.times("line1")) > 20, lines)
        broker.stop()
        wait(lambda: any("lost" in line for line in lines))
        time.sleep(away)
        broker.start()
        back = wait(lambda: any("back" in line for line in lines), lines)
        wait(lambda: len(gate.times("line1")) > published[-1] - 20, lines)
        ended.set()
        thread.join()
        wait(lambda: len(gate.times("line1")) == len(published), lines)
    assert back <= 10
    assert [line.split(": ")[1].split(" (")[0] for line in lines] == ["connected", "lost", "back"]
