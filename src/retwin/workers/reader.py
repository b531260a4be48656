"""`FileReader`: the libraries of foreign files run in a process with limits.

Libraries of file formats have native code, which may crash, hang or take all memory on a damaged or
hostile file. Here that ends the process, and becomes one line.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

from retwin.errors import InputError
from retwin.serialisation.sizes import Budget
from retwin.workers.pools import scratch_folder
from retwin.workers.process import ForeignProcess, Frame, ProcessEnded


class FileReader(ExitStack):
    """A process for the readers of foreign files, started when it is needed.

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
