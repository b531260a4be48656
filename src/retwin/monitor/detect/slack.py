"""The class of distributions of scores for which a monitor's promise holds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv, ndtri

from retwin.checks import finite, require, whole

CENTRE = 2.0
"""Scores beyond this size may be as small as this: bounded and light-tailed noise is in the class,
and bets on a smaller scale, which need few large scores, lose nothing."""
STEP = 0.01
"""Slack from calibration is rounded up to multiples of this, so that streams share tables."""


@dataclass(frozen=True)
class Slack:
    """How far the distribution of scores may be from a standard Gaussian one.

    A score z, given the past and given that it was measured, has a quantile function q. Written
    over the quantiles e of a standard Gaussian distribution, the class is the band

        min(e/κ, κe) - δ ≤ q(e) ≤ max(e/κ, κe) + δ,

    on both sides symmetrically; with κ > 1 scores beyond 2 may be as small as 2, and those beyond
    the clip of the detector's grid, 4, as large as they like. Neither independence nor equal
    distributions are required: the distribution may change with every sample inside the band.

    Parameters
    ----------
    kappa : float
        κ, slack of the scale, from 1 (none) to 10; two-sided.
    shift : float
        δ, the largest mean shift that is not to be detected, from 0 to 3 standard deviations.

    """

    kappa: float = 1.0
    shift: float = 0.0

    def __post_init__(self) -> None:
        finite("kappa", self.kappa, at_least=1, at_most=10)
        finite("shift", self.shift, at_least=0, at_most=3, unit="standard deviations")

    def __str__(self) -> str:
        return f"{self.kappa:g} times as large, shifted by {self.shift:g} standard deviations"

    def upper(self, gaussian: NDArray) -> NDArray:
        """The largest quantiles of the class at Gaussian ones."""
        made: NDArray = np.maximum(gaussian * self.kappa, gaussian / self.kappa) + self.shift
        return np.maximum(made, -CENTRE) if self.kappa > 1 else made

    def lower(self, gaussian: NDArray) -> NDArray:
        """The smallest quantiles of the class at Gaussian ones."""
        return -self.upper(-gaussian)

    def wider(self, factor: float) -> Slack:
        """The class whose κ is as many times as far from 1, and whose δ is as many times as large.

        Both are rounded up to multiples of 0.01, and at most 10 and 3.
        """
        return Slack._up(1 + max(self.kappa - 1, STEP) * factor, max(self.shift, STEP) * factor)

    @classmethod
    def _up(cls, kappa: float, shift: float) -> Slack:
        up = [float(np.ceil(each / STEP - 1e-9) * STEP) for each in (kappa, shift)]
        return cls(min(round(up[0], 2), 10.0), min(round(up[1], 2), 3.0))

    @classmethod
    @lru_cache(maxsize=256)  # streams of one record are many alike
    def of_calibration(
        cls, samples: float, *, parameters: int = 0, confidence: float = 0.95
    ) -> Slack:
        """The slack that ranks among so many calibration samples need.

        The k-th of n calibration samples is a quantile whose probability has a Beta(k, n + 1 - k)
        distribution, whatever the samples' distribution is. `shift` covers the median, and what
        the estimated parameters of the predictive model shift predictions; `kappa` covers all
        other ranks, the most extreme one included, each with probability `confidence`.

        Parameters
        ----------
        samples : float
            Effective number of calibration samples, of `effective_samples`, at least 8.
        parameters : int
            Number of parameters of the predictive model that were estimated from them.
        confidence : float
            From 0.5 to 0.9999.

        Returns
        -------
        Slack
            Rounded up to multiples of 0.01.

        """
        expected = "an effective number of at least 8 independent errors of prediction"
        got = f"{samples:.3g}"
        remedy = "calibrate on longer healthy records; where errors persist for most of a long "
        remedy += "one, the twin does not follow that machine: fit it to the machine first"
        require(8 <= samples < np.inf, "samples", expected=expected, got=got, remedy=remedy)
        count = float(samples)
        finite("confidence", confidence, at_least=0.5, at_most=0.9999)
        variance = (np.pi / 2 + whole("parameters", parameters)) / count
        shift = ndtri((1 + confidence) / 2) * np.sqrt(variance)
        ranks = np.unique(np.geomspace(1, (count + 1) / 2, 200))
        score = -ndtri(ranks / (count + 1))
        far, near = (
            -ndtri(betaincinv(ranks, count + 1 - ranks, (1 + sign * confidence) / 2))
            for sign in (-1, 1)
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            wider = np.where((near > 0) & (score > shift), (score - shift) / near, 1.0)
            narrower = np.where((score < CENTRE) & (far > 0), far / (score + shift), 1.0)
        kappa = max(1.0, float(wider.max()), float(narrower.max()))
        return cls._up(kappa, float(shift))


def effective_samples(scores: NDArray) -> NDArray:
    """Number of independent samples that estimate a distribution as well as correlated ones.

    Parameters
    ----------
    scores : array (streams, T)
        Calibration scores; NaN is missing.

    Returns
    -------
    array (streams,)
        n / (1 + 2 sum of autocorrelations) with the sum over lags until the first pair of
        autocorrelations that is not above its standard error; the smaller number of those for the
        scores and for their sizes, and at most n.

    References
    ----------
    Geyer, Practical Markov chain Monte Carlo, Statistical Science 7 (1992), initial sequences.

    """
    expected = "an array (streams, T)"
    got = f"shape {np.shape(scores)}"
    remedy = "give one row per stream"
    require(np.ndim(scores) == 2, "scores", expected=expected, got=got, remedy=remedy)
    ranks = np.where(np.isfinite(scores), np.clip(scores, -3, 3), np.nan)
    found = [_independent(each) for each in (ranks, np.abs(ranks))]
    return np.minimum(*found)


def _independent(values: NDArray) -> NDArray:
    seen = np.isfinite(values)
    count = seen.sum(axis=1)
    filled = np.where(seen, values, 0.0)
    filled = np.where(seen, filled - (filled.sum(axis=1) / np.maximum(count, 1))[:, None], 0.0)
    lags = max(1, values.shape[1] // 4)
    size = 2 * values.shape[1]
    sums, pairs = (
        np.fft.irfft(np.abs(np.fft.rfft(each, size, axis=1)) ** 2, size, axis=1)[:, : lags + 1]
        for each in (filled, seen.astype(float))
    )
    variance = np.maximum(sums[:, :1] / np.maximum(count, 1)[:, None], np.finfo(float).tiny)
    correlation = (sums / np.maximum(pairs, 1) / variance)[:, 1:]
    even = correlation[:, : correlation.shape[1] // 2 * 2]
    paired = even.reshape(len(even), -1, 2).sum(axis=2)
    limit = 2 * np.sqrt(2 / np.maximum(count, 1))[:, None]
    kept = np.logical_and.accumulate(paired > limit, axis=1)
    time = 1 + 2 * np.sum(np.where(kept, paired, 0.0), axis=1)
    return count / time
