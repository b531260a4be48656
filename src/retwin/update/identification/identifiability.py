"""Identifiability: which parameters, and which combinations, the measured outputs determine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.update.score_covariance import NORMAL_95, lag_one, score_covariance, variance_of

RANK_TOLERANCE = 1e-5
"""Singular values below this share of the largest count as 0: finite differences are no better."""
CHI2_95 = 3.84
"""95 % quantile of the chi-square distribution with one degree of freedom."""
UNIFORM = 12**-0.5
"""Standard deviation of a uniform distribution between the bounds, in widths of the bounds."""
NEGLIGIBLE = 0.01
"""Component of an undetermined direction, below which it does not concern a parameter: along the
whole range of the others, that parameter changes by less than this share of its own range."""
MIN_TRAJECTORIES = 3
"""Smallest number of trajectories from which standard errors are estimated."""
LEVERAGE = 1 - 1e-6
"""Share of the information on a direction that a trajectory may have: without it, nothing would be
known of that direction, nor of its error."""


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Local identifiability at the optimum, from the singular values of the Jacobian.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters.
    errors : NDArray
        (k,), standard errors in the parameters' units, by `score_covariance`; infinite where
        outputs do not depend on the parameter. Of a parameter that is identified, what undetermined
        directions add is limited by the ranges.
    correlation : NDArray
        (k, k), of the estimates; NaN where an error is infinite.
    singular_values : NDArray
        (k,), descending, of the Jacobian with parameters in widths of their bounds and residuals in
        standard deviations: 1/s is the standard error along a direction, in widths.
    directions : NDArray
        (k, k), row i belongs to `singular_values[i]`; the last is the least identified.
    at_bound : NDArray
        (k,) bool, the optimum lies on a bound, and the true value may lie beyond it.
    depends : NDArray
        (k,) bool, the estimate depends on the bound of another parameter: without bounds it would
        move, to first order, by more than half of its 95 % interval there.
    identified : NDArray
        (k,) bool, the standard error is below that of a uniform distribution between the bounds,
        starts that fit equally well agree, and the estimate depends on no bound.
    independent : float
        Effective sample size of the residuals, which are autocorrelated.
    freedom : NDArray
        (k,), degrees of freedom of Student's t distribution that estimates follow, divided by
        `errors`.
    white : NDArray
        (k,), what `errors` would be of residuals without any correlation.

    """

    names: tuple[str, ...]
    errors: NDArray
    correlation: NDArray
    singular_values: NDArray
    directions: NDArray
    at_bound: NDArray
    depends: NDArray
    identified: NDArray
    independent: float
    freedom: NDArray
    white: NDArray

    @property
    def warning(self) -> str:
        """The parameters that are not identified or lie on a bound; "" if there are none."""
        parts = []
        names = np.array(self.names)
        open_ = ~self.identified & ~self.depends
        if open_.any():
            parts.append(f"not identified: {', '.join(names[open_])} ({self.least_identified})")
        if self.at_bound.any():
            parts.append(f"at a bound: {', '.join(names[self.at_bound])}")
        if self.depends.any():
            parts.append(f"values that depend on this bound: {', '.join(names[self.depends])}")
        return "; ".join(parts)

    @property
    def least_identified(self) -> str:
        """The combination of parameters that is least identified, as a text."""
        direction = self.directions[-1]
        shown = np.argsort(-np.abs(direction))[:3]
        terms = [f"{direction[i]:+.2f} {self.names[i]}" for i in shown if abs(direction[i]) > 0.1]
        return f"least identified: {' '.join(terms)}, in widths of the bounds"


def identifiability(
    names: tuple[str, ...],
    jacobian: NDArray,
    residual: NDArray,
    *,
    measured: int,
    width: NDArray,
    at_bound: NDArray,
    alternatives: NDArray,
    agreement: float = 0.05,
) -> Identifiability:
    """The identifiability at an optimum.

    Parameters
    ----------
    names : tuple of str
        Names of the parameters.
    jacobian : NDArray
        (n, P, d_y, k), by parameters in widths of their bounds.
    residual : NDArray
        (n, P, d_y), 0 where nothing was measured.
    measured : int
        Number of measured values.
    width : NDArray
        (k,), widths of the bounds.
    at_bound : NDArray
        (k,) bool.
    alternatives : NDArray
        (r, k), optima from other starts that fit as well, minus the best one, in widths.
    agreement : float, default 0.05
        Distance of equally good optima, in widths of the bounds, up to which they agree in any
        case.

    Returns
    -------
    Identifiability

    """
    flat = jacobian.reshape(-1, jacobian.shape[-1])
    left, singular, directions = np.linalg.svd(flat, full_matrices=False)
    nonzero = singular > RANK_TOLERANCE * singular.max(initial=0.0)
    covariance, freedom = score_covariance(left.reshape(jacobian.shape), residual, measured)
    noise = np.sqrt(np.diag(covariance))
    alike = covariance / np.maximum(np.outer(noise, noise), 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        uncertainty = np.where(nonzero, noise / singular, np.inf)
        # A direction does not concern a parameter in which it has no component.
        part = np.where(np.abs(directions) > 1e-6, directions, 0.0)
        scaled = np.where(part == 0, 0.0, part * uncertainty[:, None])
        finite = np.where(nonzero[:, None], scaled, 0.0)
        errors = np.sqrt(np.sum(finite * (alike @ finite), axis=0))
        errors = np.where(np.isinf(scaled).any(axis=0), np.inf, errors)
        # No direction is longer than the ranges. So one that is undetermined leaves a parameter
        # determined that hardly takes part in it.
        limited = part * np.minimum(uncertainty, 1.0)[:, None]
        limited = np.where(np.abs(part) <= NEGLIGIBLE, limited, scaled)
        crossed = np.where(np.isfinite(limited), limited, 0.0)
        within = np.sqrt(np.sum(crossed * (alike @ crossed), axis=0))
        within = np.where(np.isinf(limited).any(axis=0), np.inf, within)
        lengths = np.where(nonzero[:, None], part / singular[:, None], 0.0)
        correlation = finite.T @ alike @ finite / np.outer(errors, errors)
    distance = np.abs(alternatives).max(axis=0, initial=0.0)
    determined = within < UNIFORM
    errors = np.where(determined, within, errors)
    agree = distance <= np.maximum(4 * errors, agreement)
    # Where a bound holds the optimum, a step of least squares without bounds leaves it.
    known = uncertainty < 1
    step = -(left[:, known].T @ residual.ravel() / singular[known]) @ directions[known]
    rest = np.sum((residual + jacobian @ step) ** 2) / max(np.sum(residual**2), 1e-300)
    moved = np.abs(step) > NORMAL_95 * errors * np.sqrt(rest)
    depends = at_bound.any() & ~at_bound & moved
    # Degrees of freedom of a parameter are those of the direction that leaves it most uncertain.
    weakest = np.argmax(np.abs(finite), axis=0)
    return Identifiability(
        names=names,
        errors=errors * width,
        correlation=correlation,
        singular_values=singular / np.maximum(noise, 1e-300),
        directions=directions,
        at_bound=at_bound,
        depends=depends,
        identified=determined & agree & ~depends,
        independent=measured / correlation_time(residual),
        freedom=freedom[weakest],
        white=width * np.sqrt(variance_of(residual, measured, len(names)) * np.sum(lengths**2, 0)),
    )


def standard_errors(jacobian: NDArray, residual: NDArray) -> NDArray:
    """Standard errors (k,) by the jackknife over trajectories, in one Gauss-Newton step each.

    They hold for errors that are correlated in any way within a trajectory, and independent between
    trajectories. Divided by them, estimates follow Student's t distribution with n - 1 degrees of
    freedom.

    Parameters
    ----------
    jacobian : NDArray
        (n, P, d_y, k).
    residual : NDArray
        (n, P, d_y), at the optimum.

    Returns
    -------
    NDArray
        (k,), infinite where outputs do not depend on the parameter; NaN below three trajectories,
        and where only one of them determines some direction.

    References
    ----------
    Bell and McCaffrey, "Bias reduction in standard errors for linear regression with multi-stage
    samples", Survey Methodology 28, 2002: the variance of the jackknife.

    """
    count, size = len(jacobian), jacobian.shape[-1]
    if count < MIN_TRAJECTORIES:
        return np.full(size, np.nan)
    each = jacobian.reshape(count, -1, size)
    _, singular, directions = np.linalg.svd(each.reshape(-1, size), full_matrices=False)
    nonzero = singular > RANK_TOLERANCE * singular.max(initial=0.0)
    # In these coordinates the information of all trajectories is the identity.
    back = directions[nonzero].T / singular[nonzero]
    scaled = each @ back
    information = scaled.mT @ scaled
    if np.linalg.eigvalsh(information).max(initial=0.0) > LEVERAGE:
        return np.full(size, np.nan)
    gradient = np.einsum("npk,np->nk", scaled, residual.reshape(count, -1))
    without = np.linalg.solve(np.eye(information.shape[1]) - information, gradient[..., None])
    step = without[..., 0] @ back.T
    errors = np.sqrt((count - 1) * np.var(step, axis=0))
    # A direction does not concern a parameter in which it has no component.
    open_ = np.abs(directions[~nonzero]).max(axis=0, initial=0.0) > NEGLIGIBLE
    return np.where(open_, np.inf, errors)


def noise_of(residual: NDArray, measured: int, free: int) -> float:
    """The same per effective sample."""
    return variance_of(residual, measured, free) * correlation_time(residual)


def correlation_time(residual: NDArray) -> float:
    """Samples per effective one, from the lag-one autocorrelation of residuals (n, P, d_y)."""
    correlation = lag_one(residual)
    return (1 + correlation) / (1 - correlation)
