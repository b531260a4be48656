"""Processes for native code that nobody here has seen, which may do anything to its process."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from math import inf
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any

from retwin.processes import begin_worker

START_TIME = 120.0
"""Duration in s after which a process that has not begun is ended. It is long, since a computer
that is short of memory may need that long to import Python's packages."""
RESOLUTION = 0.02
"""Duration in s between two checks of the time limits of processes."""
CLOSING_TIME = 1.0
"""Duration in s that a process has to end after it has closed its connection."""
MORE_TIME = 8
"""How often the time limit of a task may begin anew, so that a process that writes what reads as
such a message still ends."""
FOREIGN = "it wrote to the connection of its process"
"""The reason of a failure whose answer is no answer of the pool."""
OVERHEAD = 65_536
"""Bytes that the pickle of an answer may take besides its arrays."""


class Retired(Exception):
    """Raised by a task of an `IsolatedPool` that only a process of its own can do right.

    The pool replaces the process and does the task again. A message, if there is one, is added to
    the notes of the pool.
    """


class ProcessEnded(Exception):
    """A process of an `IsolatedPool` ended during a task, or broke its connection.

    The message is the reason.
    """


@contextmanager
def isolated_pool(
    workers: int,
    start: Callable[..., None],
    arguments: tuple[Any, ...],
    *,
    orphaned: Callable[..., None] | None = None,
) -> Iterator[IsolatedPool]:
    """A pool of spawned processes for code that may do anything to its process.

    In a `worker_pool` all processes share one connection, which a process that writes to all its
    file descriptors blocks for ever. Here each has its own, and every task has a time limit.

    Parameters
    ----------
    workers : int
        The largest number of processes; each is started when it is needed.
    start, arguments, orphaned
        See `worker_pool`.

    """
    pool = IsolatedPool(workers, (start, arguments, orphaned))
    try:
        yield pool
    finally:
        pool.close()


class IsolatedPool:
    """See `isolated_pool`.

    Attributes
    ----------
    notes : list of str
        Messages of the processes that retired.

    """

    def __init__(self, workers: int, begin: tuple[Any, ...]) -> None:
        self.notes: list[str] = []
        self._begin = begin
        self._threads = ThreadPoolExecutor(workers)
        self._own = threading.local()
        self._all: set[_Isolated] = set()
        self._closed = threading.Event()
        threading.Thread(target=self._end_late, daemon=True).start()

    def schedule(self, task: Callable[..., Any], *given: Any, timeout: float, size: int) -> Future:
        """The answer of `task(*given)`, in the future.

        Parameters
        ----------
        task : callable
            A function that other processes can import.
        *given : object
            Its arguments, which are pickled.
        timeout : float
            Duration in s after which the process is ended; its start is not included.
        size : int
            Largest size of the answer's arrays in bytes.

        Returns
        -------
        concurrent.futures.Future
            The answer; `TimeoutError` after that duration, `ProcessEnded` if the process ends.

        """
        return self._threads.submit(self._ask, (task, given), timeout, size + OVERHEAD)

    def close(self) -> None:
        """End all processes; tasks that have not begun are dropped."""
        self._closed.set()
        for process in list(self._all):
            process.kill()
        self._threads.shutdown(cancel_futures=True)
        for process in list(self._all):
            process.end()

    def _end_late(self) -> None:
        """Kill processes that are past their time limit, until the pool is closed."""
        while not self._closed.wait(RESOLUTION):
            for process in list(self._all):
                process.kill_if_late()

    def _ask(self, task: tuple[Any, ...], timeout: float, size: int) -> Any:
        """Have a task done by this thread's process.

        A process that retires is replaced, and so is one that ends during a task that was not its
        first: the outcome must not depend on what a process did before.
        """
        while True:
            process: _Isolated | None = getattr(self._own, "process", None)
            fresh = process is None
            if process is None:
                process = self._own.process = _Isolated(self._begin)
                self._all.add(process)
                if self._closed.is_set():  # after `close` has killed the others
                    process.kill()
            try:
                return process.ask(task, timeout, size)
            except BaseException as error:
                process.end()
                self._all.discard(process)
                self._own.process = None
                if fresh or not isinstance(error, Retired | ProcessEnded):
                    raise
                self.notes += error.args if isinstance(error, Retired) else ()


class _Isolated:
    """A process with a connection of its own."""

    starting = threading.Lock()
    """Processes are started and awaited one at a time, as multiprocessing requires."""

    def __init__(self, begin: tuple[Any, ...]) -> None:
        context = multiprocessing.get_context("spawn")
        self.here, there = context.Pipe()
        self.process = context.Process(target=_serve, args=(there, *begin), daemon=True)
        with self.starting:
            self.process.start()
        there.close()
        self.begun = self.late = False
        self.deadline = inf
        self.clock = threading.Lock()

    def ask(self, task: tuple[Any, ...], timeout: float, size: int) -> Any:
        """The answer to a task."""
        if not self.begun:
            self._exchange(None, START_TIME, OVERHEAD)
            self.begun = True
        fine, answer = self._exchange(task, timeout, size)
        if not fine:
            raise Retired(*answer)
        return answer

    def _exchange(self, message: Any, timeout: float, size: int) -> Any:
        """Send a message and receive the answer within the time limit."""
        reason = FOREIGN
        try:
            self.here.send(message)
            for _ in range(1 + MORE_TIME):
                self._limit(time.monotonic() + timeout)
                answer = self.here.recv_bytes(size)
                if answer:
                    self._limit(inf)
                    return pickle.loads(answer)
        except TimeoutError:
            raise
        except (EOFError, ConnectionError):
            reason = _ending(self._code())
        except Exception:  # bytes that are no pickle raise anything
            reason = FOREIGN
        self._limit(inf)
        raise ProcessEnded(reason)

    def _limit(self, deadline: float) -> None:
        """Set the time at which the process is killed; TimeoutError if it was killed before."""
        with self.clock:
            self.deadline = deadline
            if self.late:
                raise TimeoutError

    def kill_if_late(self) -> None:
        """Kill the process if it is past its time limit."""
        with self.clock:
            if time.monotonic() > self.deadline:
                self.late = True
                self.kill()

    def kill(self) -> None:
        """Kill the process, and with its group the processes that it has started."""
        if os.name == "posix" and self.process.pid is not None:
            with suppress(OSError):  # it has not made its group yet, or all of it has ended
                os.killpg(self.process.pid, signal.SIGKILL)
        self.process.kill()

    def _code(self) -> int | None:
        """The exit code of a process that has closed its connection; None if it goes on."""
        deadline = time.monotonic() + CLOSING_TIME
        while True:
            with self.starting:
                code: int | None = self.process.exitcode
            if code is not None or time.monotonic() > deadline:
                return code
            time.sleep(0.01)

    def end(self) -> None:
        """End the process, also in the middle of a task."""
        with self.starting:
            self.kill()
            self.process.join()
        self.here.close()


def _ending(code: int | None) -> str:
    """How a process ended, by its exit code."""
    if code is None:
        return "it closed the connection of its process"
    if code < 0:
        return f"its process died (signal {-code})"
    return f"its process ended (exit code {code})"


_connection: Connection | None = None
"""The connection of this process, if it is one of an `IsolatedPool`."""


def more_time() -> None:
    """Have the time limit of the present task begin anew; a task may do so `MORE_TIME` times."""
    if _connection is not None:
        _connection.send_bytes(b"")


def _serve(
    connection: Connection,
    start: Callable[..., None],
    arguments: tuple[Any, ...],
    orphaned: Callable[..., None] | None,
) -> None:
    """Do tasks until the connection ends; then this process is killed, or its parent was."""
    global _connection
    _connection = connection
    if os.name == "posix":  # where code that writes to all descriptors would disturb all processes
        os.close(resource_tracker.getfd() or -1)
        os.setpgid(0, 0)

    def end_group(*given: Any) -> None:
        try:
            if orphaned is not None:
                orphaned(*given)
        finally:
            if os.name == "posix":
                os.killpg(0, signal.SIGKILL)

    begin_worker(start, arguments, end_group)
    with suppress(EOFError, OSError):
        connection.recv()
        connection.send((True, ()))
        while True:
            task, given = connection.recv()
            try:
                answer = True, task(*given)
            except Retired as retired:
                answer = False, retired.args
            connection.send_bytes(pickle.dumps(answer, pickle.HIGHEST_PROTOCOL))
    threading.Event().wait()
