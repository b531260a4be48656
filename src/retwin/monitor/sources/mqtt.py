"""Samples from an MQTT broker, which keeps them until they are stored."""

from __future__ import annotations

import queue
import ssl
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from retwin.checks import needs_extra, one_of
from retwin.errors import InputError
from retwin.monitor.live.gate import Gate
from retwin.monitor.settings import MqttSource, secret
from retwin.monitor.sources.source import Source
from retwin.monitor.store.samples import Samples, Trajectory, parse
from retwin.serialisation.files import refusing

RETRY = 1, 4
"""Seconds between attempts to connect, which double from the first to the second."""
LARGEST = 2**20
"""Bytes of a message at most; the broker keeps larger ones to itself."""


@dataclass(frozen=True)
class _Message:
    """A message: its number in a connection, its quality of service, what the gate was given."""

    connection: int
    number: int
    quality: int
    parts: list[tuple[Samples | Trajectory, Future]]


class Mqtt(Source):
    """The topics of machines at a broker.

    Messages have quality of service 1 and are acknowledged in their order, each after its samples
    are durable. What the broker then did not hear of, it sends again; samples that were stored
    already are recognised. A message that holds no samples is acknowledged and counted.

    Parameters
    ----------
    settings : MqttSource
        The broker and the topic.
    channels : mapping of str to sequence of str
        The channels of each machine.
    report : callable
        Takes a line about an event.

    """

    def __init__(
        self,
        settings: MqttSource,
        channels: Mapping[str, Sequence[str]],
        report: Callable[[str], None],
    ) -> None:
        self._paho: Any = needs_extra("paho.mqtt.client", "monitor", "speaks to MQTT brokers")
        super().__init__(f"mqtt {settings.host}", report)
        self._settings = settings
        self._channels = channels
        self._before, self._after = settings.topic.split("{asset}")
        self._password = secret("password of the broker", settings.password_env)
        self._tls = _encryption(settings) if settings.tls else None
        self._connection = 0
        """Number of the connection: an acknowledgement counts in its own one alone."""
        self._waiting: queue.Queue[_Message] = queue.Queue()

    def run(self, gate: Gate, stop: threading.Event) -> None:
        """Take messages from the broker until `stop` is set."""
        client = self._client(gate)
        client.loop_start()
        try:
            while not stop.is_set():
                with suppress(queue.Empty):
                    self._finish(self._waiting.get(timeout=0.2), client, gate, stop)
            for _ in range(self._waiting.qsize()):
                self._finish(self._waiting.get(), client, gate, stop)
        finally:
            client.on_disconnect = None
            client.disconnect()
            client.loop_stop()

    def _finish(self, message: _Message, client: Any, gate: Gate, stop: threading.Event) -> None:
        """Acknowledge a message when its samples are durable; one that came again is so twice."""
        done = [self.stored(gate, each, stop, future) for each, future in message.parts]
        if all(done) and message.quality == 1 and message.connection == self._connection:
            client.ack(message.number, 1)

    def _client(self, gate: Gate) -> Any:
        own, paho = self._settings, self._paho
        properties = needs_extra("paho.mqtt.properties", "monitor", "speaks to MQTT brokers")
        packets = needs_extra("paho.mqtt.packettypes", "monitor", "speaks to MQTT brokers")
        client = paho.Client(
            paho.CallbackAPIVersion.VERSION2, own.client_id, protocol=paho.MQTTv5, manual_ack=True
        )
        if own.user is not None or self._password is not None:
            client.username_pw_set(own.user or "", self._password)
        if self._tls is not None:
            client.tls_set_context(self._tls)
        client.reconnect_delay_set(*RETRY)
        client.on_connect = self._on_connect
        client.on_subscribe = self._on_subscribe
        client.on_connect_fail = lambda *_: self.lost("no connection")
        client.on_disconnect = self._on_disconnect
        client.on_message = lambda _client, _data, message: self._on_message(gate, message)
        asked = properties.Properties(packets.PacketTypes.CONNECT)
        asked.SessionExpiryInterval = own.keep
        # Messages that the broker sends before the first of them is acknowledged, at most.
        asked.ReceiveMaximum = 100
        asked.MaximumPacketSize = LARGEST
        port = own.port or (8883 if own.tls else 1883)
        # Seconds without a word from the broker after which it is asked whether it is there.
        client.connect_async(own.host, port, 10, clean_start=False, properties=asked)
        return client

    def _on_connect(self, client: Any, _data: Any, _flags: Any, code: Any, _: Any) -> None:
        if code.is_failure:
            self.lost(code)
            return
        self._connection += 1
        # Not what the broker retains, which is older than what it keeps for this client.
        options = self._paho.SubscribeOptions(qos=1, retainHandling=2)
        client.subscribe(self._before + "+" + self._after, options=options)

    def _on_subscribe(self, _client: Any, _data: Any, _id: Any, codes: Any, _: Any) -> None:
        if any(code.is_failure for code in codes):
            return self.lost(f"the subscription was refused: {codes[0]}")
        return self.back()

    def _on_disconnect(self, _client: Any, _data: Any, _flags: Any, code: Any, _: Any) -> None:
        self._connection += 1
        self.lost(code)

    def _known(self, asset: str) -> Sequence[str]:
        """The channels of a machine; InputError if it is none of them."""
        return self._channels[one_of("asset", asset, self._channels)]

    def _on_message(self, gate: Gate, message: Any) -> None:
        """Give the samples of a message to the gate; what holds none is acknowledged alike."""
        try:
            asset = message.topic.removeprefix(self._before).removesuffix(self._after)
            found = parse(message.payload, self._known, asset)
        except Exception as error:  # an exception here would end the thread of the client
            self.refuse(error if isinstance(error, InputError) else repr(error))
            found = []
        parts = [(each, gate.send(each)) for each in found]
        self._waiting.put(_Message(self._connection, message.mid, message.qos, parts))


def _encryption(settings: MqttSource) -> ssl.SSLContext:
    """Which brokers are trusted, and who the monitor is; InputError if a file cannot be used."""
    remedy = "give the files that the broker's administrator made"
    with refusing("sources.ca_file", expected="certificates and a key as PEM files", remedy=remedy):
        made = ssl.create_default_context(cafile=settings.ca_file)
        if settings.cert_file is not None:
            made.load_cert_chain(settings.cert_file, settings.key_file)
        return made
