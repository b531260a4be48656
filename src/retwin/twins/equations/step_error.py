"""The error of the steps through time of state equations, by comparison with half as long ones."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Channels

ACCURACY = 0.01
"""Largest error of the steps through time, in standard deviations of an output, that passes without
a warning. It should be small compared with a discrepancy that is worth modelling."""


class StepWarning(UserWarning):
    """The steps through time are too coarse for the equations."""


def warn_of_coarse_steps(
    outputs: NDArray, finer: NDArray, channels: Channels, substeps: int
) -> None:
    """Warn of the output with the largest error, if that exceeds `ACCURACY`.

    Parameters
    ----------
    outputs, finer : ndarray, shape (T, d_y)
        A simulation, and the same with twice as many sub-steps.
    channels : Channels
        Names and units of the outputs.
    substeps : int
        Sub-steps per sample of the former.

    Warns
    -----
    StepWarning
        The root mean square difference is more than 1 % of the output's standard deviation.

    """
    # In sizes of the outputs, which may grow beyond what can be squared.
    size = np.maximum(np.abs(outputs).max(axis=0), np.abs(finer).max(axis=0))
    size = np.where(size > 0, size, 1.0)
    error = np.sqrt(np.mean((outputs / size - finer / size) ** 2, axis=0))
    # An output that hardly varies is compared with its size, of which rounding is a fraction.
    allowed = ACCURACY * np.maximum((finer / size).std(axis=0), 1e-6)
    worst = int(np.argmax(error / allowed))
    if error[worst] <= allowed[worst]:
        return
    error = error * size
    warnings.warn(
        f"{channels.names[worst]} has an error of {error[worst]:.1g} {channels.units[worst]} with "
        f"substeps={substeps}, over 1 % of its standard deviation; give more substeps",
        StepWarning,
        stacklevel=3,
    )
