"""Summary statistics of measured outputs for the inference of parameters and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.covariance import LedoitWolf

LAGS = (1, 2, 4, 8, 16)
"""Lags, in samples, at which the increments of the noise are summarised."""


@dataclass(frozen=True, eq=False)
class Principal:
    """Principal components of noise-free simulated data.

    Attributes
    ----------
    components : NDArray
        (c, N), principal directions of flattened data.
    mean : NDArray
        (N,), their mean.

    """

    components: NDArray
    mean: NDArray

    @classmethod
    def of(cls, data: NDArray, *, components: int = 20, rank_tolerance: float = 1e-4) -> Principal:
        """The components of simulated data (m, ...).

        Parameters
        ----------
        components : int, default 20
            Largest number of principal components.
        rank_tolerance : float, default 1e-4
            Components whose singular value is below this share of the largest are left out.

        """
        flat = data.reshape(len(data), -1)
        mean = flat.mean(axis=0)
        _, singular, directions = np.linalg.svd(flat - mean, full_matrices=False)
        kept = singular > rank_tolerance * singular.max(initial=0.0)
        return cls(directions[kept][:components], mean)

    def __call__(self, data: NDArray, seen: NDArray) -> tuple[NDArray, NDArray]:
        """Scores (m, c) of data (m, ...), and the remainder, which is 0 where not `seen`."""
        centred = data.reshape(len(data), -1) - self.mean * seen.ravel()
        scores = centred @ self.components.T
        return scores, (centred - scores @ self.components).reshape(data.shape) * seen


@dataclass(frozen=True, eq=False)
class Summaries:
    """Summary statistics of a set of output paths.

    The scores of the principal components of noise-free simulated paths depend on the parameters.
    So do those of the steps from sample to sample, which a correlated error hardly affects. The
    mean square of the remainder, and of its increments over several lags, depend on the noise.

    Attributes
    ----------
    paths, steps : Principal
        Principal components of the paths and of their steps.

    """

    paths: Principal
    steps: Principal

    @classmethod
    def of(cls, paths: NDArray) -> Summaries:
        """The summaries that noise-free paths (m, n, P, d_y) define."""
        return cls(Principal.of(paths), Principal.of(np.diff(paths, axis=2)))

    def __call__(self, paths: NDArray, seen: NDArray) -> NDArray:
        """Summaries (m, s) of paths (m, n, P, d_y), 0 where nothing was `seen` (n, P, d_y)."""
        scores, remainder = self.paths(paths, seen)
        both = seen[:, 1:] & seen[:, :-1]
        step_scores, _ = self.steps(np.diff(paths, axis=2) * both, both)
        powers = [np.sum(remainder**2, axis=(1, 2, 3)) / seen.sum()]
        for lag in LAGS:
            if lag < paths.shape[2] // 2:
                both = seen[:, lag:] & seen[:, :-lag]
                steps = (remainder[:, :, lag:] - remainder[:, :, :-lag]) ** 2 * both
                powers.append(np.sum(steps, axis=(1, 2, 3)) / max(both.sum(), 1))
        return np.column_stack([scores, step_scores, np.log(np.array(powers).T + 1e-300)])


def outlyingness(measured: NDArray, simulated: NDArray) -> float:
    """The p-value of measured summaries (s,) among simulated ones (m, s), by Mahalanobis distance.

    Half of the simulated summaries give mean and covariance, the others the distribution of the
    distance.
    """
    half = len(simulated) // 2
    # Standardised, so that the shrinkage of the covariance treats all summaries alike.
    scale = simulated[:half].std(axis=0).clip(1e-12)
    distribution = LedoitWolf().fit(simulated[:half] / scale)
    distance = distribution.mahalanobis(np.concatenate([measured[None], simulated[half:]]) / scale)
    return float((1 + np.sum(distance[1:] >= distance[0])) / len(distance))
