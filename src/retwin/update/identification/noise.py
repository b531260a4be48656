"""`Noise`: what is between a twin's outputs and measured ones, besides its parameters.

White noise, and on demand Kennedy and O'Hagan's discrepancy (2001): a Gaussian process on the
output error, here an Ornstein-Uhlenbeck process over time (Matérn 1/2), one of its own for every
trajectory and output. It is integrated out exactly by a Kalman filter, whose cost is linear in the
number of samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from retwin.errors import InputError

__all__ = ["Noise"]

LEAST = 1e-5
"""Least scale of noise and discrepancy, over the spread of the twin's outputs."""


@dataclass(frozen=True)
class Noise:
    """The law of the output error; its scales are inferred with the parameters.

    Scales are log-uniform from 1e-5 to 1 times the spread of the twin's outputs, the time-scale of
    the discrepancy from one sample to the length of a trajectory.

    Parameters
    ----------
    discrepancy: whether there is an error that lasts, next to white noise. Without it, whatever a
        twin cannot do makes the posterior too sure of itself.
    degrees: of freedom of Student's t for the white noise; None is Gaussian, and the discrepancy
        needs that.

    Raises
    ------
    InputError: not more than two degrees of freedom, or Student's t with a discrepancy.

    """

    discrepancy: bool = True
    degrees: float | None = None

    def __post_init__(self) -> None:
        if self.degrees is not None and (self.discrepancy or not self.degrees > 2):
            raise InputError(
                "degrees",
                expected="more than 2 degrees of freedom, or None; None with a discrepancy",
                got=f"{self.degrees} with discrepancy={self.discrepancy}",
                remedy="4 forgives outliers; give discrepancy=False with it",
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Of the scales."""
        return ("noise", "discrepancy", "duration") if self.discrepancy else ("noise",)

    def bounds(self, spread: float, interval: float, samples: int) -> tuple[NDArray, NDArray]:
        """Low and high of the scales' natural logarithms: in units of residuals, and in s."""
        spread = max(spread, 1e-12)
        count = len(self.names)
        low = np.log([spread * LEAST, spread * LEAST, interval][:count])
        high = np.log([spread, spread, interval * max(samples, 2)][:count])
        return low, high

    def log_likelihood(
        self, residual: NDArray, seen: NDArray, logs: NDArray, interval: float
    ) -> NDArray:
        """Of residuals (m, n, P, d) at scales (m, q), (m,); only what was seen (n, P, d) counts."""
        scales = np.exp(logs)
        noise = scales[:, 0, None, None]
        if self.discrepancy:
            amplitude, duration = scales[:, 1:].T
            return _filtered(residual, seen, noise, amplitude, duration, interval)
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
        """Output errors (n, P, d) for scales (n, q)."""
        scales = np.exp(logs)
        shape = (len(logs), samples, width)
        white = rng.normal(size=shape)
        if self.degrees is not None:
            white = rng.standard_t(self.degrees, size=shape)
        error = scales[:, 0, None, None] * white
        if not self.discrepancy:
            return error
        steps = rng.normal(size=shape)
        keep = np.exp(-interval / scales[:, 2])[:, None]
        lasting = steps[:, 0]
        for p in range(samples):
            if p > 0:
                lasting = keep * lasting + np.sqrt(1 - keep**2) * steps[:, p]
            error[:, p] += scales[:, 1, None] * lasting
        return error


def _filtered(
    residual: NDArray,
    seen: NDArray,
    noise: NDArray,
    amplitude: NDArray,
    duration: NDArray,
    interval: float,
) -> NDArray:
    """Log-likelihood (m,) of an Ornstein-Uhlenbeck process seen through white noise."""
    whole = (amplitude**2)[:, None, None]
    keep = np.exp(-interval / duration)[:, None, None]
    mean = np.zeros((*residual.shape[:2], residual.shape[3]))
    variance = whole
    total = np.zeros(len(residual))
    for p in range(residual.shape[2]):
        there = seen[:, p]
        spread = variance + noise**2
        off = residual[:, :, p] - mean
        each = -0.5 * (off**2 / spread + np.log(2 * np.pi * spread))
        total += np.sum(each * there, axis=(1, 2))
        gain = variance / spread
        # Where nothing was seen the state stays as uncertain as it was; nowhere, mostly.
        known = variance * (1 - gain)
        variance = known if there.all() else np.where(there, known, variance)
        mean = keep * (mean + gain * off * there)
        variance = keep**2 * variance + (1 - keep**2) * whole
    return total
