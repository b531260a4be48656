"""Commands of the ArmPi arm: ramps from target to target, in units of 0.24 deg."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.cases.armpi_fpv.plane import STEP
from retwin.twins.samplers import ramps_and_holds

__all__ = ["RAMPS", "STRAIGHT", "ramp_commands", "unit_angles"]

RAMPS = (60, 80, 100)
"""Ramp lengths of a motor, in samples."""
STRAIGHT = 500
"""Command unit of angle 0."""


def unit_angles(commands: NDArray) -> NDArray:
    """Angles in rad of commands in units, any shape: 120 deg - 0.24 deg per unit."""
    return (STRAIGHT - commands) * STEP


def ramp_commands(
    start: ArrayLike,
    targets: ArrayLike,
    ramps: ArrayLike,
    onsets: ArrayLike,
    length: int,
    *,
    closed: ArrayLike = False,
    dtype: type[np.floating] = np.float64,
) -> NDArray:
    """Commands (n, length, motors) that ramp linearly from target to target and hold.

    Parameters
    ----------
    start: (n, motors) before the first movement.
    targets, ramps: (n, M, motors) value reached by each movement and length of its ramp in
        samples.
    onsets: (n, M) fractional sample at which a movement starts; NaN for a movement left out.
    closed: one bool or (n,): a ramp of L samples is `linspace(old, new, L)`, both ends counted,
        instead of lasting L intervals.
    dtype: of the commands.

    """
    spans = np.asarray(ramps, float) - np.reshape(np.asarray(closed, float), (-1, 1, 1))
    start, targets, onsets = (np.asarray(each, float) for each in (start, targets, onsets))
    return ramps_and_holds(start, targets, spans, onsets, length, dtype=dtype)
