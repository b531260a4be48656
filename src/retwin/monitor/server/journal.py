"""What the log holds of alarms and of events of assets, kept in memory and read on as it grows."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from retwin.checks import given, require
from retwin.monitor.store.audit import Entry
from retwin.monitor.store.samples import SECOND
from retwin.monitor.store.store import Store

KEPT = 10_000
"""Newest alarms that are kept; all of them are in the log."""


class Journal:
    """Alarms with their causes and acknowledgements, and the events of each asset.

    Parameters
    ----------
    store : Store
        Whose log is read.

    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._last = -1
        self._alarms: dict[int, dict[str, Any]] = {}
        self._event: dict[str, dict[str, Any]] = {}
        """The newest event of each asset, as its first alarm."""
        self._opened: dict[int, int] = {}
        """The first alarm of the event to which each further one belongs."""
        self._void: dict[str, float] = {}
        self._events: dict[str, deque[dict[str, Any]]] = {}

    def alarms(
        self, asset: str | None = None, before: int | None = None, limit: int = 50
    ) -> tuple[list[dict[str, Any]], int | None]:
        """The newest alarms first, and the `before` of those that follow; None at the end."""
        with self._read():
            found = [
                alarm
                for sequence, alarm in reversed(self._alarms.items())
                if (before is None or sequence < before) and asset in (None, alarm["asset"])
            ]
        return found[:limit], found[limit - 1]["sequence"] if len(found) > limit else None

    def alarm(self, sequence: int) -> dict[str, Any]:
        """One alarm by its place in the log; InputError where none is there."""
        with self._read():
            found = self._alarms.get(sequence)
        expected = f"that of one of the newest {KEPT} alarms"
        return given("sequence", found, expected, got=str(sequence)[:40], remedy="see /alarms")

    def open(self) -> dict[str, dict[str, Any]]:
        """The newest alarm of each asset that nobody has acknowledged."""
        with self._read():
            alarms = self._alarms.values()
            return {each["asset"]: each for each in alarms if each["acknowledged"] is None}

    def void(self, asset: str) -> float | None:
        """When the promise of an asset became void the last time."""
        with self._read():
            return self._void.get(asset)

    def events(self, asset: str) -> list[dict[str, Any]]:
        """The newest events of an asset, its alarms among them, the newest first."""
        with self._read():
            return list(reversed(self._events.get(asset, ())))

    @contextmanager
    def _read(self) -> Iterator[None]:
        """Hold the lock, after the log was read on."""
        with self._lock:
            for entry in self._store.log(after=self._last):
                self._add(entry, entry.data)
                self._last = entry.sequence
            while len(self._alarms) > KEPT:
                del self._alarms[next(iter(self._alarms))]
            yield

    def _add(self, entry: Entry, data: Mapping[str, Any]) -> None:
        of = data.get("alarm", -1)
        alarm = self._alarms.get(self._opened.get(of, of))
        if alarm is not None and entry.kind == "cause":
            if not data.get("same") or _refines(data, alarm):
                alarm["cause"] = dict(data)
        elif entry.kind == "end":
            event = self._event.pop(data["asset"], None)
            if event is not None:
                event |= {"ended": data["time"] / SECOND, "how": data["how"]}
        elif alarm is not None:  # it is for the earlier ones of the asset too
            for sequence, each in self._alarms.items():
                if sequence <= data["alarm"] and each["asset"] == alarm["asset"]:
                    each["acknowledged"] = each["acknowledged"] or dict(data)
        elif entry.kind == "alarm" and data.get("event", data["time"]) != data["time"]:
            event = self._event.get(data["asset"])
            if event is not None:
                self._opened[entry.sequence] = event["sequence"]
                event["alarms"] += 1
        elif entry.kind in ("alarm", "remark", "void", "event"):
            where, got = f"entry {entry.sequence} of the log", ", ".join(data)
            known, expected = {"asset", "time"} <= data.keys(), "an asset and a time"
            require(known, where, expected=expected, got=got, remedy="verify the log")
            made = {**data, "kind": entry.kind, "sequence": entry.sequence}
            made["time"] = data["time"] / SECOND
            if entry.kind == "alarm":
                made |= {"cause": data.get("cause"), "acknowledged": None, "alarms": 1}
                made |= {"ended": None, "how": ""}
                self._event[data["asset"]] = made
                if "begin" in data:  # of a trajectory
                    made["begin"] = data["begin"] / SECOND
                self._alarms[entry.sequence] = made
            if entry.kind == "void":
                self._void[data["asset"]] = made["time"]
            # Newest events of each asset that are kept.
            self._events.setdefault(data["asset"], deque(maxlen=50)).append(made)


def _refines(data: Mapping[str, Any], alarm: Mapping[str, Any]) -> bool:
    """Whether a cause is the one that opened the event of an alarm, from more samples."""
    if alarm["cause"] is None or data["name"] != alarm["cause"]["name"]:
        return False
    onset = data["onset"][0]
    return onset is not None and bool(onset / SECOND <= alarm["time"])
