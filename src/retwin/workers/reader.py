"""`ReaderProcess`: foreign files are read in a process with limits, which they may crash.

Libraries of file formats have native code, which may crash, hang or take all memory on a damaged or
hostile file. Here that ends the process, and becomes one line. The process is started by its
interpreter and not by `multiprocessing`, so that a script needs no guard. What it sends is no
pickle but frames: the length of a JSON text, the text, and the arrays that it announces.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from retwin.entries import resolve
from retwin.errors import InputError, brief
from retwin.processes import scratch_folder
from retwin.serialisation.sizes import Budget

FRAME = struct.Struct("<I")
"""The length of a frame's text."""
BYTES_PER_CHARACTER = 32
"""The largest size in memory of what one character of a frame's text describes."""
BYTES_PER_FLOAT = 8
"""The same of a whole number, which may become a float."""
OVERHEAD = 2**29
"""Bytes that the libraries themselves may take."""
CPU_SECONDS, BYTES_PER_CPU_SECOND = 120, 2 * 10**5
"""Processor time that a file may take: a fixed part, and a part by its size. ROS messages of one
number are decoded at 10⁶ bytes per second."""
CODE = "import sys; sys.path[:] = {path!r}; from retwin.workers.reader import serve; serve()"

Frame: TypeAlias = tuple[Any, list[NDArray]]
"""What a task yields: an object that JSON can hold, and arrays of numbers."""


class ReaderProcess(ExitStack):
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
        self._process: subprocess.Popen[bytes] | None = None

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
        assert process.stdin is not None
        assert process.stdout is not None
        with suppress(BrokenPipeError):  # it has ended, which the next lines notice
            job = {"task": self._task, "request": request, "size": size, "max_bytes": budget.left}
            process.stdin.write(json.dumps(job).encode() + b"\n")
            process.stdin.flush()
        while True:
            frame = _receive(process.stdout, budget)
            if frame is None:
                raise self._refused(name, _ending(process.wait()))
            kind, about, arrays = frame
            if kind == "done":
                return
            if kind == "error":
                argument, expected, got, remedy = map(str, about)
                raise InputError(argument, expected=expected, got=got, remedy=remedy)
            if kind == "memory":
                budget.take(budget.left + 1)
            if kind == "damaged":
                raise self._refused(name, str(about))
            yield about, arrays

    def _refused(self, name: str, got: str) -> InputError:
        return InputError(name, expected=self._expected, got=got, remedy=self._remedy)

    def _start(self) -> subprocess.Popen[bytes]:
        # Libraries unpack to temporary files, which they leave where they fail.
        scratch = self.enter_context(scratch_folder())
        own = {"ARROW_DEFAULT_MEMORY_POOL": "system", "OMP_NUM_THREADS": "1"}
        paths = [os.path.abspath(each) for each in sys.path if each]
        process = subprocess.Popen(
            [sys.executable, "-I", "-c", CODE.format(path=paths)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **own, **dict.fromkeys(("TMPDIR", "TEMP", "TMP"), scratch)},
        )
        self.enter_context(suppress(BrokenPipeError))  # at the end, of a request that was not read
        self.enter_context(process)
        self.callback(process.kill)
        return process


def _receive(stream: IO[bytes], budget: Budget) -> tuple[str, Any, list[NDArray]] | None:
    """Kind and contents of the next frame; None if the stream ends, or if it is no frame."""
    head = stream.read(FRAME.size)
    if len(head) < FRAME.size:
        return None
    (size,) = FRAME.unpack(head)
    budget.take(BYTES_PER_CHARACTER * size)
    arrays = []
    try:
        what, about, kinds = json.loads(stream.read(size))
        for kind, shape in kinds:
            dtype = np.dtype(kind)
            if dtype.kind not in "iufc":
                return None
            width = dtype.itemsize if dtype.kind in "fc" else BYTES_PER_FLOAT
            budget.take(width * int(np.prod(shape, dtype=object)))
            made = np.empty(shape, dtype)
            if stream.readinto(made.reshape(-1).view(np.uint8)) < made.nbytes:  # type: ignore[attr-defined]
                return None
            arrays.append(made)
    except InputError:
        raise
    except (ValueError, TypeError):
        return None
    return what, about, arrays


def _ending(code: int) -> str:
    """What a file was, at which the process ended with this code."""
    if code == -getattr(signal, "SIGXCPU", 0):
        return "contents that take longer to read than a file of that size can"
    why = f"signal {-code}" if code < 0 else f"exit code {code}"
    return f"contents at which the format's library failed ({why})"


def serve() -> None:
    """Answer the requests on standard input until it ends; the code of the process."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no frame
    warnings.simplefilter("ignore")

    def send(kind: str, about: Any = None, arrays: Sequence[NDArray] = ()) -> None:
        text = json.dumps([kind, about, [(each.dtype.str, each.shape) for each in arrays]]).encode()
        out.write(FRAME.pack(len(text)) + text)
        for each in arrays:
            out.write(np.ascontiguousarray(each).reshape(-1).view(np.uint8).data)
        out.flush()

    with suppress(BrokenPipeError):  # nobody waits any more
        for line in sys.stdin.buffer:
            _answer(json.loads(line), send)
    os._exit(0)  # native libraries may hang or crash at their end


def _answer(job: dict[str, Any], send: Callable[..., None]) -> None:
    """Do one task within its limits, and send what it yields and how it ends."""
    _limit(job["max_bytes"], job["size"])
    try:
        for about, arrays in resolve(job["task"])(job["request"]):
            send("frame", about, arrays)
    except InputError as error:
        send("error", [error.argument, error.expected, error.got, error.remedy])
    except MemoryError:
        send("memory")
    except BrokenPipeError:
        raise
    except Exception as error:
        send("damaged", f"{type(error).__name__}: {brief(error)}")
    else:
        send("done")


def _limit(max_bytes: int, size: int) -> None:
    """Limit memory, written files and processor time of this process, where the system can."""
    try:
        import resource

        used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    except (ImportError, OSError, ValueError):
        return
    seconds = int(time.process_time()) + CPU_SECONDS + size // BYTES_PER_CPU_SECOND
    for kind, most in (
        (resource.RLIMIT_DATA, used + max_bytes + OVERHEAD),
        (resource.RLIMIT_FSIZE, max_bytes),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_CORE, 0),
    ):
        limit = resource.getrlimit(kind)[1]
        most = most if limit == resource.RLIM_INFINITY else min(most, limit)
        with suppress(ValueError, OSError):
            resource.setrlimit(kind, (min(most, 2**62), limit))
