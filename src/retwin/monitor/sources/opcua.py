"""Samples from a subscription to nodes of an OPC UA server."""

from __future__ import annotations

import asyncio
import bisect
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import existing, needs_extra, require, same_names
from retwin.data.logs.signals import nanoseconds
from retwin.errors import InputError, brief
from retwin.monitor.live.gate import Gate
from retwin.monitor.settings import OpcUaSource, secret
from retwin.monitor.sources.source import AGAIN, Source
from retwin.monitor.store.samples import Samples
from retwin.serialisation.files import refusing


@dataclass
class _Group:
    """Values of one moment: its time in ns, when its first one arrived in s, and each channel's."""

    time: int
    arrived: float
    values: dict[int, float] = field(default_factory=dict)


class Assembly:
    """Puts values whose times differ by less than half a sample period together.

    A channel that reports changes alone keeps its value until the next one, and the first samples
    wait until each channel has one. A value that arrives after the sample of its time was taken
    makes another one of that time.

    Parameters
    ----------
    channels : int
        Number of channels.
    period : float
        Sample period in s.
    settle : float
        Time in s for which a sample waits for channels that may not have changed.

    """

    def __init__(self, channels: int, period: float, settle: float) -> None:
        self._near = round(period * 0.5e9)
        self._settle = settle
        self._held: list[float | None] = [None] * channels
        self._reached = [-(2**63)] * channels
        self._groups: list[_Group] = []

    def hold(self, channel: int, value: float) -> None:
        """Take the present value of a channel, which is from before the samples."""
        self._held[channel] = value

    def add(self, channel: int, time: int, value: float, now: float) -> None:
        """Take a value at a time in ns, NaN if it is missing, which arrived at `now` in s."""
        self._reached[channel] = max(self._reached[channel], time)
        for group in reversed(self._groups):
            if abs(group.time - time) < self._near and channel not in group.values:
                group.values[channel] = value
                return
        group = _Group(time, now, {channel: value})
        bisect.insort(self._groups, group, key=lambda each: each.time)

    def take(self, now: float) -> tuple[NDArray, NDArray]:
        """Times (n,) in ns and values (n, channels) of the samples that are complete."""
        times, rows = [], []
        while self._groups:
            group = self._groups[0]
            complete = min(self._reached) > group.time - self._near
            if not complete and now - group.arrived < self._settle:
                break
            self._groups.pop(0)
            for channel, value in group.values.items():
                self._held[channel] = value
            row = [each for each in self._held if each is not None]
            if len(row) == len(self._held):
                times.append(group.time)
                rows.append(row)
        values = np.array(rows, dtype=float).reshape(len(rows), len(self._held))
        return np.array(times, dtype=np.int64), values


TIMEOUT = 4.0
"""Seconds in which the server must answer."""
FILES = "give the files that the server's administrator made"
"""What to do where one cannot be used."""


class OpcUa(Source):
    """The nodes of machines at a server.

    Each value has the time at which its source took it, and values of one moment make a sample. A
    node that did not change keeps its value; one with a bad status is missing. What was sent while
    the connection was lost is asked for again, where the server still has it.

    Parameters
    ----------
    settings : OpcUaSource
        The server and its nodes.
    channels : mapping of str to sequence of str
        The channels of each machine.
    rates : mapping of str to float
        The sample rate of each machine, in Hz.
    report : callable
        Takes a line about an event.

    Raises
    ------
    InputError
        A machine has not one node for each channel, or an address of a node is none.

    """

    def __init__(
        self,
        settings: OpcUaSource,
        channels: Mapping[str, Sequence[str]],
        rates: Mapping[str, float],
        report: Callable[[str], None],
    ) -> None:
        self._asyncua: Any = needs_extra("asyncua", "monitor", "speaks to OPC UA servers")
        super().__init__(f"opcua {settings.url}", report)
        # Its warnings would be lines besides those that are reported.
        logging.getLogger("asyncua").setLevel(logging.CRITICAL)
        self._settings = settings
        for name in ("cert_file", "key_file", "server_file"):
            file = getattr(settings, name)
            there = file is None or file.is_file()
            existing(f"sources.{name}", file, there, "a file", remedy=FILES)
        self._password = secret("password of the server", settings.password_env)
        shortest = min(1 / rates[asset] for asset in settings.nodes)
        # Seconds between two publications, at most.
        self._interval = settings.interval or min(shortest / 2, 1.0)
        self._used: dict[Any, list[tuple[str, int]]] = {}
        """By node, the machines that it belongs to, with the number of the channel."""
        self._assemblies: dict[str, Assembly] = {}
        self._subscription: Any = None
        self._ready = False
        self._begun: dict[Any, Any] = {}
        """By node, the number of the subscription that has sent its present value."""
        for asset, nodes in settings.nodes.items():
            where, remedy = f"sources.nodes.{asset}", 'write for each channel NAME = "ns=2;s=NODE"'
            same_names(where, nodes, channels[asset], "a node for each of", remedy=remedy)
            for name, text in nodes.items():
                place = (asset, list(channels[asset]).index(name))
                self._used.setdefault(self._node(text), []).append(place)
            # Intervals of publication for which a sample waits for channels that may not have
            # changed.
            period, settle = 1 / rates[asset], 1.5 * self._interval
            self._assemblies[asset] = Assembly(len(nodes), period, settle)

    def run(self, gate: Gate, stop: threading.Event) -> None:
        """Take values from the server until `stop` is set."""
        asyncio.run(self._run(gate, stop))

    async def _run(self, gate: Gate, stop: threading.Event) -> None:
        failures = (OSError, asyncio.TimeoutError, self._asyncua.ua.UaError, InputError)
        while not stop.is_set():
            try:
                await self._subscribed(gate, stop)
            except failures as error:
                self.lost(brief(error))
            await asyncio.to_thread(stop.wait, AGAIN)

    async def _subscribed(self, gate: Gate, stop: threading.Event) -> None:
        """Subscribe, and send samples until `stop` is set."""
        self._ready = False
        client = await self._client()
        async with client:
            # The handler is this object: `datachange_notification` is called.
            subscription = await client.create_subscription(1000 * self._interval, self)
            self._subscription = subscription
            results = await subscription.create_monitored_items(self._items(subscription))
            for node, result in zip(self._used, results, strict=True):
                there = not isinstance(result, self._asyncua.ua.StatusCode)
                expected = "a node of the server"
                remedy = "correct its address in the source"
                require(there, str(node), expected=expected, got=str(result), remedy=remedy)
            self._ready = True
            self.back()
            while not stop.is_set():
                await asyncio.sleep(min(self._interval / 4, 0.1))
                now = time.monotonic()
                found = [
                    Samples(asset, *each.take(now)) for asset, each in self._assemblies.items()
                ]
                sent = [(each, gate.send(each)) for each in found if len(each.times)]
                for samples, future in sent:
                    await asyncio.to_thread(self.stored, gate, samples, stop, future)

    async def _client(self) -> Any:
        own = self._settings
        client = self._asyncua.Client(
            own.url, TIMEOUT, auto_reconnect=True, reconnect_max_delay=2 * AGAIN
        )
        client.connection_lost_callback = self._on_lost
        if own.user is not None:
            client.set_user(own.user)
        if self._password is not None:
            client.set_password(self._password)
        if own.security is not None:
            await self._secure(client)
        return client

    async def _secure(self, client: Any) -> None:
        """Sign and encrypt, as the application that the certificate names."""
        own, purpose = self._settings, "encrypts messages to OPC UA servers"
        tools = needs_extra("asyncua.crypto.uacrypto", "monitor", purpose)
        policies = needs_extra("asyncua.crypto.security_policies", "monitor", purpose)
        x509 = needs_extra("cryptography.x509", "monitor", purpose)
        expected = "a certificate with the URI of the application, and its key, as PEM files"
        with refusing("sources.cert_file", expected=expected, remedy=FILES):
            names = (await tools.load_certificate(own.cert_file)).extensions
            found = names.get_extension_for_class(x509.SubjectAlternativeName).value
            # A server compares it with the certificate.
            client.application_uri = found.get_values_for_type(x509.UniformResourceIdentifier)[0]
            await tools.load_private_key(own.key_file)
            server = own.server_file and tools.CertProperties(own.server_file)
            if own.server_file:
                await tools.load_certificate(own.server_file)
        policy = getattr(policies, f"SecurityPolicy{own.security}")
        await client.set_security(policy, own.cert_file, own.key_file, None, server)

    async def _on_lost(self, error: Exception) -> None:
        self.lost(brief(error))

    def _node(self, text: str) -> Any:
        expected = 'addresses of nodes, "ns=2;s=NAME" or "ns=2;i=NUMBER"'
        remedy = "take them from a browser of the server"
        with refusing(f"sources.nodes: {text!r}", expected=expected, remedy=remedy):
            return self._asyncua.ua.NodeId.from_string(text)

    def _items(self, subscription: Any, *, queue: int = 1000) -> list[Any]:
        """What the server is asked for: each new value or time of each node.

        Parameters
        ----------
        queue : int, default 1000
            Values of a node that the server keeps while the connection is lost.

        """
        ua = self._asyncua.ua
        items = []
        for handle, node in enumerate(self._used, 1):
            asked = ua.MonitoredItemCreateRequest()
            asked.ItemToMonitor = ua.ReadValueId(NodeId=node, AttributeId=ua.AttributeIds.Value)
            asked.MonitoringMode = ua.MonitoringMode.Reporting
            asked.RequestedParameters = ua.MonitoringParameters(
                ClientHandle=handle,
                SamplingInterval=1000 * self._interval,
                Filter=ua.DataChangeFilter(Trigger=ua.DataChangeTrigger.StatusValueTimestamp),
                QueueSize=queue,
                DiscardOldest=True,
            )
            items.append(asked)
        return items

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        """Take a value of a node."""
        if self._ready:
            self.back()
        given = data.monitored_item.Value
        stamp = given.SourceTimestamp or given.ServerTimestamp
        at = 0 if stamp is None else nanoseconds(stamp)
        if at <= 0:
            return self.refuse(f"a value of {node} without a time")
        found = float("nan")
        if not given.StatusCode.is_bad():
            if isinstance(value, bool | int | float):
                found = float(value)
            elif value is not None:
                self.refuse(f"a value of {node} that is no number")
        # A subscription begins with the present values, however old they are.
        number = self._subscription.subscription_id
        present = self._begun.get(node.nodeid) != number
        self._begun[node.nodeid] = number
        for asset, channel in self._used[node.nodeid]:
            if present:
                self._assemblies[asset].hold(channel, found)
            else:
                self._assemblies[asset].add(channel, at, found, time.monotonic())
        return None
