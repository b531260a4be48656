"""Commands of the ArmPi arm: ramps from target to target, in units of 0.24 deg."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.cases.armpi_fpv.plane import STEP
from retwin.twins.ramps import ramps_and_holds

__all__ = ["RAMPS", "STRAIGHT", "ramp_commands", "unit_angles"]

RAMPS = (60, 80, 100)
"""Possible durations of a motor's ramp in samples, as in the published data."""
STRAIGHT = 500
"""Command, in units of 0.24 degrees, at which a motor's angle is 0."""


def unit_angles(commands: NDArray) -> NDArray:
    """Angles of commands, 120 deg - 0.24 deg per unit.

    Parameters
    ----------
    commands : ndarray, any shape
        Commands in units.

    Returns
    -------
    ndarray, same shape
        Angles in rad.

    """
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
    """Commands that ramp linearly from target to target and hold.

    Parameters
    ----------
    start : array_like, shape (n, motors)
        Commands before the first movement.
    targets : array_like, shape (n, M, motors)
        Commands at the end of each movement.
    ramps : array_like, shape (n, M, motors)
        Durations of the ramps in samples.
    onsets : array_like, shape (n, M)
        Onset of each movement in samples, fractions allowed; NaN leaves the movement out.
    length : int
        Samples per trajectory.
    closed : bool or array_like of bool, shape (n,), default False
        Whether a ramp of L samples is `linspace(old, new, L)`, both ends counted, instead of L
        intervals long.
    dtype : type, default float64
        Type of the result.

    Returns
    -------
    ndarray, shape (n, length, motors)
        Commands in the unit of the targets.

    """
    spans = np.asarray(ramps, float) - np.reshape(np.asarray(closed, float), (-1, 1, 1))
    start, targets, onsets = (np.asarray(each, float) for each in (start, targets, onsets))
    return ramps_and_holds(start, targets, spans, onsets, length, dtype=dtype)
