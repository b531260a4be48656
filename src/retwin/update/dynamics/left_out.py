"""Estimates without parts of the record, by a Gauss-Newton step from those of all samples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from retwin.update.dynamics.estimation import RESOLUTION, Estimation
from retwin.update.dynamics.linearised import HeldOut, Linearised
from retwin.update.score_covariance import score_covariance


def held_out(estimation: Estimation, at: Linearised, folds: Sequence[NDArray]) -> HeldOut:
    """The errors of each fold, and the estimates, without that fold.

    One Gauss-Newton step from the optimum of all samples leads to that without a fold. The
    starts stay: without the first samples of a trajectory hardly anything determines them.

    Parameters
    ----------
    estimation : Estimation
        The unknowns and the outputs.
    at : Linearised
        The optimum.
    folds : sequence of NDArray
        Parts (n, T) of the samples.

    """
    steps, covariances, by_unit = _left_out(estimation, at, folds)
    errors, variances = at.residual.copy(), np.zeros(at.residual.shape)
    for i, rows, error, jacobian in _parts(estimation, at, folds, by_unit):
        fold = folds[i][rows]
        errors[rows][fold] = error - jacobian @ steps[i]
        variances[rows][fold] = np.sum((jacobian @ covariances[i]) * jacobian, axis=-1)
    unit = estimation.bounded_curvature(at).unit[: estimation.unknowns.count]
    return HeldOut(np.where(estimation.seen, errors, 0.0), variances, unit * steps)


def errors_without(
    estimation: Estimation, at: Linearised, parts: Sequence[NDArray]
) -> list[NDArray]:
    """The errors (n, T, d_y) without each of some parts (n, T), which may overlap.

    They are those of `held_out` with that part alone, and of all samples elsewhere.
    """
    steps, _, by_unit = _left_out(estimation, at, parts)
    made = [at.residual.copy() for _ in parts]
    for i, rows, error, jacobian in _parts(estimation, at, parts, by_unit):
        made[i][rows][parts[i][rows]] = error - jacobian @ steps[i]
    return [np.where(estimation.seen, each, 0.0) for each in made]


def dependent_errors(estimation: Estimation, at: Linearised, count: int) -> tuple[NDArray, NDArray]:
    """Standard errors (count,) of the first shared coordinates, and factors to 95 % intervals.

    They are those of `score_covariance`, from what varies between blocks of time and records: the
    residuals are weighted by how far each moves the estimates, in one Gauss-Newton step.

    Parameters
    ----------
    estimation : Estimation
        The unknowns and the outputs.
    at : Linearised
        The optimum.
    count : int
        The number of coordinates.

    """
    if not count:
        return np.zeros(0), np.zeros(0)
    unknowns, k = estimation.unknowns, estimation.unknowns.count
    curvature = estimation.bounded_curvature(at)
    unit, scale = curvature.unit, 1 / np.sqrt(estimation.variance)
    complement, follow, _ = curvature.scaled(unit).reduced()
    back = np.linalg.pinv(complement, RESOLUTION * k, hermitian=True)[:, :count] * unit[:count]
    own = unit[k:].reshape(follow.shape[:2])[..., None] * follow @ back
    by_parameters, starts = unknowns.matrix @ (unit[:k, None] * back), unknowns.free
    score = np.empty((*at.residual.shape, count))
    for rows, _, slope in estimation.derivatives(at.point):
        known, of_start = slope[..., : len(by_parameters)], len(by_parameters) + starts
        moved = np.einsum("ntdm,nmk->ntdk", slope[..., of_start], own[rows])
        score[rows] = (known @ by_parameters - moved) * scale[:, None]
    measured = int(estimation.seen.sum())
    covariance, freedom = score_covariance(score, at.residual * scale, measured)
    return np.sqrt(np.diag(covariance)), student.ppf(0.975, freedom)


def _left_out(
    estimation: Estimation, at: Linearised, parts: Sequence[NDArray]
) -> tuple[NDArray, NDArray, NDArray]:
    """Gauss-Newton steps to the estimates without each of K parts, in prior units.

    Returns
    -------
    steps, covariances, by_unit : ndarray, shapes (K, k), (K, k, k) and (q, k)
        Steps, posterior covariances there, and the parameters by coordinates in these units.

    """
    k = estimation.unknowns.count
    curvature = estimation.bounded_curvature(at)
    unit = curvature.unit[:k]
    by_unit = estimation.unknowns.matrix * unit
    scale = 1 / np.sqrt(estimation.variance)
    left = np.tile(unit[:, None] * curvature.shared * unit, (len(parts), 1, 1))
    gradients = np.zeros((len(parts), k))
    for i, _, error, jacobian in _parts(estimation, at, parts, by_unit):
        weighted = (jacobian * scale[:, None]).reshape(-1, k)
        left[i] -= weighted.T @ weighted
        gradients[i] -= weighted.T @ (error * scale).ravel()
    # What the record does not determine stays, as a step along it would be rounding alone.
    covariances = np.linalg.pinv(left, RESOLUTION * max(k, 1), hermitian=True)
    steps = np.einsum("fij,fj->fi", covariances, gradients)
    ends = (each[:k] - at.point.shared for each in estimation.bounds)
    return np.clip(unit * steps, *ends) / unit, covariances, by_unit


def _parts(
    estimation: Estimation, at: Linearised, parts: Sequence[NDArray], by_unit: NDArray
) -> Iterator[tuple[int, slice, NDArray, NDArray]]:
    """For some trajectories and each part, its number, errors (m, d_y) and Jacobian."""
    for rows, error, slope in estimation.derivatives(at.point):
        for i, part in enumerate(parts):
            held = slope[part[rows]][..., : len(by_unit)]
            yield i, rows, error[part[rows]], held @ by_unit
