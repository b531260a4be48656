"""Standard Gaussian scores of prediction errors, by their ranks among calibration errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, ndtri

from retwin.checks import require, whole
from retwin.monitor.detect.bets import CLIP
from retwin.monitor.detect.slack import Slack, effective_samples
from retwin.serialisation.models import check_weights

MIN_ERRORS = 8
"""Calibration errors per stream, at least."""
COPIES = 8
"""Places inside a rounding interval that stand for a rounded error."""
SCALES = np.geomspace(0.05, 2, 32)
"""Standard deviations of errors before rounding, relative to those after it."""


@dataclass(frozen=True)
class ConformalScores:
    """Ranks among calibration errors as intervals of a standard Gaussian distribution.

    Among n calibration errors, an error that k of them are below and m of them not above has a
    conformal p-value between k / (n + 1) and (m + 1) / (n + 1), uniform if it is exchangeable with
    them (Vovk, Gammerman and Shafer, Algorithmic Learning in a Random World, 2005, section 2.2.3).
    Ties only widen the interval. Nothing is assumed of the errors' distribution.

    A rounded sample is known to be in an interval only, and its error given the past has few
    possible values, which depend on the prediction. A rounded calibration error therefore counts in
    equal parts at several places of its interval, those of a Gaussian distribution of the scale
    that maximises the likelihood of all intervals, and the score of a rounded error is the
    interval of ranks that its own interval spans.

    Attributes
    ----------
    errors : complex array (N,)
        Calibration errors, each `copies` times, sorted; the stream is the real part.
    quantiles : array
        For each stream the standard Gaussian quantiles at equal steps from 0 to 1, as many as
        there are ranks.
    copies : int
        Places that stand for one error: 1 if nothing is rounded.
    independent : array (streams,)
        The number of independent errors that are worth as much.

    """

    errors: NDArray
    quantiles: NDArray
    copies: int
    independent: NDArray

    def score(self, errors: ArrayLike, width: ArrayLike = 0.0) -> tuple[NDArray, NDArray]:
        """Lower and upper ends of the scores of errors, NaN where missing.

        Parameters
        ----------
        errors : array (streams, ...)
            Errors like those of the calibration; infinite ones are large.
        width : float or array like errors
            Widths of their rounding intervals: see `fit_scores`.

        """
        given = np.asarray(errors, dtype=float)
        fits = given.ndim and len(given) == len(self.independent)
        expected = f"errors of {len(self.independent)} streams"
        remedy = "give one row per stream of the calibration"
        require(fits, "errors", expected=expected, got=f"shape {given.shape}", remedy=remedy)
        streams = np.arange(len(given)).reshape(-1, *(1,) * (given.ndim - 1))
        half = np.asarray(width, dtype=float) / 2 if self.copies > 1 else 0.0
        missing = np.isnan(given + half)
        low_key, high_key = (
            _key(streams, np.where(missing, 0.0, end)) for end in (given - half, given + half)
        )
        first = (self.copies + 1) * streams  # more ranks than errors in each stream before
        below = np.searchsorted(self.errors, low_key, side="left") + first
        upto = np.searchsorted(self.errors, high_key, side="right") + first + self.copies
        low, high = (np.where(missing, np.nan, self.quantiles[rank]) for rank in (below, upto))
        return low, high

    def arrays(self) -> dict[str, NDArray]:
        """All but `copies`, as real arrays by name."""
        return {
            "stream": self.errors.real,
            "error": self.errors.imag,
            "quantiles": self.quantiles,
            "independent": self.independent,
        }

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray], copies: int) -> ConformalScores:
        """The scores of what `arrays` gave; InputError if they do not belong together."""
        errors = np.empty(len(arrays["error"]), dtype=complex)
        errors.real, errors.imag = arrays["stream"], arrays["error"]
        quantiles, independent = arrays["quantiles"], arrays["independent"]
        ranks = len(errors) + len(independent) * (whole("copies", copies, at_least=1) + 1)
        check_weights(len(quantiles) == ranks, f"{ranks} quantiles, one per rank", len(quantiles))
        return cls(errors, quantiles, copies, independent)

    def slack(self, parameters: ArrayLike = 0, confidence: float = 0.95) -> tuple[Slack, ...]:
        """The slack that each stream's calibration needs; see `Slack.of_calibration`.

        `parameters` is one number of estimated parameters for all streams, or one for each.
        """
        each = np.broadcast_to(parameters, self.independent.shape).tolist()
        pairs = zip(np.floor(self.independent).tolist(), each, strict=True)
        return tuple(
            Slack.of_calibration(count, parameters=estimated, confidence=confidence)
            for count, estimated in pairs
        )


def fit_scores(errors: ArrayLike, width: ArrayLike = 0.0) -> ConformalScores:
    """Scores by the ranks among calibration errors of one-step predictions.

    Parameters
    ----------
    errors : array (streams, T)
        Standardised errors, probability integral transforms, or any other statistic that has one
        distribution while the machine is healthy: of samples that the predictive model was not
        fitted on. NaN is missing; each stream has at least 8 finite ones.
    width : float or array that broadcasts to errors
        Widths of the intervals to which samples are rounded, in the unit of the errors: the
        `resolution` of the sensor over the standard deviation of the prediction. 0 is none.

    """
    given = np.asarray(errors, dtype=float)
    widths = np.broadcast_to(np.asarray(width, dtype=float), given.shape)
    seen = np.isfinite(given) & np.isfinite(widths)
    enough = given.ndim == 2 and given.size and seen.sum(axis=-1).min() >= MIN_ERRORS
    expected = f"an array (streams, T) with at least {MIN_ERRORS} finite errors per stream"
    got = f"shape {given.shape}" + (f" with {seen.sum(axis=-1).min()}" if given.size else "")
    remedy = "calibrate on a longer healthy record"
    require(enough, "errors", expected=expected, got=got, remedy=remedy)
    rounded = bool(np.any(widths[seen] > 0))
    copies = COPIES if rounded else 1
    rows = [
        np.sort(_spread(row[there], wide[there]).ravel() if rounded else row[there])
        for row, wide, there in zip(given, widths, seen, strict=True)
    ]
    keys = np.concatenate([_key(np.array(i), row) for i, row in enumerate(rows)])
    ranks = [len(row) + copies for row in rows]
    quantiles = np.concatenate([ndtri(np.arange(count + 1) / count) for count in ranks])
    fitted = ConformalScores(keys, quantiles, copies, seen.sum(axis=1).astype(float))
    return replace(fitted, independent=effective_samples(middle(*fitted.score(given, widths))))


def middle(low: NDArray, high: NDArray) -> NDArray:
    """Middles of intervals of scores, each end from -4 to 4: larger ones are not distinguished."""
    return (np.clip(low, -CLIP, CLIP) + np.clip(high, -CLIP, CLIP)) / 2


def resolution(measured: ArrayLike) -> NDArray:
    """The steps to which a sensor rounds, 0 where it does not.

    Samples that were interpolated to a common rate, or written with few decimals, are not exact
    multiples any more, but those that repeat the one before are, to a twentieth of a step.

    Parameters
    ----------
    measured : array (streams, T)
        Measured outputs, not residuals; NaN is missing.

    Returns
    -------
    array (streams,)
        The largest difference of two values of a stream of which all values are multiples from
        each other: of all values if less than half of them are different, else of repeated ones.

    """
    given = np.asarray(measured, dtype=float)
    return np.array([_step_of(row[np.isfinite(row)]) for row in given])


def _step_of(seen: NDArray, *, inexact: float = 0.05, repeated_share: float = 0.02) -> float:
    """The step of finite values (n,), 0 for none.

    Parameters
    ----------
    inexact : float, default 0.05
        Share of a step by which a value may be no multiple of it.
    repeated_share : float, default 0.02
        Share of samples that repeat the one before from which on a sensor may round.

    """
    values = np.unique(seen)
    if len(values) >= len(seen) / 2:
        repeated = seen[1:][np.diff(seen) == 0]
        values = np.unique(repeated) if len(repeated) > repeated_share * len(seen) else values[:0]
    if len(values) < 2:
        return 0.0
    offsets, gaps = values - values[0], np.diff(values)
    for step in np.unique(gaps)[::-1]:
        # Small gaps first, since the error of a step adds up over many.
        # Steps up to which a difference is counted with a step that is not exact yet.
        near = gaps < 10.0 * step
        many = np.round(gaps[near] / step)
        better = float(many @ gaps[near] / (many @ many))
        number = np.concatenate([[0], np.cumsum(np.round(gaps / better))])
        exact = float(number @ offsets / (number @ number))
        if np.all(np.abs(offsets - exact * number) <= inexact * exact):
            return exact
    return 0.0


def _key(stream: NDArray, value: NDArray) -> NDArray:
    """Complex numbers, which numpy sorts by the real part and then by the imaginary one."""
    made = np.empty(np.broadcast_shapes(stream.shape, value.shape), dtype=complex)
    made.real, made.imag = stream, value
    return made


def _spread(errors: NDArray, width: NDArray) -> NDArray:
    """Places (n, COPIES) of equal probability inside the rounding intervals of errors (n,)."""
    # In the lower tail, where differences of probabilities keep their digits.
    sign, centre, half = np.sign(errors), -np.abs(errors), width / 2
    likelihood = [np.sum(np.log(_mass(centre, half, scale)[1])) for scale in SCALES]
    scale = SCALES[int(np.argmax(likelihood))]
    first, mass = _mass(centre, half, scale)
    inside = first[:, None] + mass[:, None] * (np.arange(COPIES) + 0.5) / COPIES
    least, most = (centre - half)[:, None], (centre + half)[:, None]
    made = np.clip(scale * ndtri(inside), least, most)
    return np.where(sign[:, None] > 0, -made, made)


def _mass(centre: NDArray, half: NDArray, scale: float) -> tuple[NDArray, NDArray]:
    """Gaussian probability below intervals and in them, above 0."""
    first = ndtr((centre - half) / scale)
    return first, np.maximum(ndtr((centre + half) / scale) - first, 1e-300)
