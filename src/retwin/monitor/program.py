"""The monitor beside running machines, as a monitor.toml describes it, until it is stopped."""

from __future__ import annotations

import os
import secrets
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from typing import Any

from retwin import cases
from retwin.cases.case import Case
from retwin.checks import require
from retwin.data.logs.mapping import read_mapping
from retwin.errors import InputError
from retwin.monitor.live.explanations import Explanations
from retwin.monitor.live.gate import Gate
from retwin.monitor.live.live import Live
from retwin.monitor.live.notifications import Notifications, Receiver, sentence
from retwin.monitor.models.kinds import AnyMonitor, load_monitor
from retwin.monitor.models.trajectory.monitor import TrajectoryMonitor
from retwin.monitor.server import create_app, listening, serving
from retwin.monitor.server.app import check_token
from retwin.monitor.settings import (
    TOKEN,
    FolderSource,
    MonitorSettings,
    MqttSource,
    TwinSettings,
    secret,
)
from retwin.monitor.sources.folder import Folder, Recorded, TrajectoryFolder
from retwin.monitor.sources.mqtt import Mqtt
from retwin.monitor.sources.opcua import OpcUa
from retwin.monitor.sources.source import Source
from retwin.monitor.sources.tables import Layout, layout_of, mapped_layout
from retwin.monitor.store.store import Store
from retwin.monitor.versions.registry import Registry
from retwin.serialisation.files import sha256


def run(settings: MonitorSettings, report: Callable[[str], None], stop: threading.Event) -> None:
    """Watch the machines until `stop` is set; what was acknowledged is durable then.

    The monitor of a twin without versions is proposed and promoted. If it differs from all versions
    there are, it is proposed, and that is reported.

    Parameters
    ----------
    settings : MonitorSettings
        Machines, twins and sources.
    report : callable
        Takes a line about each alarm, cause, change of the promise, event, and lost source.
    stop : Event
        Ends it.

    Raises
    ------
    InputError
        A monitor cannot be read, a source does not suit it, the store cannot be opened, the port is
        in use, a secret is missing, or a package of an extra.

    """
    with ExitStack() as opened:
        page = settings.server
        shared = page and secret("token", page.token_env, page.token_file)
        shared = shared or os.environ.get(TOKEN)
        # Without one, nobody has the token of this start.
        token = check_token(shared) if shared else secrets.token_urlsafe()
        bound = page and opened.enter_context(listening(page.host, page.port))
        for twin in settings.twins.values():
            load_monitor(twin.monitor)
        store = Store(settings.store, settings.url, max_samples=settings.max_samples)
        opened.enter_context(store)
        for name, twin in settings.twins.items():
            _offer(Registry(store, name), twin, report)
        live = Live(store, wait=settings.wait, ahead=settings.ahead)
        for name, asset in settings.assets.items():
            limits = settings.twins[asset.twin].limits
            live.add(name, asset.twin, {"limits": limits} if limits else None)
        news = _News(store, report)
        opened.callback(news.read)
        twins = {each.twin: live.monitor(name) for name, each in settings.assets.items()}
        known = {name: _case(settings.twins[name], each) for name, each in twins.items()}
        systems = {name: known[each.twin] for name, each in settings.assets.items()}
        faults = {name: each.alarm_causes for name, each in known.items() if each}
        explanations = opened.enter_context(Explanations(live, faults.get))
        receivers = [Receiver.of(name, each) for name, each in settings.notify.items()]
        opened.enter_context(Notifications(store, receivers, report))
        gate = opened.enter_context(Gate(live))
        made = [_sources(each, live, systems, report) for each in settings.sources]
        sources = [source for each in made for source in each]
        if page and bound:
            app = create_app(
                live,
                gate,
                token=token,
                hosts=page.hosts,
                explanations=explanations,
                sources={each.name: partial(getattr, each, "connected") for each in sources},
            )
            opened.enter_context(serving(app, bound))
            host, port = bound.getsockname()[:2]
            only = "" if shared else f" (read only, since the variable {TOKEN} holds no token)"
            report(f"page: http://{f'[{host}]' if ':' in host else host}:{port}/{only}")
        for each in sources:
            thread = threading.Thread(target=each.keep_running, args=(gate, stop), name=each.name)
            thread.start()
            opened.callback(thread.join)
        opened.callback(stop.set)
        report(f"watching {', '.join(settings.assets)}")
        # Seconds after which new entries of the log are reported.
        while not stop.wait(0.5):
            news.read()


class _News:
    """Reports the entries that are new in the log."""

    def __init__(self, store: Store, report: Callable[[str], None]) -> None:
        self._store, self._report, self._failed = store, report, False
        self._last = last.sequence if (last := store.last) else -1

    def read(self) -> None:
        """Report them; a store that cannot be read is reported once, and read again later."""
        try:
            for entry in self._store.log(after=self._last):
                if line := sentence(entry):
                    self._report(line)
                self._last = entry.sequence
        except InputError as error:
            if not self._failed:
                self._report(str(error))
            self._failed = True
        else:
            self._failed = False


def _offer(registry: Registry, twin: TwinSettings, report: Callable[[str], None]) -> None:
    """Make the monitor of a twin its first version, or propose it if it is a new one."""
    folder, versions = twin.monitor.resolve(), registry.versions()
    if sha256(folder) not in [each.digest for each in versions]:
        made = registry.propose(folder, f"the folder {twin.monitor.name} at the start")
        if active := registry.active:
            report(
                f"twin {registry.twin}: {twin.monitor} has changed and is version {made.number} "
                f"now, which is only proposed; version {active.number} watches"
            )
    if registry.active is None:  # also where an earlier first start was cut off before this
        number = {each.digest: each.number for each in registry.versions()}[sha256(folder)]
        registry.promote(number)
        report(f"twin {registry.twin}: {twin.monitor} is version {number}")


def _sources(
    settings: Any, live: Live, systems: Mapping[str, Case | None], report: Callable[[str], None]
) -> list[Source]:
    """What reads a source: of a folder, one for samples, one for trajectories, or both.

    `systems` are the cases of all machines.
    """
    channels = {name: live.channels(name) for name in systems}
    if isinstance(settings, MqttSource):
        return [Mqtt(settings, channels, report)]
    if isinstance(settings, FolderSource):
        return _folders(settings, live, systems, report)
    for name in settings.nodes:
        single = not live.in_trajectories(name)
        expected = f"one that gives complete trajectories, for {name}"
        got = f"one of single samples, {settings.type}"
        remedy = "send trajectories by MQTT or HTTP, or write them to a folder"
        require(single, "sources", expected=expected, got=got, remedy=remedy)
    rates = {name: live.monitor(name).twin.rate for name in systems}
    return [OpcUa(settings, channels, rates, report)]


def _folders(
    settings: FolderSource,
    live: Live,
    systems: Mapping[str, Case | None],
    report: Callable[[str], None],
) -> list[Source]:
    newest = {each.asset: each.time for each in live.status() if each.time is not None}
    mapping = None if settings.mapping is None else read_mapping(settings.mapping)
    layouts: dict[str, Layout] = {}
    recorded: dict[str, Recorded] = {}
    for name in [settings.asset] if settings.asset else systems:
        monitor, case = live.monitor(name), systems[name]
        if isinstance(monitor, TrajectoryMonitor):
            recorded[name] = monitor, case
        else:
            tabular = settings.files.endswith((".csv", ".parquet"))
            expected = f"files that end with .csv or .parquet, for {name}"
            remedy = "give tables of samples, since its monitor watches no whole trajectories"
            require(tabular, "sources.files", expected=expected, got=settings.files, remedy=remedy)
            twin = monitor.twin
            layouts[name] = (
                layout_of(settings, live.channels(name), case)
                if mapping is None
                else mapped_layout(mapping, twin.inputs, twin.outputs, twin.rate, case)
            )
    made: list[Source] = []
    if layouts:
        made.append(Folder(settings, layouts, newest, report))
    if recorded:
        made.append(TrajectoryFolder(settings, recorded, newest, report))
    return made


def _case(twin: TwinSettings, monitor: AnyMonitor) -> Case | None:
    name = twin.case or getattr(monitor.twin, "case", None)
    return cases.get(name) if name else None
