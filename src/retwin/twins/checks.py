"""What several kinds of twins ask of their settings."""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from retwin.errors import InputError

__all__ = ["check_positive", "ideal_outputs", "substeps"]

NEAR = 1e-5
"""How far, as a share, steps may be from a whole number per sample: decimals are rounded."""


def check_positive(argument: str, value: float, unit: str) -> None:
    """InputError for anything but a finite number above 0."""
    if not (isinstance(value, int | float | np.number) and isfinite(value) and value > 0):
        raise InputError(
            argument,
            expected=f"a positive number of {unit}",
            got=repr(value),
            remedy=f"give it in {unit}",
        )


def substeps(rate: float, step: float) -> int:
    """Steps of `step` s in a sample period at `rate` Hz.

    Raises InputError when it is no whole number of them.
    """
    check_positive("rate", rate, "Hz")
    check_positive("step", step, "s")
    count = round(1.0 / (rate * step))
    if count < 1 or abs(count * step * rate - 1.0) > NEAR:
        raise InputError(
            "step",
            expected=f"a step that divides the sample period, {1.0 / rate:g} s",
            got=f"{step:g} s",
            remedy=f"give for instance step={1.0 / (rate * max(count, 1)):g}",
        )
    return count


def ideal_outputs(nominal: Callable[[NDArray], NDArray], commands: NDArray, width: int) -> NDArray:
    """What a user's `nominal` gives for `commands` (n, T, d_u), outputs (n, T, width).

    Raises InputError when it gives another shape, or NaN or infinite numbers.
    """
    outputs = np.asarray(nominal(commands))
    shape = (*commands.shape[:2], width)
    fits = outputs.shape == shape and outputs.dtype.kind in "fiub"
    if not (fits and np.isfinite(outputs).all()):
        raise InputError(
            "nominal",
            expected=f"a function that gives finite outputs of shape {shape}",
            got="NaN or an infinite number" if fits else f"{outputs.dtype}, {outputs.shape}",
            remedy="give the ideal outputs (n, T, d_y) for commands (n, T, d_u)",
        )
    return outputs
