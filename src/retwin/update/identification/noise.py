"""`Noise`: the distribution of the output error, white noise and a correlated discrepancy.

The discrepancy is that of Kennedy and O'Hagan (2001), a Gaussian process on the output error: here
an Ornstein-Uhlenbeck process over time (Matérn 1/2), independent for each trajectory and output. A
Kalman filter integrates it out exactly, at a cost linear in the number of samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from retwin.checks import require

MIN_SCALE = 1e-5
"""Smallest scale of noise and discrepancy, over the standard deviation of the twin's outputs."""


@dataclass(frozen=True)
class Noise:
    """The distribution of the output error; its scales are inferred with the parameters.

    The prior of the scales is log-uniform, from 1e-5 to 1 times the standard deviation of the
    twin's outputs, and that of the discrepancy's time constant from one sample to the length of a
    trajectory.

    Parameters
    ----------
    discrepancy : bool
        Whether the error has a part that is correlated in time beside the white noise. Without it
        the posterior of a twin that cannot fit the data is too narrow.
    degrees : float or None
        Degrees of freedom of Student's t for the white noise, above 2; None is Gaussian, which the
        discrepancy requires.

    Raises
    ------
    InputError
        Not more than two degrees of freedom, or Student's t with a discrepancy.

    """

    discrepancy: bool = True
    degrees: float | None = None

    def __post_init__(self) -> None:
        possible = self.degrees is None or (self.degrees > 2 and not self.discrepancy)
        expected = "more than 2 degrees of freedom, or None; None with a discrepancy"
        got = f"{self.degrees} with discrepancy={self.discrepancy}"
        remedy = "give discrepancy=False; 4 degrees are robust to outliers"
        require(possible, "degrees", expected=expected, got=got, remedy=remedy)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the scales."""
        return ("noise", "discrepancy", "duration") if self.discrepancy else ("noise",)

    def bounds(self, spread: float, interval: float, samples: int) -> tuple[NDArray, NDArray]:
        """Bounds (q,) of the scales' natural logarithms: in units of residuals, and in s."""
        spread = max(spread, 1e-12)
        count = len(self.names)
        low = np.log([spread * MIN_SCALE, spread * MIN_SCALE, interval][:count])
        high = np.log([spread, spread, interval * max(samples, 2)][:count])
        return low, high

    def log_likelihood(
        self, residual: NDArray, seen: NDArray, logs: NDArray, interval: float
    ) -> NDArray:
        """Log-likelihood (m,) at `logs` (m, q) of residuals (m, n, P, d) where `seen` (n, P, d)."""
        scales = np.exp(logs)
        noise = scales[:, 0, None, None]
        if self.discrepancy:
            amplitude, duration = scales[:, 1:].T
            return _filter(residual, seen, noise, amplitude, duration, interval)
        size = residual / noise[..., None]
        if self.degrees is not None:
            each = student.logpdf(size, self.degrees)
        else:
            each = -0.5 * (size**2 + np.log(2 * np.pi))
        each = (each - np.log(noise)[..., None]) * seen
        return each.sum(axis=(1, 2, 3))

    def draw(
        self, rng: np.random.Generator, logs: NDArray, samples: int, width: int, interval: float
    ) -> NDArray:
        """Draws of the output error (n, P, d) at logarithms of scales (n, q)."""
        scales = np.exp(logs)
        shape = (len(logs), samples, width)
        white = rng.normal(size=shape)
        if self.degrees is not None:
            white = rng.standard_t(self.degrees, size=shape)
        error = scales[:, 0, None, None] * white
        if not self.discrepancy:
            return error
        steps = rng.normal(size=shape)
        decay = np.exp(-interval / scales[:, 2])[:, None]
        correlated = steps[:, 0]
        for p in range(samples):
            if p > 0:
                correlated = decay * correlated + np.sqrt(1 - decay**2) * steps[:, p]
            error[:, p] += scales[:, 1, None] * correlated
        return error


def _filter(
    residual: NDArray,
    seen: NDArray,
    noise: NDArray,
    amplitude: NDArray,
    duration: NDArray,
    interval: float,
) -> NDArray:
    """Log-likelihood (m,) of an Ornstein-Uhlenbeck process observed with white noise."""
    stationary = (amplitude**2)[:, None, None]
    decay = np.exp(-interval / duration)[:, None, None]
    mean = np.zeros((*residual.shape[:2], residual.shape[3]))
    variance = stationary
    total = np.zeros(len(residual))
    for p in range(residual.shape[2]):
        measured = seen[:, p]
        total_variance = variance + noise**2
        innovation = residual[:, :, p] - mean
        each = -0.5 * (innovation**2 / total_variance + np.log(2 * np.pi * total_variance))
        total += np.sum(each * measured, axis=(1, 2))
        gain = variance / total_variance
        # Without a measurement there is no update; the shortcut serves complete data.
        updated = variance * (1 - gain)
        variance = updated if measured.all() else np.where(measured, updated, variance)
        mean = decay * (mean + gain * innovation * measured)
        variance = decay**2 * variance + (1 - decay**2) * stationary
    return total
