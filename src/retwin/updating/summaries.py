"""A few numbers that tell most of what measured outputs say of parameters and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.covariance import LedoitWolf

__all__ = ["Summaries", "outlyingness"]

COMPONENTS = 20
FLAT = 1e-4
"""Directions in which paths move less than this share of the most are left out."""
LAGS = (1, 2, 4, 8, 16)


@dataclass(frozen=True, eq=False)
class Summaries:
    """Where a set of paths lies on the manifold that the twin can reach, and how far off it is.

    Principal components of noise-free simulated paths say where. What they leave over is noise:
    its size, and how it differs from itself some samples later, say of what kind.

    Attributes
    ----------
    components: (c, N) principal directions of flattened paths, N = n P d_y.
    middle: (N,) mean path.
    shape: (n, P, d_y).

    """

    components: NDArray
    middle: NDArray
    shape: tuple[int, ...]

    @classmethod
    def of(cls, paths: NDArray) -> Summaries:
        """From noise-free paths (m, n, P, d_y)."""
        flat = paths.reshape(len(paths), -1)
        middle = flat.mean(axis=0)
        _, singular, directions = np.linalg.svd(flat - middle, full_matrices=False)
        known = singular > FLAT * singular.max(initial=0.0)
        return cls(directions[known][:COMPONENTS], middle, paths.shape[1:])

    def __call__(self, paths: NDArray, seen: NDArray) -> NDArray:
        """Summaries (m, s) of paths (m, n, P, d_y), 0 where nothing was `seen` (n, P, d_y)."""
        off = paths.reshape(len(paths), -1) - self.middle * seen.ravel()
        scores = off @ self.components.T
        rest = (off - scores @ self.components).reshape(len(paths), *self.shape) * seen
        told = [np.sum(rest**2, axis=(1, 2, 3)) / seen.sum()]
        for lag in LAGS:
            if lag < self.shape[1] // 2:
                both = seen[:, lag:] & seen[:, :-lag]
                steps = (rest[:, :, lag:] - rest[:, :, :-lag]) ** 2 * both
                told.append(np.sum(steps, axis=(1, 2, 3)) / max(both.sum(), 1))
        return np.column_stack([scores, np.log(np.array(told).T + 1e-300)])


def outlyingness(measured: NDArray, simulated: NDArray) -> float:
    """Share of simulated summaries (m, s) as far out as the measured ones (s,), by Mahalanobis.

    Half of them say what is usual, the others how far out is usual.
    """
    half = len(simulated) // 2
    # Ratios of neighbouring lags tell white from lasting: standardised, none drowns another.
    scale = simulated[:half].std(axis=0).clip(1e-12)
    law = LedoitWolf().fit(simulated[:half] / scale)
    far = law.mahalanobis(np.concatenate([measured[None], simulated[half:]]) / scale)
    return float((1 + np.sum(far[1:] >= far[0])) / len(far))
