"""Processes for native code of others: `IsolatedPool` of FMUs, `FileReader` of foreign files."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

from numpy.typing import NDArray

from retwin.errors import InputError
from retwin.serialisation.sizes import Budget
from retwin.workers.pools import scratch_folder
from retwin.workers.process import FOREIGN, ForeignProcess, Frame, ProcessEnded, Retired

OVERHEAD = 2**22
"""Bytes that an answer may take besides its arrays."""


class IsolatedPool:
    """A pool of processes, each with a connection of its own; `close` ends them.

    Parameters
    ----------
    workers : int
        The largest number of processes; each is started when it is needed.
    folder : str
        A folder that the processes remove where this process has died.
    task, about
        What a process does first; see `ForeignProcess.ask`.

    Attributes
    ----------
    notes : list of str
        Messages of the processes that retired.

    """

    def __init__(self, workers: int, folder: str, task: str, about: Any) -> None:
        self.notes: list[str] = []
        self._folder, self._begin = folder, (task, about)
        self._threads = ThreadPoolExecutor(workers)
        self._own = threading.local()
        self._all: set[ForeignProcess] = set()
        self._closed = False

    def schedule(
        self, task: str, about: Any, arrays: Sequence[NDArray] = (), *, timeout: float, size: int
    ) -> Future[Frame]:
        """The one frame that a task yields, in the future.

        Parameters
        ----------
        task, about, arrays
            See `ForeignProcess.ask`.
        timeout : float
            Duration in s after which the process is ended; its start is not included.
        size : int
            Largest size of the answer's arrays in bytes.

        Returns
        -------
        concurrent.futures.Future
            The answer; `TimeoutError` after that duration, `ProcessEnded` if the process ends.

        """
        return self._threads.submit(self._ask, (task, about, arrays), timeout, size)

    def close(self) -> None:
        """End all processes; tasks that have not begun are dropped."""
        self._closed = True
        for process in list(self._all):
            process.kill()
        self._threads.shutdown(cancel_futures=True)
        for process in list(self._all):
            process.end()

    def _ask(
        self, task: tuple[Any, ...], timeout: float, size: int, *, start_time: float = 120.0
    ) -> Frame:
        """Have a task done by this thread's process.

        A process that retires is replaced, and so is one that ends during a task that was not its
        first: the outcome must not depend on what a process did before.

        Parameters
        ----------
        start_time : float, default 120.0
            Duration in s after which a process that has not begun is ended. It is long, since a
            computer that is short of memory may need that long to import Python's packages.

        """
        while True:
            process: ForeignProcess | None = getattr(self._own, "process", None)
            fresh = process is None
            try:
                if process is None:
                    process = self._own.process = ForeignProcess(self._folder)
                    self._all.add(process)
                    if self._closed:  # after `close` has killed the others
                        process.kill()
                    _one(process, self._begin, start_time, 0)
                return _one(process, task, timeout, size)
            except BaseException as error:
                if process is not None:
                    process.end()
                    self._all.discard(process)
                self._own.process = None
                if fresh or not isinstance(error, Retired | ProcessEnded):
                    raise
                self.notes += error.args if isinstance(error, Retired) else ()


def _one(process: ForeignProcess, task: tuple[Any, ...], timeout: float, size: int) -> Frame:
    """The one frame of a task."""
    take = Budget("answer", size + OVERHEAD).take
    try:
        (frame,) = process.ask(*task, take=take, timeout=timeout)
    except ValueError:  # it is too large, or not one
        raise ProcessEnded(FOREIGN) from None
    return frame


class FileReader(ExitStack):
    """A process for the readers of foreign files, started when it is needed.

    Libraries of file formats have native code, which may crash, hang or take all memory on a
    damaged or hostile file. Here that ends the process, and becomes one line.

    Parameters
    ----------
    task : str
        The dotted name of a generator function of one JSON object, which yields frames.
    expected, remedy : str
        Of the message about a file that is damaged.

    """

    def __init__(self, task: str, *, expected: str, remedy: str) -> None:
        super().__init__()
        self._task, self._expected, self._remedy = task, expected, remedy
        self._process: ForeignProcess | None = None

    def read(self, request: Any, name: str, size: int, budget: Budget) -> Iterator[Frame]:
        """What the task yields for a request; the process can then have the next.

        Parameters
        ----------
        request : object
            What JSON can hold.
        name : str
            The name of the file, for messages.
        size : int
            Its size in bytes, by which its processor time is limited.
        budget : Budget
            The memory that may be taken.

        Raises
        ------
        InputError
            The reader failed, crashed or exceeded a limit, or raised it.

        """
        process = self._process = self._process or self._start()
        limits = (budget.left, size)
        try:
            yield from process.ask(self._task, request, take=budget.take, limits=limits)
        except MemoryError:
            budget.take(budget.left + 1)
        except ProcessEnded as error:
            got = f"contents at which its reader failed: {error}"
            if error.code == -getattr(signal, "SIGXCPU", 0):
                got = "contents that take longer to read than a file of that size can"
            raise InputError(name, expected=self._expected, got=got, remedy=self._remedy) from None

    def _start(self) -> ForeignProcess:
        # Libraries unpack to temporary files, which they leave where they fail.
        folder = self.enter_context(scratch_folder())
        own = {"ARROW_DEFAULT_MEMORY_POOL": "system", "OMP_NUM_THREADS": "1"}
        own |= dict.fromkeys(("TMPDIR", "TEMP", "TMP"), folder)
        process = ForeignProcess(folder, quiet=True, environment=own)
        self.callback(process.end)
        return process
