"""A gate that keeps what sources send, for tests of sources without a store."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import contextmanager

import numpy as np

from retwin.errors import InputError
from retwin.monitor.store.samples import Samples

PATIENCE = 30.0  # s


class CollectingGate:
    """Keeps samples in the order in which they come; the first `failing` ones are refused."""

    def __init__(self, failing: int = 0) -> None:
        self.failing = failing
        self.held: dict[str, dict[int, list[float]]] = {}
        self.order: dict[str, list[int]] = {}

    def send(self, samples: Samples) -> Future:
        future: Future = Future()
        if self.failing > 0:
            self.failing -= 1
            future.set_exception(InputError("disk", expected="room", got="none", remedy="wait"))
            return future
        own = self.held.setdefault(samples.asset, {})
        for time_, row in zip(samples.times.tolist(), samples.values.tolist(), strict=True):
            self.order.setdefault(samples.asset, []).append(time_)
            own.setdefault(time_, row)
        future.set_result(None)
        return future

    def times(self, asset: str) -> list[int]:
        return sorted(self.held.get(asset, {}))

    def values(self, asset: str) -> np.ndarray:
        return np.array([self.held[asset][each] for each in self.times(asset)])


@contextmanager
def running(source, gate):
    """The source runs in a thread while the block does."""
    stop = threading.Event()
    thread = threading.Thread(target=source.run, args=(gate, stop), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(PATIENCE)
        assert not thread.is_alive()


def wait(until: Callable[[], bool], what: object = "", patience: float = PATIENCE) -> float:
    """Wait until that is so; the seconds that it took."""
    begun = time.monotonic()
    while not until():
        assert time.monotonic() - begun < patience, what
        time.sleep(0.01)
    return time.monotonic() - begun
