"""Worker processes of twins, started for one simulation or kept for several."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

Pool = TypeVar("Pool")

_KEPT: ContextVar[dict[str, tuple[Any, ExitStack]] | None] = ContextVar("kept", default=None)
"""Pools that are kept, by what they depend on, and what ends them."""


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
    with ExitStack() as stack:
        kept: dict[str, tuple[Any, ExitStack]] = {}
        token = _KEPT.set(kept)
        try:
            yield
        finally:
            _KEPT.reset(token)
            for _, each in kept.values():
                stack.push(each)


@contextmanager
def worker_processes(
    key: object, start: Callable[[], AbstractContextManager[Pool]]
) -> Iterator[Pool]:
    """The pool that `start` opens, or within `keep_workers` one that serves the same settings.

    Parameters
    ----------
    key : object
        Whatever the pool depends on, which its `repr` shows; pools of equal keys can stand in for
        each other.
    start : callable
        Opens the pool; without `keep_workers` it is closed when the block ends.

    Yields
    ------
    Pool
        The running pool. An exception in the block ends it, and with it all pending tasks.

    """
    kept, name = _KEPT.get(), repr(key)
    if kept is None:
        with start() as pool:
            yield pool
        return
    if name not in kept:
        stack = ExitStack()
        kept[name] = stack.enter_context(start()), stack
    try:
        yield kept[name][0]
    except BaseException as error:
        kept.pop(name)[1].__exit__(type(error), error, error.__traceback__)
        raise
