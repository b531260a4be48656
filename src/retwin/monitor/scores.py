"""Standard Gaussian scores of prediction errors, by their ranks among calibration errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from retwin.checks import require
from retwin.monitor.slack import Slack, effective_samples

__all__ = ["ConformalScores", "fit_scores"]

FEWEST = 8
"""Calibration errors per stream, at least."""


@dataclass(frozen=True)
class ConformalScores:
    """Ranks among calibration errors as intervals of a standard Gaussian distribution.

    Among n calibration errors, an error that k of them are below and m of them not above has a
    conformal p-value between k / (n + 1) and (m + 1) / (n + 1), uniform if it is exchangeable with
    them (Vovk, Gammerman and Shafer, Algorithmic Learning in a Random World, 2005, section 2.2.3).
    Ties and quantisation only widen the interval. Nothing is assumed of the errors' distribution.

    Attributes
    ----------
    errors : complex array (N,)
        Calibration errors, sorted; the stream is the real part.
    quantiles : array (N + 2 streams,)
        Standard Gaussian quantiles at 0, 1 / (n + 1), …, 1, of each stream.
    counts : array (streams,)
        Calibration errors of each stream.
    independent : array (streams,)
        The number of independent ones that are worth as much.

    """

    errors: NDArray
    quantiles: NDArray
    counts: NDArray
    independent: NDArray

    def score(self, errors: ArrayLike) -> tuple[NDArray, NDArray]:
        """Lower and upper ends of the scores of errors, NaN where missing.

        Parameters
        ----------
        errors : array (streams,) or (streams, T)
            Errors like those of the calibration; infinite ones are large.

        """
        given = np.asarray(errors, dtype=float)
        require(
            given.ndim in (1, 2) and len(given) == len(self.counts),
            "errors",
            expected=f"errors of {len(self.counts)} streams",
            got=f"shape {given.shape}",
            remedy="give one row per stream of the calibration",
        )
        streams = np.arange(len(given)).reshape(-1, *(1,) * (given.ndim - 1))
        missing = np.isnan(given)
        key = np.empty(given.shape, dtype=complex)
        key.real, key.imag = streams, np.where(missing, 0.0, given)
        below = np.searchsorted(self.errors, key, side="left") + 2 * streams
        upto = np.searchsorted(self.errors, key, side="right") + 2 * streams + 1
        low, high = (np.where(missing, np.nan, self.quantiles[each]) for each in (below, upto))
        return low, high

    def slack(self, parameters: ArrayLike = 0, confidence: float = 0.95) -> tuple[Slack, ...]:
        """The slack that each stream's calibration needs; see `Slack.of_calibration`.

        `parameters` is one number of estimated parameters for all streams, or one for each.
        """
        each = np.broadcast_to(parameters, self.independent.shape)
        keys = list(zip(np.floor(self.independent).tolist(), each.tolist(), strict=True))
        made = {
            (count, estimated): Slack.of_calibration(
                count, parameters=estimated, confidence=confidence
            )
            for count, estimated in set(keys)
        }
        return tuple(made[key] for key in keys)


def fit_scores(errors: ArrayLike) -> ConformalScores:
    """Scores by the ranks among calibration errors of one-step predictions.

    Parameters
    ----------
    errors : array (streams, T)
        Standardised errors, probability integral transforms, or any other statistic that has one
        distribution while the machine is healthy: of samples that the predictive model was not
        fitted on. NaN is missing; each stream has at least 8 finite ones.

    """
    given = np.asarray(errors, dtype=float)
    seen = np.isfinite(given)
    require(
        given.ndim == 2 and given.size and seen.sum(axis=-1).min() >= FEWEST,
        "errors",
        expected=f"an array (streams, T) with at least {FEWEST} finite errors per stream",
        got=f"shape {given.shape}" + (f" with {seen.sum(axis=-1).min()}" if given.size else ""),
        remedy="calibrate on a longer healthy record",
    )
    counts = seen.sum(axis=1)
    made = np.concatenate(
        [np.sort(row[there]) + 0j for row, there in zip(given, seen, strict=True)]
    )
    made.imag, made.real = made.real.copy(), np.repeat(np.arange(len(given)), counts)
    quantiles = np.concatenate([ndtri(np.arange(count + 2) / (count + 1)) for count in counts])
    fitted = ConformalScores(made, quantiles, counts, counts.astype(float))
    low, high = (np.clip(each, -4, 4) for each in fitted.score(given))
    return ConformalScores(made, quantiles, counts, effective_samples((low + high) / 2))
