"""`gauss_newton`: damped Gauss-Newton on many small least-squares problems at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

FLOOR = 1e-13
"""Damping, relative to the trace of the normal matrix, below which it would be singular."""


Evaluate = Callable[[NDArray], tuple[NDArray, NDArray]]
"""From x (..., d) to the residuals (..., k) and their Jacobian (..., k, d)."""


def gauss_newton(
    evaluate: Evaluate, x: NDArray, *, rounds: int, limit: float = np.inf
) -> tuple[NDArray, NDArray]:
    """Minimise sums of squares from given starts.

    Parameters
    ----------
    evaluate : callable
        Returns the residuals (..., k) at x and their Jacobian (..., k, d).
    x : ndarray, shape (..., d)
        The starts.
    rounds : int
        Number of steps; one that does not reduce the sum of squares is not taken, and the damping
        is increased.
    limit : float, optional
        Largest absolute value of x.

    Returns
    -------
    x : ndarray, shape (..., d)
        The best points.
    cost : ndarray, shape (...)
        Their sums of squares.

    """
    error, slope = evaluate(x)
    cost = (error**2).sum(axis=-1)
    # The damping of a step is relative to the trace of the normal matrix (Levenberg, Marquardt).
    ratio = np.full(cost.shape, 1e-4)
    for _ in range(rounds):
        transposed = slope.swapaxes(-1, -2)
        matrix = transposed @ slope
        size = np.trace(matrix, axis1=-2, axis2=-1) + 1e-20
        damped = matrix + (size * (ratio + FLOOR))[..., None, None] * np.eye(x.shape[-1])
        step = np.linalg.solve(damped, transposed @ error[..., None])[..., 0]
        trial = np.clip(x - step, -limit, limit)
        trial_error, trial_slope = evaluate(trial)
        trial_cost = (trial_error**2).sum(axis=-1)
        better = trial_cost < cost
        x = np.where(better[..., None], trial, x)
        error = np.where(better[..., None], trial_error, error)
        slope = np.where(better[..., None, None], trial_slope, slope)
        cost = np.where(better, trial_cost, cost)
        ratio = np.where(better, ratio / 10, ratio * 10)
    return x, cost
