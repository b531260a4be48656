"""What measured outputs say about parameters, and what they leave open."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["PLAUSIBLE", "Identifiability", "identifiability", "noise_of"]

FLAT = 1e-5
"""Singular values below this share of the greatest count as none: so exact are differences."""
PLAUSIBLE = 3.84
"""95 % of chi-square with one degree of freedom."""
UNIFORM = 12**-0.5
"""Standard deviation of what is only known to lie within its bounds, in widths of the bounds."""


@dataclass(frozen=True, eq=False)
class Identifiability:
    """The local picture at the optimum, from the singular values of the Jacobian.

    Attributes
    ----------
    names: of the parameters.
    errors: standard error of each in its unit; infinite where the outputs do not tell it.
    correlation: (k, k) of the estimates; NaN where an error is infinite.
    singular_values: (k,) of the Jacobian with parameters in widths of their bounds and residuals in
        standard deviations, descending: 1/s is how well a direction is known, in widths.
    directions: (k, k), row i belongs to `singular_values[i]`; the last is known worst.
    at_bound: (k,) bool, the optimum lies on a bound: the true value may lie beyond.
    identified: (k,) bool, the outputs narrow it to less than its bounds do, and starts that fit
        equally well agree on it.
    independent: residuals that tell something of their own; neighbouring errors are alike.

    """

    names: tuple[str, ...]
    errors: NDArray
    correlation: NDArray
    singular_values: NDArray
    directions: NDArray
    at_bound: NDArray
    identified: NDArray
    independent: float

    @property
    def doubts(self) -> str:
        """What is not identified or lies on a bound, in words; "" if nothing."""
        said = []
        if not self.identified.all():
            open_ = [n for n, known in zip(self.names, self.identified, strict=True) if not known]
            said.append(f"not identified: {', '.join(open_)} ({self.worst})")
        if self.at_bound.any():
            edge = [n for n, there in zip(self.names, self.at_bound, strict=True) if there]
            said.append(f"at a bound: {', '.join(edge)}")
        return "; ".join(said)

    @property
    def worst(self) -> str:
        """The combination that is known worst, in words."""
        direction = self.directions[-1]
        shown = np.argsort(-np.abs(direction))[:3]
        terms = [f"{direction[i]:+.2f} {self.names[i]}" for i in shown if abs(direction[i]) > 0.1]
        return f"known worst: {' '.join(terms)}, in widths of the bounds"


def identifiability(
    names: tuple[str, ...],
    jacobian: NDArray,
    residual: NDArray,
    *,
    measured: int,
    width: NDArray,
    at_bound: NDArray,
    rivals: NDArray,
) -> Identifiability:
    """The picture at an optimum.

    Parameters
    ----------
    names: of the parameters.
    jacobian: (n, P, d_y, k) by parameters in widths of their bounds.
    residual: (n, P, d_y), 0 where nothing was measured.
    measured: how many were.
    width: (k,) of the bounds.
    at_bound: (k,) bool.
    rivals: (r, k), optima from other starts that fit as well, less the best one, in widths.

    """
    flat = jacobian.reshape(-1, jacobian.shape[-1])
    noise = np.sqrt(noise_of(residual, measured, len(names)))
    _, singular, directions = np.linalg.svd(flat, full_matrices=False)
    known = singular > FLAT * singular.max(initial=0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        open_ = np.where(known, noise / singular, np.inf)
        # A direction without length in a parameter says nothing of it, however open it is.
        part = np.where(np.abs(directions) > 1e-6, directions, 0.0)
        scaled = np.where(part == 0, 0.0, part * open_[:, None])
        errors = np.sqrt(np.sum(scaled**2, axis=0))
        correlation = (scaled.T @ scaled) / np.outer(errors, errors)
    apart = np.abs(rivals).max(axis=0, initial=0.0)
    agree = apart <= np.maximum(4 * errors, 0.05)
    return Identifiability(
        names=names,
        errors=errors * width,
        correlation=correlation,
        singular_values=singular / max(noise, 1e-300),
        directions=directions,
        at_bound=at_bound,
        identified=(errors < UNIFORM) & agree,
        independent=measured / correlation_time(residual),
    )


def noise_of(residual: NDArray, measured: int, free: int) -> float:
    """Variance per independent residual that a fit of `free` parameters leaves."""
    return float(np.sum(residual**2)) / max(measured - free, 1) * correlation_time(residual)


def correlation_time(residual: NDArray) -> float:
    """Samples per independent one, from the lag-one correlation of residuals (n, P, d_y)."""
    power = float(np.sum(residual**2))
    if power == 0 or residual.shape[1] < 2:
        return 1.0
    alike = float(np.sum(residual[:, 1:] * residual[:, :-1])) / power
    alike = min(max(alike, 0.0), 0.999)
    return (1 + alike) / (1 - alike)
