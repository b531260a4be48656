"""The posterior as a problem on a box: parameters and scales of the noise, from 0 to 1."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from retwin.update.identification.misfit import Misfit
from retwin.update.identification.noise import Noise
from retwin.update.identification.summaries import Summaries

__all__ = ["Problem"]

PREDICTED = 200
"""Draws from the prior that the measured data are held against."""
NOISES = 32
"""Draws of the noise, with scales of their own, through which each simulated path is seen."""
TOGETHER = 64
"""Values of the parameters that are simulated at once."""


class Problem:
    """Points are (k + q,): parameters and logarithms of scales, in widths of their bounds.

    The prior is uniform on the unit box: uniform in the parameters, log-uniform in the scales.

    Attributes
    ----------
    misfit, noise: of the data and of the output error.
    seed: of the draws from the prior.
    low, width: (k + q,) of the box in physical units.
    parameters: k.

    """

    def __init__(self, misfit: Misfit, noise: Noise, seed: int) -> None:
        self.misfit = misfit
        self.noise = noise
        self.seed = seed
        self.parameters = len(misfit.low)
        samples = misfit.seen.shape[1]
        least, greatest = noise.bounds(misfit.spread, misfit.interval, samples)
        self.low = np.concatenate([misfit.low, least])
        self.width = np.concatenate([misfit.high, greatest]) - self.low

    @property
    def size(self) -> int:
        """Dimension of the box."""
        return len(self.low)

    def physical(self, points: NDArray) -> tuple[NDArray, NDArray]:
        """Parameters (m, k) and logarithms of scales (m, q) at points (m, k + q)."""
        values = self.low + self.width * points
        return values[:, : self.parameters], values[:, self.parameters :]

    def log_posterior(self, points: NDArray) -> NDArray:
        """Unnormalised (m,); minus infinity outside the box and where a simulation fails."""
        inside = np.all((points >= 0) & (points <= 1), axis=1)
        out = np.full(len(points), -np.inf)
        if inside.any():
            theta, logs = self.physical(points[inside])
            misfit = self.misfit
            residual = misfit.residuals(theta)
            each = self.noise.log_likelihood(residual, misfit.seen, logs, misfit.interval)
            out[inside] = np.where(np.isfinite(each), each, -np.inf)
        return out

    def paths(self, points: NDArray) -> NDArray:
        """Noise-free paths (m, n, P, d_y) less that at the twin's present values, as residuals."""
        theta, _ = self.physical(points)
        parts = [theta[i : i + TOGETHER] for i in range(0, len(theta), TOGETHER)]
        outputs = np.concatenate([self.misfit.outputs(part) for part in parts])
        off = (outputs - self.misfit.present) / self.misfit.unit
        return np.where(self.misfit.seen, off, 0.0)

    @cached_property
    def prior(self) -> tuple[NDArray, NDArray]:
        """Points from the prior that could be simulated, and their `paths`; simulated once."""
        points = np.random.default_rng(self.seed).random((PREDICTED, self.size))
        paths = self.paths(points)
        good = np.isfinite(paths).all(axis=(1, 2, 3))
        return points[good], paths[good]

    @property
    def box(self) -> NDArray:
        """Least and greatest points, (2, k + q)."""
        return np.array([np.zeros(self.size), np.ones(self.size)])

    def seen_noisily(
        self,
        points: NDArray,
        paths: NDArray,
        box: NDArray,
        summaries: Summaries,
        rng: np.random.Generator,
    ) -> tuple[NDArray, NDArray]:
        """Each of m points, and summaries of its path seen through noise, `NOISES` times.

        (m, NOISES, K) and (m, NOISES, S); the scales of the noise are drawn within the box. That
        costs no simulation.
        """
        low, high = box[:, self.parameters :]
        count, samples, width = self.misfit.seen.shape
        told, known = [], []
        for _ in range(NOISES):
            again = points.copy()
            again[:, self.parameters :] = rng.uniform(low, high, size=(len(points), len(low)))
            logs = np.repeat(self.physical(again)[1], count, axis=0)
            errors = self.noise.draw(rng, logs, samples, width, self.misfit.interval)
            seen = self.misfit.seen
            told.append(again)
            known.append(summaries(paths + errors.reshape(paths.shape) * seen, seen))
        return np.stack(told, axis=1), np.stack(known, axis=1)

    @property
    def measured(self) -> NDArray:
        """The measured path (1, n, P, d_y) in the same terms."""
        return self.misfit.residuals_of(self.misfit.present[None])
