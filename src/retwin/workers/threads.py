"""Work that is divided between threads, for functions that leave Python's lock while they compute.

Results do not depend on the number of threads, which is that of torch: a worker of a study has one.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from functools import lru_cache
from typing import TypeVar

from threadpoolctl import ThreadpoolController

Item = TypeVar("Item")
Result = TypeVar("Result")

_own = threading.local()
_lock = threading.Lock()
_blocks: list[int] = []
"""Of each block of `one_thread` that is entered, the number of threads outside of all of them."""


def available() -> int:
    """The number of threads to use here: that of torch.

    It is 1 in a thread of `in_threads`, and where torch is not loaded, which takes longer.
    """
    torch = sys.modules.get("torch")
    return 1 if torch is None or getattr(_own, "divided", False) else torch.get_num_threads()


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread of torch and of BLAS in the block: for steps that are too small to divide."""
    import torch

    with _lock:
        # Blocks of several threads overlap: what the first one found is restored by each.
        count = _blocks[0] if _blocks else torch.get_num_threads()
        _blocks.append(count)
        torch.set_num_threads(1)
    try:
        with _libraries().limit(limits=1, user_api="blas"):
            yield
    finally:
        with _lock:
            _blocks.pop()
            torch.set_num_threads(count)


def in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """The results of a function, in the order of the items, which begin in that order.

    Parameters
    ----------
    function : callable
        Safe to be called in several threads at a time.
    items : sequence
        Its arguments.

    Yields
    ------
    Result
        Of each item; an exception is raised in its place.

    """
    count = min(available(), len(items))
    if count <= 1:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(count, initializer=_begin) as pool:
        futures = [pool.submit(copy_context().run, function, item) for item in items]
        try:
            for future in futures:
                yield future.result()
        finally:
            for future in futures:
                future.cancel()


def _begin() -> None:
    """One thread for all that this thread computes: more than there are cores cost time."""
    _own.divided = True
    sys.modules["torch"].get_num_threads()  # sets the number of this thread, which is then limited
    _libraries().limit(limits=1, user_api="openmp")


@lru_cache(maxsize=1)
def _libraries() -> ThreadpoolController:
    """The libraries that have threads of their own, which take a while to find."""
    return ThreadpoolController()


class Turns:
    """Parts of divided work that are done one after the other, in the order of the items."""

    def __init__(self) -> None:
        self._next = 0
        self._done: set[int] = set()
        self._changed = threading.Condition()

    @contextmanager
    def turn(self, number: int) -> Iterator[None]:
        """A block that begins when the turns of all items before this one, from 0 on, are over."""
        with self._changed:
            self._changed.wait_for(lambda: self._next == number)
        try:
            yield
        finally:
            self.over(number)

    def over(self, number: int) -> None:
        """The turn of an item is over, or it needs none."""
        with self._changed:
            self._done.add(number)
            while self._next in self._done:
                self._next += 1
            self._changed.notify_all()
