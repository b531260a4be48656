"""Worker processes that end with their parent, and that may hang or crash without ending it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pebble import ProcessPool

__all__ = ["worker_pool"]


@contextmanager
def worker_pool(
    workers: int, start: Callable[..., None] | None = None, arguments: tuple[Any, ...] = ()
) -> Iterator[ProcessPool]:
    """A pool of spawned processes, each of which calls `start(*arguments)` first.

    `pool.schedule(function, args, kwargs, timeout)` gives a future. A task that hangs beyond its
    timeout (s) ends in `TimeoutError`, one whose process dies in `pebble.ProcessExpired`; the other
    tasks go on, in a new process. Leaving the block waits for all tasks; an exception or Ctrl-C
    ends the workers at once.
    """
    # Spawned, not forked: torch's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPool(
        max_workers=workers, initializer=_begin, initargs=(start, arguments), context=context
    )
    try:
        yield pool
        pool.close()
    except BaseException:
        pool.stop()
        raise
    finally:
        pool.join()


def _begin(start: Callable[..., None] | None, arguments: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if start is not None:
        start(*arguments)


def _end_with_parent() -> None:
    """A parent that was killed cannot end its workers: they must see for themselves."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
