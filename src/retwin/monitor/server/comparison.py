"""Comparisons of versions beside the server, which take seconds to minutes."""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

from retwin.checks import at_most
from retwin.monitor.store.store import Store
from retwin.monitor.versions.comparison import compare
from retwin.monitor.versions.decision import Decision

FRESH, PATIENCE, QUEUE = 60.0, 20.0, 16
"""A comparison is kept for so many seconds, or for so many times as long as it took, whichever is
longer; and comparisons that may be made or kept."""


@dataclass(eq=False)
class _Made:
    """A comparison, and until when it is kept once it is done."""

    future: Future[Decision]
    begun: float = field(default_factory=time.monotonic)
    until: float = float("inf")

    def done(self, _: object) -> None:
        """Note that it is done."""
        now = time.monotonic()
        self.until = now + max(FRESH, PATIENCE * (now - self.begun))


class Comparisons:
    """Comparisons in a thread of their own, one after the other, each kept for a while.

    Parameters
    ----------
    store : Store
        The store.

    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._worker = ThreadPoolExecutor(1, "comparison")
        self._made: dict[tuple[str, int], _Made] = {}
        self._lock = threading.Lock()

    def of(self, twin: str, number: int) -> Future[Decision]:
        """The comparison of a version with the active one."""
        key, now = (twin, number), time.monotonic()
        with self._lock:
            self._made = {each: made for each, made in self._made.items() if now < made.until}
            if key not in self._made:
                count = len(self._made) + 1
                at_most("comparison", count, QUEUE, "at a time", remedy="wait for a minute")
                made = _Made(self._worker.submit(compare, self._store, twin, number))
                self._made[key] = made
                made.future.add_done_callback(made.done)
            return self._made[key].future
