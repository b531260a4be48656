"""`Explanations`: finds the causes of alarms beside the stream, and logs them."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Container, Iterable
from typing import Any

import numpy as np

from retwin.checks import require
from retwin.data.trajectories import HEALTHY, UNKNOWN
from retwin.errors import InputError, brief
from retwin.monitor.live.live import Live
from retwin.monitor.models.cause import (
    BEFORE,
    MIN_WINDOW,
    Cause,
    cause_data,
    find_causes,
    possible_causes,
)
from retwin.monitor.models.monitor import Monitor
from retwin.monitor.models.watched import Alarm
from retwin.monitor.store.audit import Entry
from retwin.monitor.store.gridded import gridded, record_of
from retwin.monitor.store.samples import SECOND
from retwin.monitor.versions.registry import Registry
from retwin.twins.faults.actuator_faults import Fault

Faults = Callable[[str], "dict[str, Fault | None] | None"]
"""The known faults of a twin by its name; None for any change."""


class Explanations:
    """A thread that explains each alarm from the stored samples before it.

    A context manager that ends the thread. What is found is an entry `cause` of the log. Of further
    alarms of an event it is a second fault if it began after the alarm before; else the fault is
    still the `same`, or its state comes back. Alarms
    that have none, since the program was stopped, are explained when it is started again.

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
        self._queue: queue.Queue[tuple[Entry, int] | None] = queue.Queue()
        self._before: dict[str, int] = {}
        self._closed = threading.Event()
        self._taking = threading.Lock()
        self._last = -1
        explained = {entry.data["alarm"] for entry in live.store.log("cause")}
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
                self._take(each for each in alarms if each.sequence > self._last)

    def _take(self, alarms: Iterable[Entry], explained: Container[int] = ()) -> None:
        """Queue alarms, each with the time of the alarm before it of the same machine."""
        for entry in alarms:
            asset = entry.data["asset"]
            if entry.sequence not in explained and "cause" not in entry.data:
                self._queue.put((entry, self._before.get(asset, 0)))
            self._before[asset] = entry.data["time"]
            self._last = entry.sequence

    def _run(self) -> None:
        while not self._closed.is_set():
            waiting = self._queue.get()
            try:
                if waiting is not None:
                    self._explain(*waiting)
            except InputError:
                pass  # It could not be stored, so the alarm is explained after the next start.
            finally:
                self._queue.task_done()

    def _explain(self, entry: Entry, before: int) -> None:
        alarm = entry.data
        try:
            found = _data(*self._found(alarm, before))
        except Exception as error:  # Whatever fails is an entry, and the next alarm is explained.
            found = cause_data(UNKNOWN, 0.0, 1.0, {}) | {"note": brief(error)}
        begun = found["onset"][1]
        same = alarm.get("event", alarm["time"]) != alarm["time"] and (
            found["name"] == HEALTHY or begun is None or begun <= before
        )
        found |= {"alarm": entry.sequence, "asset": alarm["asset"], "same": same}
        self._live.log([("cause", found)])
        try:
            self._report(alarm, found)
        except Exception:  # of the caller; further alarms are explained all the same
            logging.getLogger(__name__).exception("a cause was found but not reported")

    def _found(self, alarm: dict[str, Any], before: int) -> tuple[Cause, int]:
        """The cause of an alarm, and the time of the first sample that it was found from."""
        store, name = self._live.store, alarm["asset"]
        twin = next(each for each in store.assets() if each.name == name).settings["twin"]
        monitor = Monitor.load(Registry(store, twin).folder(alarm["version"]))
        period = SECOND / monitor.twin.rate
        window = round(min(BEFORE, alarm["sample"]) * period)
        if alarm["time"] - before > MIN_WINDOW * period:
            window = min(window, alarm["time"] - before - round(period / 2))
        half = round(period / 2)
        begin, end = alarm["time"] - window - half, alarm["time"] + half
        times, values = gridded(store, name, monitor.twin, begin, end)
        require(
            len(times) >= 2,
            "samples",
            expected="at least two before the alarm in the store",
            got=len(times),
            remedy="store more of them: see max_samples",
        )
        record = record_of(monitor.twin, values)
        about = alarm["output"], alarm["change"], alarm["evidence"]
        own = Alarm("", record.steps - 1, 0.0, *about, 0, True, tuple(alarm["machine"]))
        known = self.causes(twin, monitor)
        (cause,) = find_causes(monitor.twin, record, [own], known, known_start=False)
        return cause, int(times[0])


def _data(cause: Cause, first: int) -> dict[str, Any]:
    """A cause as data of the log, whose first sample was at a time in nanoseconds."""
    size = [each if np.isfinite(each) else None for each in cause.size]
    onset = [first + round(each * SECOND) if np.isfinite(each) else None for each in cause.onset]
    shares = cause.probability, cause.unknown, cause.probabilities
    return cause_data(cause.name, *shares, size, onset)
