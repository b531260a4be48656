"""Conditional noise: what errors of predictions depend on, beside the errors before.

Errors are larger or have a mean just after a switch, at a command, or at a level that the twin
describes worse. The mean and the logarithm of the scale of a logistic distribution are linear in
features of these; which features is chosen by the density of records that were left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

DECAYS = np.array([0.5, 0.9, 0.98])
"""Factors per sample by which a change of a command is forgotten: within two, ten and fifty
samples. A sum of them describes what lasts for any time between."""
LARGEST = 4.0
"""Errors count up to this for the scale of a record, so that no fault is taken for it."""
DEGREES = (4.0, 1e4)
"""Limits of the degrees of freedom of a record's variance."""


@dataclass(frozen=True, eq=False)
class Noise:
    """The distribution of standardised errors given commands, their changes, and the level.

    Features are commands (d_u), changes of commands that are forgotten at three speeds (3 d_u), and
    predicted outputs (d_y), each centred and scaled by its range in calibration, beyond which it
    counts as at the bound: noise is not extrapolated.

    Attributes
    ----------
    low, high : NDArray
        (F,), the range of each feature in calibration.
    mean, scale : NDArray
        (S, F + 1), weights of the features for the mean and for the logarithm of the scale of each
        stream, the constants last; 0 for features that were not chosen.
    degrees : NDArray
        (S,), degrees of freedom of the variance that records have beside that: a day with more or
        less noise is known after about so many samples of it.

    """

    low: NDArray
    high: NDArray
    mean: NDArray
    scale: NDArray
    degrees: NDArray

    def run(self, features: NDArray) -> tuple[NDArray, NDArray]:
        """Means and scales (n, T, S) of errors for features (n, T, F)."""
        width = np.where(self.high > self.low, self.high - self.low, 1.0)
        given = (np.clip(features, self.low, self.high) - (self.low + self.high) / 2) / width
        mean = np.zeros((*features.shape[:2], len(self.mean))) + self.mean[:, -1]
        scale = np.zeros_like(mean) + self.scale[:, -1]
        for i in range(len(self.low)):  # in this order, however many machines there are
            mean += given[..., i, None] * self.mean[:, i]
            scale += given[..., i, None] * self.scale[:, i]
        return mean, np.exp(scale)


def own_scale(sums: NDArray, errors: NDArray, degrees: NDArray) -> tuple[NDArray, NDArray]:
    """Scales (N, T) of a record's own noise before each sample, and the sums (N, 2) after them.

    Parameters
    ----------
    sums : NDArray
        (N, 2), sums of squares of errors so far, and their number.
    errors : NDArray
        (N, T), NaN where missing.
    degrees : NDArray
        (N,), see `Noise`: by a variance with an inverse gamma distribution around 1.

    """
    squares = np.minimum(np.abs(np.nan_to_num(errors)), LARGEST) ** 2
    both = np.stack([squares, np.isfinite(errors)], axis=1)
    sums = np.cumsum(np.concatenate([sums[:, :, None], both], axis=2), axis=2)
    total, count = (degrees[:, None] + sums[:, i, :-1] for i in range(2))
    return np.sqrt(total / count), sums[:, :, -1]


def fit_degrees(errors: NDArray, folds: Sequence[NDArray], *, fewest: int = 8) -> NDArray:
    """Degrees of freedom (S,) of the variance of records, from errors (S, T) that were left out.

    Parameters
    ----------
    fewest : int, default 8
        Errors of a record of which the variance is counted.

    """
    squares = np.minimum(np.abs(np.nan_to_num(errors)), LARGEST) ** 2
    pairs = ((squares[:, fold], np.isfinite(errors[:, fold])) for fold in folds)
    sums = np.array([(both[0].sum(axis=1), both[1].sum(axis=1)) for both in pairs])
    enough = sums[:, 1] >= fewest
    logs = np.where(enough, np.log(np.maximum(sums[:, 0], 1e-9) / np.maximum(sums[:, 1], 1)), 0.0)
    spread = (logs**2).sum(axis=0) / np.maximum(enough.sum(axis=0) - 1, 1)
    made: NDArray = np.clip(2 / np.maximum(spread, 1e-9), *DEGREES)
    return made


def features(
    memory: NDArray, before: NDArray, commands: NDArray, level: NDArray, span: NDArray
) -> tuple[NDArray, NDArray]:
    """Changes that are remembered (n, 3, d_u) after samples, and their features (n, T, F).

    Parameters
    ----------
    memory, before : NDArray
        (n, 3, d_u) and (n, d_u), what was remembered, and the command before; NaN for none.
    commands, level : NDArray
        (n, T, d_u) and (n, T, d_y), commands and predicted outputs.
    span : NDArray
        (d_u,), the range of each command in calibration.

    """
    made = np.empty((*commands.shape[:2], len(DECAYS), commands.shape[2]))
    before = np.where(np.isfinite(before), before, commands[:, 0])
    for t in range(commands.shape[1]):
        change = np.minimum(np.abs(commands[:, t] - before) / span, 1.0)
        memory = np.maximum(memory * DECAYS[:, None], change[:, None])
        made[:, t], before = memory, commands[:, t]
    changes = made.reshape(*commands.shape[:2], -1)
    return memory, np.concatenate([commands, changes, level], axis=2)


def fit_noise(
    errors: NDArray,
    width: NDArray,
    given: NDArray,
    sizes: tuple[int, ...],
    folds: Sequence[NDArray],
    *,
    narrowest: float = 1e-3,
    farthest: float = 8.0,
) -> tuple[Noise, NDArray, NDArray]:
    """The noise of errors (S, T), with means and scales (S, T) of folds that were left out.

    Parameters
    ----------
    errors, width : NDArray
        (S, T), standardised errors, NaN where missing, and widths of their rounding intervals.
    given : NDArray
        (T, F), features.
    sizes : tuple of int
        Numbers of features of each kind: commands, changes, levels.
    folds : sequence of NDArray
        Samples that are left out in turn.
    narrowest : float, default 1e-3
        Width of the interval of an error that is not rounded, in its standard deviations.
    farthest : float, default 8.0
        Errors count up to this, so that single outliers do not decide.

    """
    seen = np.isfinite(errors).any(axis=0)
    given = np.where(np.isfinite(given), given, given[seen].mean(axis=0))
    low, high = given[seen].min(axis=0), given[seen].max(axis=0)
    scaled = (given - (low + high) / 2) / np.where(high > low, high - low, 1.0)
    design = np.concatenate([scaled, np.ones((len(given), 1))], axis=1)
    kind = np.repeat(np.arange(len(sizes)), sizes)
    candidates = [np.isin(kind, each) & (high > low) for each in ((), (0,), (0, 1), (0, 1, 2))]
    weights = np.zeros((2, *errors.shape[:1], design.shape[1]))
    apart = np.zeros((2, *errors.shape))
    for i, (error, wide) in enumerate(zip(errors, width, strict=True)):
        own = np.flatnonzero(np.isfinite(error))
        ends = np.clip(error, -farthest, farthest), np.maximum(np.nan_to_num(wide), narrowest)
        best = -np.inf
        for chosen in candidates:
            used = np.append(chosen, True)
            density, found = 0.0, np.zeros((2, len(error)))
            for fold in folds:
                rest = np.setdiff1d(own, fold)
                fitted = _fitted(design[rest][:, used], *(each[rest] for each in ends))
                found[:, fold] = fitted @ design[fold][:, used].T
                left = np.intersect1d(own, fold)
                density += _density(*found[:, left], *(each[left] for each in ends)).sum()
            if density > best + 1.0 * chosen.any():
                best, apart[:, i], kept = density, found, used
        weights[:, i][:, kept] = _fitted(design[own][:, kept], *(each[own] for each in ends))
    scale = np.exp(apart[1])
    degrees = fit_degrees((errors - apart[0]) / scale, folds)
    return Noise(low, high, weights[0], weights[1], degrees), apart[0], scale


def _density(mean: NDArray, logs: NDArray, error: NDArray, width: NDArray) -> NDArray:
    """Log probabilities of rounding intervals by logistic distributions of unit variance."""
    scale = np.exp(logs) * np.sqrt(3) / np.pi
    low, half = -np.abs(error - mean) / scale, width / scale / 2
    made: NDArray = np.log(np.maximum(expit(low + half) - expit(low - half), 1e-300))
    return made - np.log(width)


def _fitted(design: NDArray, error: NDArray, width: NDArray, *, penalty: float = 4.0) -> NDArray:
    """Weights (2, F) of mean and logarithm of the scale that maximise the penalised likelihood.

    Parameters
    ----------
    penalty : float, default 4.0
        Of squared weights, in nats: a weight is 0 but for a few samples' evidence of another one.

    """
    size = design.shape[1]

    def loss(point: NDArray) -> tuple[float, NDArray]:
        mean, logs = design @ point[:size], np.clip(design @ point[size:], -7, 7)
        scale = np.exp(logs) * np.sqrt(3) / np.pi
        ends = np.stack([error - mean - width / 2, error - mean + width / 2]) / scale
        upper = ends.mean(axis=0) > 0  # in the tail, where differences keep their digits
        ends = np.where(upper, -ends[::-1], ends)
        low, high = expit(ends)
        mass = np.maximum(high - low, 1e-300)
        slopes = np.stack([low * (1 - low), high * (1 - high)])
        by_mean = (slopes[1] - slopes[0]) / mass / scale * np.where(upper, -1, 1)
        by_scale = (slopes[1] * ends[1] - slopes[0] * ends[0]) / mass
        ridge = penalty * np.where(np.arange(2 * size) % size == size - 1, 0.0, 1.0)
        value = -np.log(mass).sum() + (ridge * point**2).sum() / 2
        slope = np.concatenate([by_mean @ design, by_scale @ design])
        return float(value), slope + ridge * point

    found = minimize(loss, np.zeros(2 * size), jac=True, method="L-BFGS-B")
    made: NDArray = found.x.reshape(2, size)
    return made
