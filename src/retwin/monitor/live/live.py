"""`Live`: watches all machines of a store as their samples arrive, and stores what it finds."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import groupby
from typing import Any

import numpy as np

from retwin.checks import finite, given, instance, require, whole
from retwin.monitor.live.machine import AssetStatus, Counts, Received, Recent
from retwin.monitor.live.stream_machine import StreamMachine, Work, step
from retwin.monitor.live.trajectory_machine import TrajectoryMachine
from retwin.monitor.models.kinds import AnyMonitor, load_monitor
from retwin.monitor.models.monitor import Monitor
from retwin.monitor.models.state import Layout
from retwin.monitor.models.trajectory.monitor import TrajectoryMonitor
from retwin.monitor.store.audit import Entry
from retwin.monitor.store.gridded import Limits
from retwin.monitor.store.samples import LATEST, SECOND, Asset, Samples, Trajectory, one_asset
from retwin.monitor.store.store import Store
from retwin.monitor.versions.registry import Registry

WHY = {
    "late": "it begins before the newest one ends",
    "unknown": "a command of its first sample is missing",
    "refused": "single samples are none; send arrays of values",
}
"""Why a trajectory is not used, where that is an event of the log."""


class Live:
    """Watches all assets of a store that have a twin; thread-safe.

    The settings of such an asset hold `twin`, the name of a `Registry` whose versions are monitors.
    Assets are added by `Live.add`, or by `Store.add_asset` before.

    Parameters
    ----------
    store : Store
        Opened to write.
    wait : float, optional
        Time in s, at most 60, for which a place in a stream without a sample is waited for; by
        default two sample periods. A stream in order is never delayed.
    ahead : float
        How far in s a sample may be ahead of the clock of this computer; a later one is refused.
    clock : callable
        Gives the time in nanoseconds since the epoch.

    Raises
    ------
    InputError
        A setting out of range, or an asset whose twin has no active version.

    """

    def __init__(
        self,
        store: Store,
        *,
        wait: float | None = None,
        ahead: float = 60.0,
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self.store = instance("store", store, Store, remedy="open one with Store(folder)")
        if wait is not None:
            # Seconds for which a place without a sample is waited for at most.
            finite("wait", wait, at_least=0.0, at_most=60.0, unit="s")
        self._wait = wait
        self._ahead = finite("ahead", ahead, at_least=0.0, at_most=LATEST / SECOND, unit="s")
        self._clock = clock
        self._lock = threading.RLock()
        self._diagnosing = threading.Lock()
        """Held while a trajectory is diagnosed, which takes long, taken before the other lock."""
        self._monitors: dict[tuple[str, int], tuple[AnyMonitor, str]] = {}
        self._layouts: dict[str, Layout] = {}
        self._machines: dict[str, StreamMachine | TrajectoryMachine] = {}
        self._unsure: set[str] = set()
        """Machines that must be read from the store again: a commit of theirs failed."""
        self._listeners: list[Callable[[list[Entry]], None]] = []
        self.revision = 0
        """Grows whenever something has changed."""
        self.refresh()

    def add(self, name: str, twin: str, settings: Mapping[str, Any] | None = None) -> None:
        """Watch a machine by the active version of a twin; one that is watched so stays as it is.

        Parameters
        ----------
        name, twin : str
            Names of the machine and of its twin.
        settings : mapping, optional
            JSON values that are kept; of these, `limits` are the smallest and the largest possible
            value of channels, by their names. Another value is logged, and not used.

        Raises
        ------
        InputError
            The twin has no active version, the machine has other channels, or limits are those of
            another channel, or of a machine that is watched trajectory by trajectory.

        """
        with self._lock:
            version = self._active(twin)
            monitor, _ = self._monitor(twin, version)
            channels = len(monitor.twin.inputs) + len(monitor.twin.outputs)
            if limits := (settings or {}).get("limits", {}):
                Limits.of(monitor.twin, limits)
                remedy = "leave out its limits: implausible trajectories are found without them"
                instance("limits", monitor, Monitor, remedy=remedy)
            asset = Asset(name, channels, {**(settings or {}), "twin": twin}, version)
            known = {each.name: each for each in self.store.assets()}.get(name)
            if asset != known:
                self.store.add_asset(asset)
            self.refresh()
            before = known.settings.get("twin") if known else None
            if before not in (None, twin):
                self.log([self._describe_change(asset, f"the twin {twin}", before)])

    def refresh(self) -> None:
        """Read assets and active versions again: after a version was promoted or rolled back.

        A machine whose version has changed begins anew with its next sample.
        """
        with self._lock:
            active: dict[str, int] = {}
            machines, entries = {}, []
            for asset in self.store.assets():
                twin = asset.settings.get("twin")
                if twin is None:
                    continue
                if twin not in active:
                    active[twin] = self._active(twin)
                if asset.version != active[twin]:
                    now, before = f"version {active[twin]}", asset.version
                    entries.append(self._describe_change(asset, now, before))
                    asset = replace(asset, version=active[twin])
                    self.store.add_asset(asset)
                known = self._machines.get(asset.name)
                same = known is not None and known.asset == asset
                machines[asset.name] = known if known and same else self._machine(asset)
            self._machines = machines
            self.log(entries)

    def channels(self, asset: str) -> tuple[str, ...]:
        """Names of the commands and then the outputs of a machine; InputError if it is unknown."""
        twin = self._one(asset).monitor.twin
        return (*twin.inputs.names, *twin.outputs.names)

    def monitor(self, asset: str) -> AnyMonitor:
        """The monitor that watches a machine."""
        return self._one(asset).monitor

    def in_trajectories(self, asset: str) -> bool:
        """Whether a machine is watched trajectory by trajectory."""
        return isinstance(self._machines.get(asset), TrajectoryMachine)

    def submit(self, batch: Sequence[Samples | Trajectory]) -> list[Received]:
        """Use samples and trajectories of any machines, in their order; all is durable on return.

        Samples, states and alarms are stored in one commit; those of a machine that is watched
        trajectory by trajectory in one for each trajectory, which is diagnosed while other calls go
        on. What is found does not depend on how they are grouped into calls.

        Raises
        ------
        InputError
            An unknown machine, another number of channels, or the store fails: nothing of the
            batch was acknowledged, and it may be sent again.

        """
        for each in batch:
            width = self._one(each.asset).asset.channels
            fits = each.values.ndim == 2 and each.values.shape[1] == width
            expected = f"{width} channels"
            got = each.values.shape[-1]
            remedy = "give commands and then outputs, see Live.channels"
            require(fits, f"samples of {each.asset}", expected=expected, got=got, remedy=remedy)
        found: list[Received] = []
        for whole_, group in groupby(batch, lambda each: self.in_trajectories(each.asset)):
            if whole_:
                found += [self._diagnosed(each) for each in group]
            else:
                found += self._sampled([self._samples(each) for each in group])
        return found

    def status(self) -> list[AssetStatus]:
        """All machines, those with most evidence for a change first."""
        with self._lock:
            made = [AssetStatus.of(each) for each in self._machines.values()]
        return sorted(made, key=lambda each: (-each.void, -each.ratio))

    def recent(self, asset: str) -> Recent:
        """The newest samples of a machine and what was predicted, since the program was started."""
        with self._lock:
            return self._one(asset).recent()

    def listen(self, listener: Callable[[list[Entry]], None]) -> None:
        """Call a function with the new entries of the log after each commit; it must be quick."""
        self._listeners.append(listener)

    def log(self, entries: Sequence[tuple[str, Mapping[str, Any]]]) -> None:
        """Store entries of the log."""
        with self._lock:
            self._announce(self.store.commit(entries=entries).entries)

    def acknowledge(self, sequence: int, who: str, note: str = "") -> None:
        """Log that somebody has seen the alarm with this sequence in the log.

        Raises
        ------
        InputError
            There is no such alarm, or nobody is named.

        """
        remedy = "give a name, which the log keeps"
        require(who.strip(), "who", expected="who has seen it", got=repr(who), remedy=remedy)
        after = whole("sequence", sequence, at_least=0) - 1
        entry = next(iter(self.store.log("alarm", after=after)), None)
        known = entry if entry and entry.sequence == sequence else None
        expected = "that of an alarm in the log"
        given("sequence", known, expected, got=sequence, remedy="see the alarms")
        data = {"alarm": sequence, "who": who, "note": note, "at": self._clock()}
        self.log([("acknowledge", data)])

    def _samples(self, given: Samples | Trajectory) -> Samples:
        """A trajectory of a machine that is watched sample by sample is its samples."""
        if isinstance(given, Samples):
            return given
        return given.samples(self._one(given.asset).monitor.twin.rate)

    def _diagnosed(self, given: Samples | Trajectory) -> Received:
        """Use one trajectory."""
        with self._diagnosing:
            while True:
                with self._using(given.asset):
                    machine = self._one(given.asset)
                    assert isinstance(machine, TrajectoryMachine)
                    received = self._unused(machine, given)
                if received is not None:
                    return received
                assert isinstance(given, Trajectory)
                made = machine.diagnose(given)
                with self._using(given.asset):
                    if self._machines.get(given.asset) is not machine:
                        continue  # another version watches since
                    if isinstance(made, str):
                        machine.refuse(given.begin, made)
                        return self._counted(machine, "refused")
                    return self._counted(machine, "used", machine.take(made))

    def _unused(self, machine: TrajectoryMachine, given: Samples | Trajectory) -> Received | None:
        """What became of a trajectory that is not to be diagnosed; None for one that is."""
        begin = given.begin if isinstance(given, Trajectory) else None
        known = () if begin is None else self.store.present(given.asset, np.array([begin]))
        what = machine.placed(given, self._limit(), set(np.array(known).tolist()))
        if what in WHY:
            machine.refuse(begin or self._clock(), WHY[what])
        return None if what == "used" else self._counted(machine, what)

    def _counted(self, machine: TrajectoryMachine, what: str, alarms: int = 0) -> Received:
        """Store what a trajectory changes, and count it."""
        self._commit([machine])
        counts = Counts(**{what: 1})
        machine.counts.add(counts)
        return Received(machine.asset.name, counts, alarms)

    def _commit(self, machines: Sequence[StreamMachine | TrajectoryMachine]) -> None:
        """Store what is new of machines, all or none."""
        updates = [update for each in machines if (update := each.update())]
        entries = [entry for each in machines for entry in each.entries]
        entries.sort(key=lambda each: (each[1]["time"], each[1]["asset"]))
        committed = self.store.commit(updates, entries).entries if updates or entries else []
        for each in machines:
            each.committed()
        self._announce(committed)

    def _limit(self) -> int:
        return self._clock() + round(self._ahead * SECOND)

    @contextmanager
    def _using(self, *assets: str) -> Iterator[None]:
        """Hold the lock; machines are read from the store again after an exception in the block.

        What the store holds is true, but it may not be in reach before the next block.
        """
        with self._lock:
            for name in sorted(self._unsure & self._machines.keys()):
                self._machines[name] = self._machine(self._machines[name].asset)
                self._unsure.discard(name)
            try:
                yield
            except BaseException:
                self._unsure |= set(assets)
                raise

    def _sampled(self, batch: Sequence[Samples]) -> list[Received]:
        """Use samples of machines that are watched sample by sample, in one commit."""
        names = [each.asset for each in batch]
        limit, found, alarms = self._limit(), [], Counter[str]()
        with self._using(*names):
            streams = [each for each in map(self._one, names) if isinstance(each, StreamMachine)]
            for each, machine in zip(batch, streams, strict=True):
                counts = Counts()
                known = set(self.store.present(each.asset, machine.unsure(each.times)).tolist())
                left = machine.accept(each, limit, known, counts)
                while len(left.times):
                    alarms += self._stepped([machine])
                    left = machine.accept(left, limit, known, counts)
                found.append(counts)
            machines = list(dict.fromkeys(streams))
            alarms += self._stepped(machines)
            self._commit(machines)
        last = {each.asset: i for i, each in enumerate(batch)}
        return [
            Received(each.asset, counts, alarms[each.asset] * (last[each.asset] == i))
            for i, (each, counts) in enumerate(zip(batch, found, strict=True))
        ]

    def _stepped(self, machines: Sequence[StreamMachine]) -> Counter[str]:
        """Step the monitors of machines through what is complete; alarms by machine."""
        alarms = Counter[str]()
        while ready := [(each, work) for each in machines if (work := each.next_work())]:
            groups: dict[tuple[int, int], list[tuple[StreamMachine, Work]]] = {}
            for each, work in ready:
                alike = id(each.monitor), len(work.values)
                groups.setdefault(alike, []).append((each, work))
            for together in groups.values():
                alarms.update(step(together))
        return alarms

    def _announce(self, entries: list[Entry]) -> None:
        self.revision += 1
        for listener in self._listeners:
            listener(entries)

    def _one(self, name: str) -> StreamMachine | TrajectoryMachine:
        return one_asset(self._machines, name)

    def _machine(self, asset: Asset) -> StreamMachine | TrajectoryMachine:
        """A machine as the store has it, with the samples that wait for others."""
        assert asset.version is not None
        monitor, digest = self._monitor(asset.settings["twin"], asset.version)
        stored = self.store.state(asset.name)
        if isinstance(monitor, TrajectoryMonitor):
            watched = TrajectoryMachine(asset, monitor, digest)
            if stored is not None:
                watched.restore(*stored)
            return watched
        if digest not in self._layouts:
            self._layouts[digest] = Layout(monitor.start(1), digest)
        machine = StreamMachine(asset, monitor, self._layouts[digest], self._wait)
        if stored is not None and machine.restore(stored[1]):
            for times, values in self.store.samples(asset.name, machine.stepped_time):
                machine.hold(times, values)
        return machine

    def _describe_change(self, asset: Asset, now: str, before: object) -> tuple[str, dict]:
        """The entry of the log about what watches a machine from now on, and what did before."""
        text = f"watched by {now} from the next sample on, before by {before}"
        about = {"asset": asset.name, "time": self._clock(), "what": "version", "text": text}
        return "event", about

    def _active(self, twin: str) -> int:
        active, expected = Registry(self.store, twin).active, f"an active version of {twin}"
        return given("twin", active, expected, remedy="propose and promote one").number

    def _monitor(self, twin: str, version: int) -> tuple[AnyMonitor, str]:
        """A version, and the hash of its files."""
        key = twin, version
        if key not in self._monitors:
            registry = Registry(self.store, twin)
            digest = {each.number: each.digest for each in registry.versions()}[version]
            self._monitors[key] = load_monitor(registry.folder(version)), digest
        return self._monitors[key]
