"""Worker processes of twins, started for one simulation or kept for several."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, TypeVar

Pool = TypeVar("Pool")


@dataclass(frozen=True, eq=False)
class _Kept:
    """A pool that is kept: the twin settings that it serves, and what ends it."""

    key: object
    pool: Any
    stack: ExitStack


_KEPT: ContextVar[list[_Kept] | None] = ContextVar("kept_worker_processes", default=None)


@contextmanager
def keep_workers() -> Iterator[None]:
    """Keep the worker processes that twins start within the block, until the block ends.

    By default `FMUTwin` and `FunctionTwin` start their processes for each simulation. Within this
    block a twin that simulates again finds them running and its simulator loaded. Results are the
    same. Other threads are not affected.
    """
    if _KEPT.get() is not None:
        yield
        return
    kept: list[_Kept] = []
    token = _KEPT.set(kept)
    try:
        yield
    finally:
        _KEPT.reset(token)
        with ExitStack() as stack:
            for each in kept:
                stack.push(each.stack)


@contextmanager
def worker_processes(
    key: object, start: Callable[[], AbstractContextManager[Pool]]
) -> Iterator[Pool]:
    """The pool that `start` opens, or within `keep_workers` one that serves the same settings.

    Parameters
    ----------
    key : object
        Whatever the pool depends on; pools of equal keys can stand in for each other.
    start : callable
        Opens the pool; without `keep_workers` it is closed when the block ends.

    Yields
    ------
    Pool
        The running pool. An exception in the block ends it, and with it all pending tasks.

    """
    kept = _KEPT.get()
    if kept is None:
        with start() as pool:
            yield pool
        return
    found = next((each for each in kept if each.key == key), None)
    if found is None:
        stack = ExitStack()
        found = _Kept(key, stack.enter_context(start()), stack)
        kept.append(found)
    try:
        yield found.pool
    except BaseException as error:
        kept[:] = [each for each in kept if each is not found]
        found.stack.__exit__(type(error), error, error.__traceback__)
        raise
