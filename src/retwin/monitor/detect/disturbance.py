"""One-step predictions of residuals that are autocorrelated: an autoregression with noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import mul

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import require, whole

LARGEST_PARTIAL = 0.9995
"""Of the partial autocorrelations: an average of two thousand samples."""
GRID = [(a, b) for a in (-0.5, 0.2, 0.8, 1.4, 2.0, 2.6, 3.2) for b in (-8.0, -3.0, -1.0, 1.0, 3.0)]
"""First values of the inverse hyperbolic tangent of a partial autocorrelation, and of the logarithm
of the ratio of variances of measurement and process noise."""
ORDERS = (2, 3, 6)
"""Orders that are tried after the first."""
ROUNDS = 14
"""Rounds of the pattern search; a failed one halves the step of a stream."""
RATIOS = (-12.0, 12.0)
"""Limits of that logarithm, beyond which one of the noises is negligible."""
BLOCK = 500
"""A longer record is estimated as independent blocks of so many samples, all at once."""
MIN_RESIDUALS = 50
"""Measured residuals per stream, at least."""


@dataclass(frozen=True)
class DisturbanceState:
    """The filter's prediction of p values: mean (streams, p), covariance (streams, p, p)."""

    mean: NDArray
    covariance: NDArray


@dataclass(frozen=True)
class Disturbance:
    """An autoregression of order p, measured with white noise, and its Kalman filter.

    Attributes
    ----------
    coefficients : array (streams, p)
        From lag 1 on; 0 beyond the order of a stream.
    mean, process, measurement : array (streams,)
        Mean of the residual, variances of the noise of process and measurement.
    held_out : array (streams, T)
        Standardised one-step errors of the calibration, each block of samples predicted with
        parameters estimated without it; NaN where missing.
    deviation : array (streams, T)
        The standard deviations of these predictions, in the unit of the residual.

    References
    ----------
    Harvey, Forecasting, Structural Time Series Models and the Kalman Filter, 1989, chapter 3.

    """

    coefficients: NDArray
    mean: NDArray
    process: NDArray
    measurement: NDArray
    held_out: NDArray
    deviation: NDArray

    @property
    def parameters(self) -> NDArray:
        """Number of estimated parameters (streams,) that shift predictions."""
        return np.count_nonzero(self.coefficients, axis=1) + 2

    def start(self) -> DisturbanceState:
        """The stationary state, before the first sample."""
        covariance = _stationary(self.coefficients.T) * self.process
        return DisturbanceState(np.zeros_like(self.coefficients), np.moveaxis(covariance, -1, 0))

    def step(
        self, state: DisturbanceState, residual: ArrayLike
    ) -> tuple[DisturbanceState, NDArray, NDArray]:
        """One sample of all streams: arrays (streams,); see `run`."""
        made, errors, deviation = self.run(state, np.asarray(residual, dtype=float)[:, None])
        return made, errors[:, 0], deviation[:, 0]

    def run(
        self, state: DisturbanceState, residual: ArrayLike
    ) -> tuple[DisturbanceState, NDArray, NDArray]:
        """Standardised one-step errors of residuals.

        Parameters
        ----------
        state : DisturbanceState
            Of `start` or of the sample before.
        residual : array (streams, T)
            Measured minus predicted; NaN is missing: its error is NaN, and the next prediction is
            of two steps.

        Returns
        -------
        DisturbanceState, array (streams, T), array (streams, T)
            The next state, the errors in standard deviations of the predictions, and those.

        """
        given = np.asarray(residual, dtype=float)
        fits = given.ndim == 2 and len(given) == len(self.mean)
        expected = f"residuals of {len(self.mean)} streams"
        remedy = "give one row per stream of the calibration"
        require(fits, "residual", expected=expected, got=f"shape {given.shape}", remedy=remedy)
        mean = state.mean.T.copy()
        covariance = np.moveaxis(state.covariance, 0, -1).copy()
        errors, deviation = np.empty((2, *given.shape[::-1]))
        model = self.coefficients.T, self.process, self.measurement
        filtered = _errors(given.T - self.mean, model, mean, covariance)
        for t, (error, variance) in enumerate(filtered):
            deviation[t] = np.sqrt(variance)
            errors[t] = error / deviation[t]
        made = DisturbanceState(mean.T, np.moveaxis(covariance, -1, 0))
        return made, errors.T, deviation.T


def fit_disturbance(
    residual: ArrayLike, *, max_order: int = 6, folds: int | Sequence[NDArray] = 4
) -> Disturbance:
    """Estimate the autoregression of residuals of a healthy machine, by maximum likelihood.

    Parameters
    ----------
    residual : array (streams, T)
        Measured minus predicted outputs; NaN is missing. Each stream has at least 50 and varies.
    max_order : int
        Largest order of the autoregression, from 1 to 6; each stream has the order of the least
        Bayesian information criterion.
    folds : int or sequence of NDArray
        Number of blocks of samples of which each is predicted with the parameters of the others,
        or the samples of each block.

    Returns
    -------
    Disturbance
        With the held-out errors of the calibration.

    """
    whole("max_order", max_order, at_least=1, at_most=6)
    given = np.asarray(residual, dtype=float)
    given = np.where(np.abs(given) < 1e100, given, np.nan)
    seen = ~np.isnan(given)
    require(
        given.ndim == 2 and given.size and seen.sum(axis=-1).min() >= MIN_RESIDUALS,
        "residual",
        expected=f"an array (streams, T) with at least {MIN_RESIDUALS} residuals per stream",
        got=f"shape {given.shape}" + (f" with {seen.sum(axis=-1).min()}" if given.size else ""),
        remedy="calibrate on a longer healthy record",
    )
    mean, scale = np.nanmean(given, axis=1), np.nanstd(given, axis=1)
    vary = np.all(scale > 1e-12 * np.abs(mean))
    got = f"a constant in stream {np.argmin(scale)}"
    remedy = "leave out a channel that does not move"
    require(vary, "residual", expected="residuals that vary in each stream", got=got, remedy=remedy)
    if isinstance(folds, int):
        folds = np.array_split(np.arange(given.shape[1]), whole("folds", folds, at_least=2))
    fewest = min((seen.sum(axis=1) - seen[:, each].sum(axis=1)).min() for each in folds)
    enough = MIN_RESIDUALS // 2
    expected = f"at least {enough} residuals outside each of {len(folds)} parts of the record"
    remedy = "leave out the parts of the record in which nothing was measured"
    require(fewest >= enough, "residual", expected=expected, got=str(fewest), remedy=remedy)
    values = ((given - mean[:, None]) / scale[:, None]).T
    blocks = _blocks(values)
    point = _orders(blocks, max_order)
    errors, deviation = np.full((2, *values.shape), np.nan)
    for block in folds:
        part = values.copy()
        part[block] = np.nan
        parts = _blocks(part)
        other, _ = _search(parts, point, ROUNDS // 2)
        found = _standardised(values, other, _likelihood(parts, other)[1])
        errors[block], deviation[block] = found[:, block]
    coefficients, ratio = _model(point)
    variance = _likelihood(blocks, point)[1] * scale**2
    spread = deviation.T * scale[:, None]
    return Disturbance(coefficients.T, mean, variance, variance * ratio, errors.T, spread)


Model = tuple[NDArray, NDArray | float, NDArray]
"""Coefficients (p, ..., streams), and variances of process and measurement noise (..., streams)."""


def _errors(
    values: NDArray, model: Model, mean: NDArray, covariance: NDArray, *, glitch: float = 100.0
) -> Iterator[tuple[NDArray, NDArray]]:
    """Errors and their variances (..., streams), sample by sample; mean and covariance change.

    Shapes: values (T, streams), covariance (p, p, ..., streams).

    Parameters
    ----------
    glitch : float, default 100.0
        An error of so many standard deviations is scored, but the filter takes the sample as
        missing: a sample of 1e300 would else stay in its state. Where such samples persist, its
        uncertainty grows until it follows them.

    """
    coefficients, process, measurement = model
    order = len(coefficients)
    for value in values:
        error = value - mean[0]
        variance = covariance[0, 0] + measurement
        used = np.abs(error) <= glitch * np.sqrt(variance)  # False for NaN
        yield error, variance
        gain = np.where(used, covariance[0] / variance, 0.0)
        first = covariance[0].copy()
        mean += gain * np.where(used, error, 0.0)
        for i in range(order):
            for j in range(i, order):
                covariance[i, j] -= gain[i] * first[j]
        # One step on: the newest value is a sum of the others, which move by one place.
        newest = sum(map(mul, coefficients, mean))
        mean[1:] = mean[:-1].copy()
        mean[0] = newest
        columns = ([covariance[min(i, j), max(i, j)] for j in range(order)] for i in range(order))
        row = [sum(map(mul, coefficients, column)) for column in columns]
        corner = sum(map(mul, coefficients, row), process)
        covariance[1:, 1:] = covariance[:-1, :-1].copy()
        covariance[0, 0] = corner
        for i in range(1, order):
            covariance[0, i] = covariance[i, 0] = row[i - 1]


def _coefficients(partial: NDArray) -> NDArray:
    """Coefficients of an autoregression from its partial autocorrelations (p, …): Levinson."""
    made = partial[:1]
    for k in range(1, len(partial)):
        made = np.concatenate([made - partial[k] * made[::-1], partial[k : k + 1]])
    return made


def _stationary(coefficients: NDArray) -> NDArray:
    """Covariance (p, p, …) of p consecutive values for unit process noise."""
    order, shape = len(coefficients), coefficients.shape[1:]
    phi = np.moveaxis(coefficients.reshape(order, -1), -1, 0)
    companion = np.zeros((len(phi), order, order))
    companion[:, 0] = phi
    companion[:, range(1, order), range(order - 1)] = 1.0
    system = np.eye(order**2) - np.einsum("sij,skl->sikjl", companion, companion).reshape(
        len(phi), order**2, order**2
    )
    unit = np.zeros((len(phi), order**2, 1))
    unit[:, 0] = 1.0
    made: NDArray = np.linalg.solve(system, unit).reshape(-1, order, order)
    return np.moveaxis(made, 0, -1).reshape(order, order, *shape)


def _model(point: NDArray) -> tuple[NDArray, NDArray]:
    """Coefficients and the ratio of variances from a point of the search (p + 1, …)."""
    partial = LARGEST_PARTIAL * np.tanh(point[:-1])
    return _coefficients(partial), np.exp(np.clip(point[-1], *RATIOS))


def _errors_at(point: NDArray, blocks: NDArray) -> Iterator[tuple[NDArray, NDArray]]:
    """See `_errors`: of blocks (T, B, streams), for unit process noise from a stationary start."""
    coefficients, ratio = (each[..., None, :] for each in _model(point))
    shape = (len(coefficients), *ratio.shape[:-2], *blocks.shape[1:])
    covariance = np.broadcast_to(_stationary(coefficients), (shape[0], *shape)).copy()
    return _errors(blocks, (coefficients, 1.0, ratio), np.zeros(shape), covariance)


def _likelihood(blocks: NDArray, point: NDArray) -> tuple[NDArray, NDArray]:
    """Minus twice the log likelihood, with the variance of the process that maximises it.

    Shapes: blocks (BLOCK, B, streams), point (d, …, streams).
    """
    logs, squares = np.zeros((2, *point.shape[1:-1], *blocks.shape[1:]))
    count = np.zeros(blocks.shape[1:])
    for value, (error, variance) in zip(blocks, _errors_at(point, blocks), strict=True):
        seen = ~np.isnan(value)
        logs += np.where(seen, np.log(variance), 0.0)
        squares += np.where(seen, error**2 / variance, 0.0)
        count += seen
    logs, squares, count = (each.sum(axis=-2) for each in (logs, squares, count))
    scale = squares / count
    return count * np.log(scale) + logs, scale


def _blocks(values: NDArray) -> NDArray:
    """Values (T, streams) as blocks (BLOCK, B, streams), filled up with missing ones."""
    count = -(-len(values) // BLOCK)
    size = BLOCK if count > 1 else len(values)
    filled = np.full((count * size, values.shape[1]), np.nan)
    filled[: len(values)] = values
    return np.swapaxes(filled.reshape(count, size, -1), 0, 1)


def _search(blocks: NDArray, point: NDArray, rounds: int) -> tuple[NDArray, NDArray]:
    """Pattern search from a point (d, streams), for all streams and both directions at once."""
    best = _likelihood(blocks, point[:, None])[0][0]
    size = np.full(point.shape[1], 0.4)
    directions = np.concatenate([np.eye(len(point)), -np.eye(len(point))])
    directions[:, -1] *= 3  # the ratio of variances is in logarithms
    for _ in range(rounds):
        tried = point[:, None] + directions.T[:, :, None] * size
        found = _likelihood(blocks, tried)[0]
        chosen = np.argmin(found, axis=0)
        streams = np.arange(len(size))
        better = found[chosen, streams] < best - 1e-9
        point = np.where(better, tried[:, chosen, streams], point)
        best = np.where(better, found[chosen, streams], best)
        size = np.where(better, size, size / 2)
    return point, best


def _orders(blocks: NDArray, max_order: int) -> NDArray:
    """The best point (p + 1, streams), with the order of each stream by the BIC."""
    streams = blocks.shape[-1]
    grid = np.repeat(np.transpose(GRID)[:, :, None], streams, axis=2)
    first = np.argmin(_likelihood(blocks, grid)[0], axis=0)
    point, best = _search(blocks, grid[:, first, np.arange(streams)], ROUNDS)
    penalty = np.log(np.sum(~np.isnan(blocks), axis=(0, 1)))
    kept, orders, best = point, np.ones(streams), best + penalty
    partial = _partial(blocks, max_order)
    for order in (each for each in ORDERS if each <= max_order):
        # The likelihood has two maxima: with much measurement noise, and with hardly any.
        free = np.concatenate([partial[:order], np.full((1, streams), GRID[0][1])])
        both = [_search(blocks, each, ROUNDS) for each in (_of_order(point, order), free)]
        (point, found), (other, others) = both
        point, found = np.where(others < found, other, point), np.minimum(others, found)
        better = found + penalty * order < best
        orders = np.where(better, order, orders)
        kept = np.where(better, point, _of_order(kept, order))
        best = np.where(better, found + penalty * order, best)
    top = int(orders.max())
    return np.concatenate([kept[:top], kept[-1:]])


def _of_order(point: NDArray, order: int) -> NDArray:
    """A point of a smaller order, (order + 1, streams)."""
    more = np.zeros((order + 1 - len(point), point.shape[1]))
    return np.concatenate([point[:-1], more, point[-1:]])


def _partial(blocks: NDArray, order: int) -> NDArray:
    """Inverse hyperbolic tangents (order, streams) of the sample partial autocorrelations."""
    seen = np.isfinite(blocks)
    filled, size = np.where(seen, blocks, 0.0), len(blocks)
    sums, pairs = (
        np.array([(each[i:] * each[: size - i]).sum(axis=(0, 1)) for i in range(order + 1)])
        for each in (filled, seen)
    )
    correlation = sums / np.maximum(pairs, 1)
    made, variance = np.zeros_like(correlation[1:]), correlation[0].copy()
    for k in range(order):  # the recursion of Levinson
        predicted = (_coefficients(made[:k]) * correlation[k:0:-1]).sum(axis=0) if k else 0.0
        made[k] = np.clip((correlation[k + 1] - predicted) / variance, -0.99, 0.99)
        variance *= 1 - made[k] ** 2
    found: NDArray = np.arctanh(made / LARGEST_PARTIAL)
    return found


def _standardised(values: NDArray, point: NDArray, scale: NDArray) -> NDArray:
    """Errors of values (T, streams) in standard deviations, and those, for a process variance."""
    filtered = _errors_at(point, values[:, None])
    both = [(error[0], np.sqrt(variance[0] * scale)) for error, variance in filtered]
    return np.array([(error / each, each) for error, each in both]).swapaxes(0, 1)
