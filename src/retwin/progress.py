"""`Progress` and `Report`: the functions to which long work reports its progress."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

Item = TypeVar("Item")

Progress = Callable[[float], None]
"""Called with the share of the work that is done, from 0 to 1."""

Report = Callable[[str, float], None]
"""Called with the name of the present stage and the share that is done, from 0 to 1."""


class FinishedStage(str):
    """The name of a stage that is done, in place of that of the present one."""

    __slots__ = ()


class ResumedStage(str):
    """The name of a stage that goes on where it stopped: its share was done before."""

    __slots__ = ()


def part_of(progress: Progress | None, done: int, parts: int) -> Progress | None:
    """The progress of one of several equal parts of the work, after so many that are done."""
    return progress and (lambda share: progress((done + share) / parts))


def tracked(items: Iterable[Item], count: int, progress: Progress | None) -> Iterator[Item]:
    """The items, of which there are so many; after each, the share that is done is reported."""
    for done, item in enumerate(items, 1):
        yield item
        if progress is not None:
            progress(done / count)
