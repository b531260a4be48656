"""`Prediction`: the distribution of each sample given all earlier ones, by a Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri
from scipy.stats import norm

from retwin.checks import finite, require
from retwin.data.trajectories import Trajectories
from retwin.scores.residuals import Correlogram, autocorrelation, ljung_box

__all__ = ["Narrowing", "Prediction", "log_density", "root_of", "whitened"]


@dataclass(frozen=True, eq=False)
class Prediction:
    """Gaussian distributions of the outputs of a record, each given all earlier samples.

    After a gap, or after the last measured sample, they are those of a simulation that starts from
    what is known then.

    Attributes
    ----------
    record : Trajectories
        The n trajectories that were predicted.
    mean : NDArray
        (n, T, d_y).
    covariance : NDArray
        (n, T, d_y, d_y), with measurement noise.
    states : NDArray
        (n, T, d_x), the most probable states given all samples up to the present one.

    """

    record: Trajectories
    mean: NDArray
    covariance: NDArray
    states: NDArray

    @property
    def deviation(self) -> NDArray:
        """Standard deviations (n, T, d_y)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=2, axis2=3))

    def quantile(self, level: ArrayLike) -> NDArray:
        """Quantiles of each output: (..., n, T, d_y) for levels (...)."""
        levels = np.asarray(level, dtype=float)
        inside = ((levels > 0) & (levels < 1)).all()
        expected = "probabilities between 0 and 1"
        require(inside, "level", expected=expected, got=level, remedy="give 0.95, not 95")
        return self.mean + ndtri(levels[..., None, None, None]) * self.deviation

    def pit(self) -> NDArray:
        """Probability-integral transforms (n, T, d_y) of the measured outputs; NaN for others.

        They are uniform and independent if the distributions are those of the data.
        """
        return norm.cdf(self.standardised())

    def coverage(self, share: float = 0.9) -> NDArray:
        """Share (d_y,) of the measured samples inside the central interval of that probability.

        NaN for an output of which no sample is measured.
        """
        finite("share", share, at_least=0.0, at_most=1.0)
        inside = np.abs(self.standardised()) <= ndtri((1 + share) / 2)
        counted: NDArray = self.record.mask.sum(axis=(0, 1))
        held = (inside & self.record.mask).sum(axis=(0, 1))
        return np.where(counted > 0, held / np.maximum(counted, 1), np.nan)

    def whiteness(self) -> list[tuple[Correlogram, float]]:
        """Autocorrelation of the errors of each output, and the p-value of Ljung and Box's test.

        Errors of predictions by the right distributions are white noise.
        """
        found = [autocorrelation(each) for each in np.moveaxis(self.standardised(), -1, 0)]
        return [(each, ljung_box(each)[1]) for each in found]

    def marginal(self, slopes: NDArray) -> Prediction:
        """The same for parameters that are standard Gaussian, on which the means depend linearly.

        Recursive least squares: each sample narrows the distribution of the parameters with which
        later ones are predicted. `states` stay those at the most probable parameters.

        Parameters
        ----------
        slopes : NDArray
            (n, T, d_y, r), derivatives of the means.

        """
        count, width = len(self.mean), slopes.shape[-1]
        narrowing = Narrowing(np.zeros((count, width)), np.tile(np.eye(width), (count, 1, 1)))
        given = self.mean, self.covariance, self.record.observed, self.record.mask
        mean, covariance = narrowing.run(*given, slopes)
        return replace(self, mean=mean, covariance=covariance)

    def log_density(self) -> NDArray:
        """Log density (n, T) of the measured outputs of each sample, jointly; 0 for none."""
        return log_density(self.record.observed - self.mean, self.covariance, self.record.mask)

    def standardised(self) -> NDArray:
        """Errors (n, T, d_y) in standard deviations; NaN where nothing was measured."""
        error = (self.record.observed - self.mean) / self.deviation
        return np.where(self.record.mask, error, np.nan)


@dataclass(eq=False)
class Narrowing:
    """Recursive least squares: each sample narrows the distribution of Gaussian parameters.

    Attributes
    ----------
    centre, root : NDArray
        (n, r) and (n, r, r), their mean and a factor of their covariance; both change.

    """

    centre: NDArray
    root: NDArray

    def run(
        self,
        mean: NDArray,
        covariance: NDArray,
        measured: NDArray,
        seen: NDArray,
        slopes: NDArray,
        gate: float = np.inf,
    ) -> tuple[NDArray, NDArray]:
        """Means and covariances with the uncertainty of the parameters, before each sample.

        Parameters
        ----------
        mean, covariance : NDArray
            (n, T, d_y) and (n, T, d_y, d_y), at the parameters 0.
        measured, seen : NDArray
            (n, T, d_y), outputs, and whether each is used.
        slopes : NDArray
            (n, T, d_y, r), derivatives of the means.
        gate : float
            An error of more standard deviations is no news of the parameters.

        """
        mean, covariance = mean.copy(), covariance.copy()
        factor = root_of(covariance, seen)
        white = np.linalg.solve(factor, np.where(seen[..., None], slopes, 0.0))
        white = np.where(np.isfinite(white), white, 0.0)
        errors = whitened(measured - mean, factor, seen)  # NaN, where not finite, is no news
        for t in range(mean.shape[1]):
            mean[:, t] += (slopes[:, t] @ self.centre[..., None])[..., 0]
            h = slopes[:, t] @ self.root
            covariance[:, t] += h @ h.swapaxes(1, 2)
            # Potter's update of a factor of the covariance, which rounding cannot make negative.
            for own, error in zip(white[:, t].swapaxes(0, 1), errors[:, t].T, strict=True):
                f = (own[:, None] @ self.root)[:, 0]
                variance = 1 + np.sum(f**2, axis=1)
                gain = (self.root @ f[..., None])[..., 0] / variance[:, None]
                news = error - np.sum(own * self.centre, axis=1)
                used = np.abs(news) <= gate * np.sqrt(variance)
                gain = np.where(used[:, None], gain, 0.0)
                self.centre = self.centre + gain * np.where(used, news, 0.0)[:, None]
                narrowed = gain / (1 + 1 / np.sqrt(variance))[:, None]
                self.root = self.root - narrowed[..., None] * f[:, None]
        return mean, covariance


def log_density(error: NDArray, covariance: NDArray, seen: NDArray) -> NDArray:
    """Log density (n, T) of Gaussian errors (n, T, d_y), of which those `seen` count, jointly."""
    factor = root_of(covariance, seen)
    white = whitened(error, factor, seen)
    constant = seen.sum(axis=2) * np.log(2 * np.pi)
    logs = np.log(np.diagonal(factor, axis1=2, axis2=3)).sum(axis=2)
    return -0.5 * (np.sum(white**2, axis=2) + constant) - logs


def root_of(covariance: NDArray, seen: NDArray) -> NDArray:
    """Lower factors (n, T, d_y, d_y) of covariances; an output that is not seen has variance 1.

    NaN where a covariance is not finite or not positive definite, as where a filter diverges.
    """
    both, unit = seen[..., :, None] & seen[..., None, :], np.eye(seen.shape[2])
    own = np.where(both, covariance, unit)
    good = np.asarray(np.isfinite(own).all(axis=(2, 3)))
    try:
        made = np.linalg.cholesky(np.where(good[..., None, None], own, unit))
    except np.linalg.LinAlgError:
        own = np.where(good[..., None, None], own, unit)
        good &= np.linalg.eigvalsh(own).min(axis=2) > 0
        made = np.linalg.cholesky(np.where(good[..., None, None], own, unit))
    return np.where(good[..., None, None], made, np.nan)


def whitened(error: NDArray, factor: NDArray, seen: NDArray) -> NDArray:
    """Errors (n, T, d_y) that are independent and of variance 1; 0 for those that are not seen."""
    own = np.where(seen, error, 0.0)[..., None]
    return np.linalg.solve(factor, own)[..., 0]
