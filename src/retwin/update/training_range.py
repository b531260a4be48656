"""A warning where a surrogate is used for commands that its training did not contain."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from inspect import signature
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.twins.commands.range import CommandRange

F = TypeVar("F", bound=Callable[..., Any])

_CHECKED: ContextVar[bool] = ContextVar("checked", default=False)


class OutsideTrainingWarning(UserWarning):
    """Commands are outside the values, speeds or frequencies that a surrogate was trained on."""


@contextmanager
def training_checked(surrogate: Any, commands: NDArray) -> Iterator[str]:
    """Check commands once; in the block they are not checked again.

    Parameters
    ----------
    surrogate : Surrogate
        Another object, such as a twin in its place, has no training and is not checked; a surrogate
        that it contains checks the commands itself.
    commands : NDArray
        (n, T, d_u), at the surrogate's rate.

    Yields
    ------
    str
        What is outside; "" if nothing is, or if an outer block has checked it.

    Warns
    -----
    OutsideTrainingWarning
        A command is outside, see `CommandRange`; the channel, the value, the range and the remedy.

    """
    trained = getattr(surrogate, "trained", None)
    if _CHECKED.get() or not isinstance(trained, CommandRange) or not len(commands):
        yield ""
        return
    found = trained.outside(commands, surrogate.rate, surrogate.inputs)
    if found:
        warnings.warn(
            f"commands outside the training range of the surrogate: {found}; its outputs there are "
            "extrapolated. Train it on commands that contain these (fit_surrogate), or use the "
            "twin in its place",
            OutsideTrainingWarning,
            stacklevel=4,
        )
    token = _CHECKED.set(True)
    try:
        yield found
    finally:
        _CHECKED.reset(token)


def checked_once(function: F) -> F:
    """The same function, whose first two arguments are a twin and trajectories.

    Their commands are checked once. The twin may be a surrogate, or may be corrected and have one.
    """

    @wraps(function)
    def checked(*args: Any, **options: Any) -> Any:
        given = signature(function).bind(*args, **options).arguments
        twin, trajectories = list(given.values())[:2]
        with training_checked(getattr(twin, "surrogate", twin), trajectories.commands):
            return function(*args, **options)

    return cast(F, checked)


def outside_training(surrogate: Any, trajectories: Trajectories) -> NDArray:
    """Which trajectories (n,) have commands outside the training range of a surrogate.

    None has where there is no surrogate, or an object in its place.
    """
    trained = getattr(surrogate, "trained", None)
    if not isinstance(trained, CommandRange):
        return np.zeros(len(trajectories), dtype=bool)
    scores = trained.scores(trajectories.commands, trajectories.rate)
    return np.any(scores > 1, axis=(1, 2))
