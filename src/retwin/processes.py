"""Worker processes that end with their parent, and that may hang or crash without ending it.

And folders for as long as a process needs them.
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
from multiprocessing.context import SpawnContext
from multiprocessing.synchronize import RLock
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any

from pebble import ProcessPool

__all__ = ["scratch_folder", "sendable_errors", "worker_pool"]


@contextmanager
def worker_pool(
    workers: int,
    start: Callable[..., None] | None = None,
    arguments: tuple[Any, ...] = (),
    *,
    orphaned: Callable[..., None] | None = None,
) -> Iterator[ProcessPool]:
    """A pool of spawned processes, each of which calls `start(*arguments)` first.

    Each ends when this process does, however that ends, and calls `orphaned(*arguments)` then.

    `pool.schedule(function, args, kwargs, timeout)` gives a future. A task that hangs beyond its
    timeout (s) ends in `TimeoutError`, one whose process dies in `pebble.ProcessExpired`; the other
    tasks go on, in a new process. Leaving the block waits for all tasks; an exception or Ctrl-C
    ends the workers at once.
    """
    pool = ProcessPool(
        max_workers=workers,
        initializer=_begin,
        initargs=(start, arguments, orphaned),
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


class _Spawn(SpawnContext):
    """Spawns, not forks: torch's threads do not survive a fork.

    Keeps the locks it makes. A worker that is still starting when its pool ends looks for them by
    name, and would complain at length if they were gone.
    """

    def __init__(self) -> None:
        self.locks: list[RLock] = []

    def RLock(self) -> RLock:  # noqa: N802
        self.locks.append(super().RLock())
        return self.locks[-1]


def _begin(
    start: Callable[..., None] | None,
    arguments: tuple[Any, ...],
    orphaned: Callable[..., None] | None,
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, args=(orphaned, arguments), daemon=True).start()
    if start is not None:
        start(*arguments)


def _end_with_parent(orphaned: Callable[..., None] | None, arguments: tuple[Any, ...]) -> None:
    """A parent that was killed cannot end its workers: they must see for themselves."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        try:
            if orphaned is not None:
                orphaned(*arguments)
        finally:
            os._exit(1)


@contextmanager
def sendable_errors() -> Iterator[None]:
    """Replace an exception that cannot be built again in another process by one that tells of it.

    It would break the pool. For what is done in a worker.
    """
    try:
        yield
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            told = RuntimeError(f"{type(error).__name__}: {error}")
            for note in getattr(error, "__notes__", ()):
                told.add_note(note)
            raise told from error
        raise


@contextmanager
def scratch_folder() -> Iterator[str]:
    """A folder among the temporary files, removed in the end.

    Also when this process is a worker that its pool ends. What a process that was killed has left
    is removed by the next one that makes such a folder on the same machine.
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
    """Remove my own folders whose process is no more."""
    if os.name != "posix":  # elsewhere one cannot ask for a process by signal 0
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
            continue  # someone else's, gone by now, or not one of these folders
