"""The posterior density on the unit box of parameters and scales of the noise."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from retwin.update.identification.misfit import Misfit
from retwin.update.identification.noise import Noise
from retwin.update.identification.summaries import Summaries

PRIOR_DRAWS = 200
"""Draws from the prior whose simulations the measured data are compared with."""
NOISES = 32
"""Draws of the noise, each with its own scales, that are added to a simulated path."""


class BoxProblem:
    """Points are (k + q,): parameters and logarithms of scales, in widths of their bounds.

    The prior is uniform on the unit box: uniform in the parameters, log-uniform in the scales.

    Parameters
    ----------
    misfit : Misfit
        Twin and measured data.
    noise : Noise
        Distribution of the output error.
    seed : int
        Seed of the draws from the prior.

    Attributes
    ----------
    low, width : NDArray
        (k + q,), lower corner and edges of the box in physical units.
    parameters : int
        k.

    """

    def __init__(self, misfit: Misfit, noise: Noise, seed: int) -> None:
        self.misfit = misfit
        self.noise = noise
        self.seed = seed
        self.parameters = len(misfit.low)
        samples = misfit.seen.shape[1]
        low, high = noise.bounds(misfit.spread, misfit.interval, samples)
        self.low = np.concatenate([misfit.low, low])
        self.width = np.concatenate([misfit.high, high]) - self.low

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

    def paths(self, points: NDArray, *, values_per_batch: int = 64) -> NDArray:
        """Noise-free outputs (m, n, P, d_y) minus the present ones, in residual units.

        Parameters
        ----------
        values_per_batch : int, default 64
            Values of the parameters that are simulated in one batch, which bounds the memory.

        """
        theta, _ = self.physical(points)
        parts = [theta[i : i + values_per_batch] for i in range(0, len(theta), values_per_batch)]
        outputs = np.concatenate([self.misfit.outputs(part) for part in parts])
        difference = (outputs - self.misfit.present) / self.misfit.unit
        return np.where(self.misfit.seen, difference, 0.0)

    @cached_property
    def prior(self) -> tuple[NDArray, NDArray]:
        """Points from the prior whose simulation succeeds, and their `paths`; computed once."""
        points = np.random.default_rng(self.seed).random((PRIOR_DRAWS, self.size))
        paths = self.paths(points)
        good = np.isfinite(paths).all(axis=(1, 2, 3))
        return points[good], paths[good]

    @property
    def box(self) -> NDArray:
        """Lower and upper corner, (2, k + q)."""
        return np.array([np.zeros(self.size), np.ones(self.size)])

    def with_noise(
        self,
        points: NDArray,
        paths: NDArray,
        box: NDArray,
        summaries: Summaries,
        rng: np.random.Generator,
    ) -> tuple[NDArray, NDArray]:
        """Points (m, NOISES, K) and summaries (m, NOISES, S) of their paths with drawn noise.

        The scales of the noise are drawn within `box`; this costs no simulation.
        """
        low, high = box[:, self.parameters :]
        count, samples, width = self.misfit.seen.shape
        drawn, summarised = [], []
        for _ in range(NOISES):
            again = points.copy()
            again[:, self.parameters :] = rng.uniform(low, high, size=(len(points), len(low)))
            logs = np.repeat(self.physical(again)[1], count, axis=0)
            errors = self.noise.draw(rng, logs, samples, width, self.misfit.interval)
            seen = self.misfit.seen
            drawn.append(again)
            summarised.append(summaries(paths + errors.reshape(paths.shape) * seen, seen))
        return np.stack(drawn, axis=1), np.stack(summarised, axis=1)

    @property
    def measured(self) -> NDArray:
        """The measured outputs (1, n, P, d_y) minus the present ones, in residual units."""
        return self.misfit.residuals_of(self.misfit.present[None])
