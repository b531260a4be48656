"""`Explanations`: finds the causes of alarms beside the stream, and logs them."""

from __future__ import annotations

import logging
import queue
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from retwin.checks import at_least
from retwin.data.trajectories import UNKNOWN
from retwin.errors import InputError, brief
from retwin.monitor.live.live import Live
from retwin.monitor.models.cause import (
    BEFORE,
    EVENT,
    CauseSearch,
    cause_data,
    is_due,
    possible_causes,
)
from retwin.monitor.models.monitor import Monitor
from retwin.monitor.models.state import Alarm
from retwin.monitor.store.audit import Entry
from retwin.monitor.store.gridded import gridded, record_of
from retwin.monitor.store.samples import SECOND
from retwin.monitor.versions.registry import Registry
from retwin.twins.faults.actuator_faults import Fault

Faults = Callable[[str], "Mapping[str, Fault | None] | None"]
"""The known faults of a twin by its name; None for any change."""


class _Turns(queue.Queue["list[Entry] | None"]):
    """Alarms that wait, each after those that it is explained with; None ends.

    Machines take turns. Of a machine the newest event is first, and its alarms are in their order,
    since the cause of one depends on those before.
    """

    def _init(self, maxsize: int) -> None:
        self._machines: dict[str, dict[int, deque[list[Entry] | None]]] = {}

    def _qsize(self) -> int:
        return sum(len(each) for events in self._machines.values() for each in events.values())

    def _put(self, item: list[Entry] | None) -> None:
        alarm: Mapping[str, Any] = item[-1].data if item else {"asset": "", "time": 0}
        events = self._machines.setdefault(alarm["asset"], {})
        events.setdefault(_event(alarm), deque()).append(item)

    def _get(self) -> list[Entry] | None:
        name = next(iter(self._machines))
        events = self._machines.pop(name)
        newest = max(events)
        item = events[newest].popleft()
        if not events[newest]:
            del events[newest]
        if events:
            self._machines[name] = events  # behind all others
        return item


class Explanations:
    """A thread that explains alarms from the stored samples before them.

    Machines take turns, and of each machine the newest event is explained first. A context manager
    that ends the thread. What is found is an entry `cause` of the log; of further alarms of an
    event, where one is due (`is_due`), it tells whether the fault is the `same`, see `CauseSearch`.
    Alarms that lack theirs, since the program was stopped, are explained when it is started again.

    Parameters
    ----------
    live : Live
        What raises the alarms.
    faults : callable, optional
        Gives the known faults of a twin by its name (`Case.alarm_causes`), or None; by default any
        change of the machine (`possible_causes`).
    report : callable, optional
        Takes the data of each alarm and of its cause.

    """

    def __init__(
        self,
        live: Live,
        faults: Faults = lambda twin: None,
        report: Callable[[dict[str, Any], dict[str, Any]], None] = lambda alarm, cause: None,
    ) -> None:
        self._live = live
        self._faults = faults
        self._report = report
        self._queue = _Turns()
        self._alarms: dict[str, tuple[list[Entry], Entry | None]] = {}
        """Of each machine the alarms that its event is explained by, and the newest one."""
        self._current: dict[tuple[str, int], tuple[str, float]] = {}
        """Of each machine and event its cause, and the probability that there is more to it."""
        self._closed = threading.Event()
        self._taking = threading.Lock()
        self._last = -1
        explained = {entry.data["alarm"]: entry.data for entry in live.store.log("cause")}
        with self._taking:  # alarms that are raised meanwhile are taken after the earlier ones
            live.listen(self._on_entries)
            self._take(live.store.log("alarm"), explained)
        self._thread = threading.Thread(target=self._run, name="explanations", daemon=True)
        self._thread.start()

    def __enter__(self) -> Explanations:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the thread after the alarm that it explains; once more is no error."""
        self._closed.set()
        self._queue.put(None)
        self._thread.join()
        while not self._queue.empty():  # what is left is explained after the next start
            self._queue.get()
            self._queue.task_done()

    def wait(self) -> None:
        """Return when all alarms so far are explained, or this is closed."""
        self._queue.join()

    def causes(self, twin: str, monitor: Monitor) -> dict[str, Any]:
        """What may cause alarms of a twin."""
        return possible_causes(monitor.twin, self._faults(twin))

    def _on_entries(self, entries: list[Entry]) -> None:
        alarms = [each for each in entries if each.kind == "alarm"]
        if alarms and not self._closed.is_set():
            with self._taking:
                self._take((each for each in alarms if each.sequence > self._last), {})

    def _take(self, alarms: Iterable[Entry], explained: Mapping[int, dict[str, Any]]) -> None:
        """Queue the alarms at which a cause is due, each after those that it is inferred with."""
        for entry in alarms:
            data, asset = entry.data, entry.data["asset"]
            known, newest = self._alarms.get(asset, ([], None))
            if newest and newest.data.get("version") != data.get("version"):
                known, newest = [], None
            own = [each for each in known if _event(each.data) == _event(data)]
            if not own:
                known = [newest] if newest else []
            self._last = entry.sequence
            if is_due([each.data["sample"] for each in own], data["sample"]):
                known = [*known, entry]
                if "cause" not in data and entry.sequence not in explained:
                    self._queue.put(known)
            if entry.sequence in explained:
                self._keep(entry, explained[entry.sequence])
            self._alarms[asset] = known, entry

    def _keep(self, alarm: Entry, cause: dict[str, Any]) -> None:
        """Keep what the event of an alarm is explained by."""
        event = alarm.data["asset"], _event(alarm.data)
        if not cause.get("same") or cause["name"] == self._current.get(event, ("", 0.0))[0]:
            self._current[event] = cause["name"], cause["unknown"]

    def _run(self) -> None:
        while not self._closed.is_set():
            waiting = self._queue.get()
            try:
                if waiting is not None:
                    self._explain(waiting)
            except InputError:
                pass  # It could not be stored, so the alarm is explained after the next start.
            finally:
                self._queue.task_done()

    def _explain(self, alarms: list[Entry]) -> None:
        entry = alarms[-1]
        alarm = entry.data
        try:
            found = self._found(alarms)
        except Exception as error:  # Whatever fails is an entry, and the next alarm is explained.
            same = _event(alarm) != alarm["time"]
            found = cause_data(UNKNOWN, 0.0, 1.0, {}) | {"note": brief(error), "same": same}
        found |= {"alarm": entry.sequence, "asset": alarm["asset"]}
        self._live.log([("cause", found)])
        self._keep(entry, found)
        try:
            self._report(alarm, found)
        except Exception:  # of the caller; further alarms are explained all the same
            logging.getLogger(__name__).exception("a cause was found but not reported")

    def _found(self, entries: list[Entry]) -> dict[str, Any]:
        """The cause of the last alarm as data of the log."""
        store, last = self._live.store, entries[-1].data
        name = last["asset"]
        twin = next(each for each in store.assets() if each.name == name).settings["twin"]
        monitor = Monitor.load(Registry(store, twin).folder(last["version"]))
        period = SECOND / monitor.twin.rate
        opening = max(_event(last) - round(BEFORE * period), last["time"] - round(EVENT * period))
        begin = max(opening, last["time"] - round(last["sample"] * period))
        half = round(period / 2)
        times, values = gridded(store, name, monitor.twin, begin - half, last["time"] + half)
        remedy = "store more of them: see max_samples"
        at_least("samples", times, 2, "before the alarm in the store", remedy=remedy)
        record, first = record_of(monitor.twin, values), int(times[0])
        *earlier, newest = [_alarm(each.data, first, period) for each in entries]
        alarms = [*earlier, replace(newest, sample=record.steps - 1)]
        search = CauseSearch(monitor.twin, record, self.causes(twin, monitor), known_start=False)
        cause = search.find(alarms, self._current.get((name, _event(last)), ("", 0.0)))
        ends = cause.size, cause.onset
        size, onset = ([each if np.isfinite(each) else None for each in end] for end in ends)
        moments = [None if each is None else first + round(each * SECOND) for each in onset]
        shares = cause.probability, cause.unknown, cause.probabilities
        about = {"limit": cause.limit, "earlier": cause.earlier, "same": cause.same}
        return cause_data(cause.name, *shares, size, cause.unit, moments) | about


def _alarm(data: dict[str, Any], first: int, period: float) -> Alarm:
    """An alarm of the log in a record whose first sample was at a time in nanoseconds."""
    sample, event = (round((time - first) / period) for time in (data["time"], _event(data)))
    about = data["output"], data["change"], data["evidence"]
    return Alarm("", sample, 0.0, *about, event, True, tuple(data["machine"]))


def _event(alarm: Mapping[str, Any]) -> int:
    """The time of the first alarm of an alarm's event."""
    return int(alarm.get("event", alarm["time"]))
