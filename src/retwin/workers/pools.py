"""Worker processes that end with their parent and may hang or crash without ending it.

And temporary folders that are removed when their process ends. Native code of unknown origin runs
in a `workers.process.ForeignProcess`.
"""

from __future__ import annotations

import glob
import multiprocessing
import os
import pickle
import platform
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.synchronize import RLock
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any

from pebble import ProcessPool

from retwin.catalog.modules import add_known, known
from retwin.errors import InputError, place_of


@contextmanager
def worker_pool(
    workers: int, start: Callable[..., None] | None = None, arguments: tuple[Any, ...] = ()
) -> Iterator[ProcessPool]:
    """A pool of spawned processes.

    Each worker ends when this process ends, however that happens. `pool.schedule(function, args,
    kwargs, timeout)` gives a future. A task that takes longer than `timeout` (s) ends in
    `TimeoutError`, one whose process dies in `pebble.ProcessExpired`; the other tasks go on in a
    new process. Leaving the block waits for all tasks; an exception or Ctrl-C ends the workers.

    Parameters
    ----------
    workers : int
        The number of processes.
    start : callable
        Called with `arguments` when a worker begins.
    arguments : tuple
        Arguments of `start`, which are pickled.

    """
    pool = ProcessPool(
        max_workers=workers,
        initializer=_begin,
        initargs=(known(), start, arguments),
        context=_Spawn(),
    )
    try:
        yield pool
        pool.close()
    except BaseException:
        pool.stop()
        raise
    finally:
        pool.join()


class _Process(SpawnProcess):
    """A process that Ctrl-C does not reach before `_begin` ignores it."""

    def start(self) -> None:
        """Start it; it inherits that SIGINT is blocked."""
        if os.name != "posix":
            return super().start()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return None


class _Spawn(SpawnContext):
    """Spawns instead of forking, since torch's threads do not survive a fork.

    Keeps references to its locks: a worker that still starts when its pool ends opens them by name
    and prints an error if they are gone.
    """

    Process = _Process

    def __init__(self) -> None:
        self.locks: list[RLock] = []

    def RLock(self) -> RLock:  # noqa: N802
        self.locks.append(super().RLock())
        return self.locks[-1]


def _begin(
    modules: dict[str, str], start: Callable[..., None] | None, arguments: tuple[Any, ...]
) -> None:
    """Begin a process that ignores Ctrl-C and ends with its parent; see `worker_pool`.

    It finds the modules of users that the parent found, of which tasks may be made.
    """
    add_known(modules)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if os.name == "posix":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if start is not None:
        start(*arguments)


def _end_with_parent() -> None:
    """Wait for the parent process to end, then end: a parent that was killed ends no workers."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def check_sendable(value: object, argument: str, *, expected: str, remedy: str) -> None:
    """Refuse what cannot be pickled for a worker, as the InputError of these parts."""
    try:
        pickle.dumps(value)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        got = " ".join(str(error).split())
        raise InputError(argument, expected=expected, got=got, remedy=remedy) from None


@contextmanager
def sendable_errors() -> Iterator[None]:
    """Replace an exception that cannot be pickled by a RuntimeError with its type and message.

    For code in a worker, whose pool such an exception would break. SystemExit is replaced too: it
    is that of a user's code, and would end the parent as if all were done.
    """
    try:
        yield
    except SystemExit as error:
        described = RuntimeError(f"the code ended the program (SystemExit: {error.code})")
        described.add_note(place_of(error))
        raise described from error
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            described = RuntimeError(f"{type(error).__name__}: {error}")
            for note in getattr(error, "__notes__", ()):
                described.add_note(note)
            raise described from error
        raise


@contextmanager
def scratch_folder() -> Iterator[str]:
    """A temporary folder, removed when the block ends or the pool ends this worker process.

    The folders of processes that were killed are removed by the next call on the same machine.
    """
    owner = f"retwin-{platform.node()}-"
    _sweep(owner)
    folder = tempfile.mkdtemp(prefix=f"{owner}{os.getpid()}-")
    remove = Finalize(None, shutil.rmtree, (folder, True), exitpriority=1)
    try:
        yield folder
    finally:
        remove()


def _sweep(owner: str) -> None:
    """Remove the user's own folders whose process has ended."""
    if os.name != "posix":  # elsewhere signal 0 does not test whether a process exists
        return
    for folder in Path(tempfile.gettempdir()).glob(f"{glob.escape(owner)}*-*"):
        process = folder.name.removeprefix(owner).partition("-")[0]
        try:
            mine = folder.lstat().st_uid == os.getuid()
            os.kill(int(process), 0)
        except ProcessLookupError:
            if mine:
                shutil.rmtree(folder, ignore_errors=True)
        except (OSError, ValueError, OverflowError):
            continue  # another user's, already removed, or not one of these folders
