"""`Progress` and `Report`: the functions to which long work reports its progress."""

from __future__ import annotations

from collections.abc import Callable

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
