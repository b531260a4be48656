"""The posterior density on the unit box of parameters and scales of the noise.

`Noise` is the distribution of the output error, white noise and a correlated discrepancy, and
`Summaries` are statistics of outputs by which both are inferred. The discrepancy is that of Kennedy
and O'Hagan (2001), a Gaussian process on the output error: here an Ornstein-Uhlenbeck process over
time (Matérn 1/2), independent for each trajectory and output. A Kalman filter integrates it out
exactly, at a cost linear in the number of samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student
from sklearn.covariance import LedoitWolf

from retwin.checks import require
from retwin.update.identification.misfit import Misfit

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
        # Draws from the prior whose simulations the measured data are compared with.
        points = np.random.default_rng(self.seed).random((200, self.size))
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
