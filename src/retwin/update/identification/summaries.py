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
class Principal:
    """The directions in which noise-free simulated data differ most.

    Attributes
    ----------
    components: (c, N) principal directions of flattened data.
    middle: (N,) their mean.

    """

    components: NDArray
    middle: NDArray

    @classmethod
    def of(cls, data: NDArray) -> Principal:
        """From simulated data (m, ...)."""
        flat = data.reshape(len(data), -1)
        middle = flat.mean(axis=0)
        _, singular, directions = np.linalg.svd(flat - middle, full_matrices=False)
        known = singular > FLAT * singular.max(initial=0.0)
        return cls(directions[known][:COMPONENTS], middle)

    def __call__(self, data: NDArray, seen: NDArray) -> tuple[NDArray, NDArray]:
        """Scores (m, c) of data (m, ...), and what they leave over; 0 where nothing was seen."""
        off = data.reshape(len(data), -1) - self.middle * seen.ravel()
        scores = off @ self.components.T
        return scores, (off - scores @ self.components).reshape(data.shape) * seen


@dataclass(frozen=True, eq=False)
class Summaries:
    """Where a set of paths lies on the manifold that the twin can reach, and how far off it is.

    Principal components of noise-free simulated paths say where. So do those of their steps from
    sample to sample: an error that lasts spoils the paths, and hardly the steps. What the former
    leave over is noise: its size, and how it differs from itself some samples later, say of what
    kind.

    Attributes
    ----------
    paths, steps: the principal directions of both.

    """

    paths: Principal
    steps: Principal

    @classmethod
    def of(cls, paths: NDArray) -> Summaries:
        """From noise-free paths (m, n, P, d_y)."""
        return cls(Principal.of(paths), Principal.of(np.diff(paths, axis=2)))

    def __call__(self, paths: NDArray, seen: NDArray) -> NDArray:
        """Summaries (m, s) of paths (m, n, P, d_y), 0 where nothing was `seen` (n, P, d_y)."""
        scores, rest = self.paths(paths, seen)
        both = seen[:, 1:] & seen[:, :-1]
        quick, _ = self.steps(np.diff(paths, axis=2) * both, both)
        told = [np.sum(rest**2, axis=(1, 2, 3)) / seen.sum()]
        for lag in LAGS:
            if lag < paths.shape[2] // 2:
                both = seen[:, lag:] & seen[:, :-lag]
                steps = (rest[:, :, lag:] - rest[:, :, :-lag]) ** 2 * both
                told.append(np.sum(steps, axis=(1, 2, 3)) / max(both.sum(), 1))
        return np.column_stack([scores, quick, np.log(np.array(told).T + 1e-300)])


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
