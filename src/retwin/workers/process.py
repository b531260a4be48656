"""`ForeignProcess`: a process for native code of others, which may do anything to its process.

It is started by its interpreter and not by `multiprocessing`, so that a script needs no guard, and
it has a connection of its own: in a pool all processes share one, which a process that writes to
all its file descriptors blocks for ever. What it sends is no pickle but frames: the length of a
JSON text, the text, and the arrays of numbers that it announces.
"""

from __future__ import annotations

import json
import os
import queue
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from retwin.catalog import resolve
from retwin.errors import InputError, brief, rebuild

HEAD = struct.Struct("<4sI")
"""What a frame begins with: `MARK`, and the length of its text."""
MARK = b"rtw\n"
BYTES_PER_CHARACTER, BYTES_PER_FLOAT = 32, 8
"""The largest size in memory of what one character of a frame's text describes, and of a whole
number, which may become a float."""
MORE_TIME = 8
"""How often the time limit of a task may begin anew, so that a process that writes what reads as
such a message still ends."""
FOREIGN = "it wrote to the connection of its process"
"""The reason of a failure whose answer is no frame."""
OVERHEAD = 2**29
"""Bytes that libraries themselves may take, where memory is limited."""
CPU_SECONDS, BYTES_PER_CPU_SECOND = 120, 2 * 10**5
"""Processor time that a file may take: a fixed part, and a part by its size. ROS messages of one
number are decoded at 10⁶ bytes per second."""
CODE = (
    "import sys; sys.path[:] = {path!r}; from retwin.workers.process import serve; "
    "serve({folder!r})"
)

Frame: TypeAlias = tuple[Any, list[NDArray]]
"""What a task yields: an object that JSON can hold, and arrays of numbers."""


class Retired(Exception):
    """Raised by a task that only a process of its own can do right; its message is a note."""


class ProcessEnded(Exception):
    """A process ended during a task, or broke its connection; the message is the reason."""

    def __init__(self, reason: str, code: int | None = None) -> None:
        super().__init__(reason)
        self.code = code


RAISED: Mapping[str, Callable[..., Exception]] = {
    "InputError": rebuild,
    "MemoryError": MemoryError,
    "Retired": Retired,
    "failed": ProcessEnded,
}
"""How the end of a task that raised an exception is raised here."""


class ForeignProcess:
    """A process with a connection of its own, which ends with this process.

    Parameters
    ----------
    folder : str
        A folder that it removes where this process, which would have done so, has died.
    quiet : bool
        Whether what it prints is dropped.
    environment : mapping of str to str, optional
        Variables besides those of this process.

    """

    def __init__(
        self, folder: str, *, quiet: bool = False, environment: Mapping[str, str] | None = None
    ) -> None:
        paths = [os.path.abspath(each) for each in sys.path if each]
        self._late = False
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-c", CODE.format(path=paths, folder=folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL if quiet else None,
            env={**os.environ, **(environment or {})},
            process_group=0 if os.name == "posix" else None,
        )

    def ask(
        self,
        task: str,
        about: Any,
        arrays: Sequence[NDArray] = (),
        *,
        take: Callable[[int], None],
        timeout: float = threading.TIMEOUT_MAX,
        limits: tuple[int, int] | None = None,
    ) -> Iterator[Frame]:
        """What a task yields; when it is done, the process can have another one.

        Parameters
        ----------
        task : str
            The dotted name of a generator function of `about` and `arrays`, which yields frames.
        about : object
            What JSON can hold.
        arrays : sequence of ndarray
            Arrays of numbers.
        take : callable
            Called with the bytes of an answer before they are allocated; may raise an exception.
        timeout : float
            Duration in s after which the process is killed.
        limits : tuple of int, optional
            The memory that the task may take, and the size of its file, by which its processor time
            is limited, in bytes.

        Raises
        ------
        TimeoutError
            The task took longer.
        ProcessEnded
            The process ended, or broke its connection.
        InputError, MemoryError, Retired
            As the task, whose other exceptions are a `ProcessEnded`.

        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._late = False
        timer = self._timer(timeout)
        more = 0
        try:
            with suppress(OSError):  # it has ended, which the next lines notice
                _send(self._process.stdin, [task, about, limits], arrays)
            while True:
                (kind, answer), parts = _receive(self._process.stdout, take)
                if kind == "more" and more < MORE_TIME:
                    more += 1
                    timer.cancel()
                    timer = self._timer(timeout)
                elif kind == "frame":
                    yield answer, parts
                elif kind == "done":
                    return
                else:
                    raise RAISED[kind](*answer)
        except EOFError:
            if self._late:
                raise TimeoutError from None
            raise self._describe_end() from None
        except InputError:
            raise
        except (ValueError, TypeError, LookupError):
            raise ProcessEnded(FOREIGN) from None
        finally:
            timer.cancel()

    def _timer(self, timeout: float) -> threading.Timer:
        def end() -> None:
            self._late = True
            self.kill()

        timer = threading.Timer(timeout, end)
        timer.daemon = True
        timer.start()
        return timer

    def _describe_end(self, *, closing_time: float = 1.0) -> ProcessEnded:
        """How the process ended, which has closed its connection.

        Parameters
        ----------
        closing_time : float, default 1.0
            Duration in s that a process has to end after it has closed its connection.

        """
        try:
            code = self._process.wait(closing_time)
        except subprocess.TimeoutExpired:
            return ProcessEnded("it closed the connection of its process")
        how = f"died (signal {-code})" if code < 0 else f"ended (exit code {code})"
        return ProcessEnded(f"its process {how}", code)

    def kill(self) -> None:
        """Kill the process, and with its group the processes that it has started."""
        if os.name == "posix":
            with suppress(OSError):  # all of it has ended
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.kill()

    def end(self) -> None:
        """End the process, also in the middle of a task."""
        self.kill()
        with suppress(OSError), self._process:  # a request that was not read
            pass


def _send(stream: IO[bytes], about: Any, arrays: Sequence[NDArray] = ()) -> None:
    kinds = [(each.dtype.str, each.shape) for each in arrays]
    text = json.dumps([about, kinds], default=lambda number: number.item()).encode()
    stream.write(HEAD.pack(MARK, len(text)) + text)
    for each in arrays:
        stream.write(np.ascontiguousarray(each).reshape(-1).view(np.uint8).data)
    stream.flush()


def _receive(stream: IO[bytes], take: Callable[[int], None]) -> Frame:
    """The next frame; EOFError if the stream ends, ValueError or TypeError if it is no frame."""
    mark, size = HEAD.unpack(_read(stream, HEAD.size).tobytes())
    if mark != MARK:
        raise ValueError(mark)
    take(BYTES_PER_CHARACTER * size)
    about, kinds = json.loads(_read(stream, size).tobytes())
    arrays = []
    for kind, shape in kinds:
        dtype, count = np.dtype(kind), int(np.prod(shape, dtype=object))
        if dtype.kind not in "iufc":
            raise ValueError(kind)
        take(count * (dtype.itemsize if dtype.kind in "fc" else BYTES_PER_FLOAT))
        arrays.append(_read(stream, count * dtype.itemsize).view(dtype).reshape(shape))
    return about, arrays


def _read(stream: IO[bytes], size: int) -> NDArray[np.uint8]:
    data = np.empty(size, np.uint8)
    if stream.readinto(data) < size:  # type: ignore[attr-defined]
        raise EOFError
    return data


_out: IO[bytes] | None = None
"""The connection of this process, if it is a `ForeignProcess`."""


def more_time() -> None:
    """Have the time limit of the present task begin anew; a task may do so `MORE_TIME` times."""
    if _out is not None:
        _send(_out, ["more", None])


def serve(folder: str) -> None:
    """Do tasks until this process is killed; the code of a `ForeignProcess`."""
    global _out
    _out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no frame
    warnings.simplefilter("ignore")
    requests: queue.SimpleQueue[Frame] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(requests, folder), daemon=True).start()
    with suppress(OSError):  # the connection was closed
        while True:
            (task, about, limits), arrays = requests.get()
            if limits is not None:
                _limit(*limits)
            _send(_out, _answer(_out, task, about, arrays))
    threading.Event().wait()


def _answer(out: IO[bytes], task: str, about: Any, arrays: list[NDArray]) -> list[Any]:
    """Do a task, send what it yields, and return how it ended."""
    try:
        for answer, parts in resolve(task)(about, *arrays):
            _send(out, ["frame", answer], parts)
    except InputError as error:
        return ["InputError", error.__reduce__()[1]]
    except MemoryError:
        return ["MemoryError", []]
    except Retired as error:
        return ["Retired", error.args]
    except BrokenPipeError:
        raise
    except Exception as error:
        return ["failed", [f"{type(error).__name__}: {brief(error)}"]]
    return ["done", None]


def _listen(requests: queue.SimpleQueue[Frame], folder: str) -> None:
    """Receive tasks until the connection ends: then the parent has died."""
    with suppress(Exception):
        while True:
            requests.put(_receive(sys.stdin.buffer, lambda size: None))
    shutil.rmtree(folder, ignore_errors=True)
    if os.name == "posix":
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


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
