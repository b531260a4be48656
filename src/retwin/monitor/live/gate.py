"""`Gate`: many producers of samples, whose samples are stored in common commits."""

from __future__ import annotations

import queue
import threading
from collections.abc import Sequence
from concurrent.futures import Future
from typing import TypeAlias

from retwin.errors import InputError
from retwin.monitor.live.live import Live
from retwin.monitor.live.machine import Received
from retwin.monitor.store.samples import Samples, Trajectory

GROUP = 50_000
"""Samples of one commit at most, beside those of one producer."""

_Waiting: TypeAlias = tuple[Samples | Trajectory, "Future[Received]"]


class Gate:
    """The way of samples into a `Live`; a context manager that closes it.

    A thread takes all samples that wait and submits them in one commit, so that commits become
    larger when there is more to do; another one takes trajectories of machines that are watched so,
    whose diagnosis would delay them. What one machine sends is used in the order of `send`.

    Parameters
    ----------
    live : Live
        Where samples go.

    """

    def __init__(self, live: Live) -> None:
        self.live = live
        # Producers that may wait at the same time; further ones wait before they are taken.
        self._queues: list[queue.Queue[_Waiting | None]] = [queue.Queue(10_000) for _ in range(2)]
        self._lock = threading.Lock()
        self._closed = False
        self._threads = [
            threading.Thread(target=self._run, args=(own,), name="gate", daemon=True)
            for own in self._queues
        ]
        for each in self._threads:
            each.start()

    def __enter__(self) -> Gate:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(self, samples: Samples | Trajectory) -> Future[Received]:
        """Hand samples or a trajectory over; the future has a result when they are durable.

        Its exception is an `InputError` if they were refused or could not be stored.

        Raises
        ------
        InputError
            The gate is closed.

        """
        future: Future[Received] = Future()
        with self._lock:
            if self._closed:
                raise InputError(
                    "gate", expected="one that is open", got="a closed one", remedy="open another"
                )
            self._queues[self.live.in_trajectories(samples.asset)].put((samples, future))
        return future

    def close(self) -> None:
        """Store what waits, and end; once more is no error."""
        with self._lock:
            if not self._closed:
                self._closed = True
                for each in self._queues:
                    each.put(None)
        for thread in self._threads:
            thread.join()

    def _run(self, own: queue.Queue[_Waiting | None]) -> None:
        open_ = True
        while open_:
            group, count, waiting = list[_Waiting](), 0, own.get()
            while waiting is not None:
                group.append(waiting)
                count += len(waiting[0].values)
                if count >= GROUP or own.empty():  # this thread alone takes from it
                    break
                waiting = own.get()
            open_ = waiting is not None
            active = [each for each in group if each[1].set_running_or_notify_cancel()]
            if active:
                self._submit(active)

    def _submit(self, group: Sequence[_Waiting]) -> None:
        """Submit a group, or, if it is refused, each of it alone."""
        try:
            found = self.live.submit([samples for samples, _ in group])
        except Exception as error:
            if isinstance(error, InputError) and len(group) > 1:
                for each in group:
                    self._submit([each])
                return
            for _, future in group:
                future.set_exception(error)
        else:
            for (_, future), own in zip(group, found, strict=True):
                future.set_result(own)
