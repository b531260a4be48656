"""`NoisyTwin`: a twin with independent Gaussian noise on its outputs, at its sensor's rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.arrays import interpolated
from retwin.checks import require
from retwin.data.trajectories import Trajectories
from retwin.times import stride_of
from retwin.twins.twin import Chunk, ChunkedTwin, Twin, check_healthy
from retwin.twins.wrappers.wrapper import TwinWrapper, chunk_generator, simulate_chunk

OUTPUT_NOISE = 4
"""The purpose of the random numbers that are the noise, see `chunk_generator`."""


@dataclass(frozen=True, eq=False)
class NoisyTwin(ChunkedTwin, TwinWrapper):
    """Any twin with independent Gaussian noise on every sample of its sensor.

    The baseline that models the discrepancy as white noise: of the right variance, without
    temporal structure.

    Parameters
    ----------
    twin : Twin
        The wrapped twin.
    scale : ndarray, shape (d_y,)
        Standard deviation of a sensor sample, in output units, at least 0; see `residual_scale`.
    sensor_rate : float, optional
        Rate of the sensor in Hz, by which the rate of the data can be divided; by default that of
        the data. In between the noise is interpolated linearly.
    emulated : bool, default False
        Whether the data from which the scale was estimated are emulated.

    Raises
    ------
    InputError
        Not one finite scale of at least 0 per output, or a sensor's rate that does not divide the
        rate of the data.

    """

    twin: Twin
    scale: NDArray
    sensor_rate: float | None = None
    emulated: bool = False

    def __post_init__(self) -> None:
        scale, width = np.asarray(self.scale, dtype=float), len(self.twin.outputs)
        fits = scale.shape == (width,) and bool((np.isfinite(scale) & (scale >= 0)).all())
        expected = f"{width} finite numbers of at least 0, one per output"
        remedy = "estimate it by residual_scale(calibration trajectories)"
        require(fits, "scale", expected=expected, got=scale.tolist(), remedy=remedy)
        object.__setattr__(self, "scale", scale)
        stride_of(self.rate, self.sensor_rate, argument="sensor_rate")

    def _run(self, chunk: Chunk) -> tuple[NDArray, NDArray]:
        """Nominal and observed outputs; noise is added last, to faulty trajectories too."""
        every = stride_of(self.rate, self.sensor_rate)
        rows = np.arange(len(chunk.commands))
        nominal, observed = simulate_chunk(self.twin, chunk, rows, seed=chunk.seed)
        count, steps, width = observed.shape
        shape = (count, sensor_sample_count(steps, every), width)
        noise = self.scale * chunk_generator(chunk.seed, chunk, OUTPUT_NOISE).normal(size=shape)
        return nominal, observed + interpolated(noise, np.arange(steps), every)


def residual_scale(calibration: Trajectories) -> NDArray:
    """Standard deviation of the residual of healthy trajectories (Eq. 11).

    Parameters
    ----------
    calibration : Trajectories
        Healthy or unlabelled trajectories, one at least.

    Returns
    -------
    ndarray, shape (d_y,)
        One per output, in its unit, over all measured samples.

    Raises
    ------
    InputError
        No trajectory, a trajectory with a fault, or an output that was never measured.

    """
    check_healthy("calibration", calibration)
    fits = calibration.mask.any(axis=(0, 1)).all()
    expected = "every output measured somewhere"
    remedy = "give trajectories in which it is, or leave the output out"
    require(fits, "calibration", expected=expected, got="one that never was", remedy=remedy)
    residual = calibration.residual.astype(np.float64)
    return residual.std(axis=(0, 1), where=calibration.mask)


def sensor_sample_count(steps: int, stride: int) -> int:
    """Number of sensor samples between which `steps` data samples are interpolated.

    Parameters
    ----------
    steps : int
        Data samples.
    stride : int
        Data samples per sensor sample.

    Returns
    -------
    int
        One sensor sample per `stride` data samples, and one beyond the last data sample.

    """
    return (steps - 1) // stride + 2
