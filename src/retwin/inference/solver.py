"""Maximum a posteriori by damped Gauss-Newton, and Laplace's approximation there.

All rows of a problem are solved together. Robust noise is handled by iteratively reweighted least
squares, damping follows Levenberg and Marquardt (Nocedal and Wright, Numerical Optimization, 2006,
chapter 10), steps that converge linearly, as reweighting does, are extrapolated (Aitken, Proc. R.
Soc. Edinburgh 46, 289, 1927), and the evidence is Laplace's (Tierney and Kadane, J. Am. Stat.
Assoc. 81, 82, 1986): a normalised prior makes rows with more freedom pay for it (MacKay, Neural
Comput. 4, 415, 1992).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from retwin.inference.noise import Noise
from retwin.inference.normal import compiled_objective, compiled_step
from retwin.inference.problem import GaussianPrior, Problem, Rows, inverse

MAX_STEPS = 25
"""Gauss-Newton steps at most."""
REWEIGHTINGS = 3
"""Times that samples are weighted anew within a step: cheap beside a call of the surrogate."""
DAMPING = 1e-6
"""Damping to begin with, relative to the diagonal of the curvature: next to none."""
LARGEST_RATIO = 0.8
"""Largest ratio of successive moves that is extrapolated: a move is made at most five times."""


@dataclass(frozen=True, eq=False)
class Bounds:
    """Limits of the latent variables and of one step.

    Attributes
    ----------
    lower, upper : Tensor
        (P,), infinite where there is none.
    step : Tensor
        (P,), largest change in one step, infinite where there is none.

    """

    lower: Tensor
    upper: Tensor
    step: Tensor

    def moved(self, x: Tensor, move: Tensor) -> Tensor:
        """`x` after the part of `move` that is within the limits, both (R, P)."""
        return (x + move.clamp(-self.step, self.step)).clamp(self.lower, self.upper)


@dataclass(frozen=True, eq=False)
class Solution(Rows):
    """The most probable latent variables of R rows, and the Gaussian approximation there.

    Attributes
    ----------
    x : Tensor
        (R, P).
    objective : Tensor
        (R,), minus the log posterior in nats, up to the density of noise and prior at 0.
    curvature : Tensor
        (R, P, P), of the objective; NaN for a row that was given up.
    evidence : Tensor
        (R,), Laplace's log evidence, up to the density of the noise at 0; -inf for a row that was
        given up.
    gradient : Tensor
        (R, P), of the objective: 0, except where limits of x, damping or too few steps keep it from
        its optimum.

    """

    x: Tensor
    objective: Tensor
    curvature: Tensor
    evidence: Tensor
    gradient: Tensor

    @classmethod
    def of_prior(cls, prior: GaussianPrior, x: Tensor) -> Solution:
        """At x (R, P), without any measured output."""
        energy = prior.energy(x)
        return cls(x, energy, prior.precision, -energy, prior.gradient(x))

    @property
    def covariance(self) -> Tensor:
        """Posterior covariance (R, P, P)."""
        return inverse(self.curvature)


def blocks(covariance: Tensor, count: int) -> Tensor:
    """Covariance of each of `count` parts of x, (R, count, P / count, P / count), of (R, P, P)."""
    whole = covariance.unflatten(2, (count, -1)).unflatten(1, (count, -1))
    return whole.diagonal(dim1=1, dim2=3).movedim(-1, 1).clone()


def best_per_row(evidence: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """The rows among `rows` (k,), each once, and the index (·,) of the best alternative of each."""
    order = torch.as_tensor(np.lexsort((evidence.numpy(), rows.numpy())))
    different, counts = torch.unique_consecutive(rows[order], return_counts=True)
    return different, order[counts.cumsum(dim=0) - 1]


def added_evidence(total: Tensor, evidence: Tensor, rows: Tensor) -> Tensor:
    """Log sum (R,) of the evidence that each row had and of that (k,) of its alternatives."""
    top = total.scatter_reduce(0, rows, evidence, "amax")
    share = (total - top).exp().index_add(0, rows, (evidence - top[rows]).exp())
    return top + share.log()


@dataclass(frozen=True, eq=False)
class GaussNewtonStep:
    """A damped Gauss-Newton step from x, and what the linearised problem predicts of it.

    Attributes
    ----------
    x : Tensor
        (R, P), after the step.
    objective : Tensor
        (R,), predicted there.
    curvature : Tensor
        (R, P, P), of the objective before the step, without damping.
    log_determinant : Tensor
        (R,), of the curvature.

    """

    x: Tensor
    objective: Tensor
    curvature: Tensor
    log_determinant: Tensor


def gauss_newton_step(
    problem: Problem,
    prior: GaussianPrior,
    noise: Noise,
    x: Tensor,
    linearised: tuple[Tensor, Tensor],
    *,
    damping: Tensor | None = None,
    bounds: Bounds | None = None,
    reweightings: int = REWEIGHTINGS,
) -> GaussNewtonStep:
    """The step from x (R, P) to the optimum of the linearised problem, samples being reweighted.

    Parameters
    ----------
    linearised : tuple of Tensor
        Residual (R, K, d) and Jacobian (R, K, d, P) at x.
    damping : Tensor, optional
        (R,), relative to the diagonal of the curvature; 0 by default.
    bounds : Bounds, optional
        Limits of x.
    reweightings : int
        Times that samples are weighted anew, at least 1.

    """
    free = x.new_full((x.shape[1],), torch.inf)
    limits = (-free, free, free) if bounds is None else (bounds.lower, bounds.upper, bounds.step)
    made = compiled_step(problem, prior, noise, x, linearised, damping, limits, reweightings)
    if made is not None:
        return GaussNewtonStep(*made)
    residual, jacobian = linearised
    # Curvature and slope in one product: what takes time here is to pass through the Jacobian.
    joined = torch.cat([jacobian, residual[..., None]], dim=-1).flatten(1, 2)
    gradient, left = prior.gradient(x), residual
    for count in range(reweightings):
        weighted = joined * noise.precision(problem, left).flatten(1)[..., None]
        product = weighted[..., :-1].mT @ joined
        curvature = product[..., :-1] + prior.precision
        if not count:
            undamped = curvature
        slope = product[..., -1] - gradient
        if damping is not None:
            added = damping[:, None] * curvature.diagonal(dim1=1, dim2=2)
            curvature = curvature + torch.diag_embed(added)
        move = _solved(curvature, slope)
        left = _left(joined, move).view_as(residual)
    there = x + move
    if bounds is not None:
        there = bounds.moved(x, move)
        left = _left(joined, there - x).view_as(residual)
    predicted = noise.misfit(problem, left).sum(dim=1) + prior.energy(there)
    return GaussNewtonStep(there, predicted, undamped, torch.linalg.slogdet(undamped)[1])


def solve(
    problem: Problem,
    prior: GaussianPrior,
    noise: Noise,
    start: Tensor,
    *,
    bounds: Bounds | None = None,
    minimum_evidence: Tensor | None = None,
    reweightings: int = REWEIGHTINGS,
    tolerance: float = 1e-4,
    damping_after_failure: float = 1e-3,
) -> Solution:
    """The most probable latent variables, from `start` (R, P) on.

    Parameters
    ----------
    problem : Problem
        R rows.
    prior : GaussianPrior
        Of the same rows.
    noise : Noise
        Of all groups of samples.
    bounds : Bounds, optional
        Limits of x.
    minimum_evidence : Tensor, optional
        (R,), log evidence; a row is given up when its second or a later step is not predicted to
        reach that much. Steps that are damped more than the first one predict too little to be
        judged by.
    reweightings : int
        Times that samples are weighted anew within a step, at least 1: fewer where the Jacobian
        costs less than that.
    tolerance : float, default 1e-4
        Predicted decrease of the objective, in nats, below which a row has converged.
    damping_after_failure : float, default 1e-3
        Damping at least, after a step that did not decrease the objective.

    """
    x, linearised = start, problem.linearised(start)
    energy = _objective(problem, prior, noise, x, linearised[0])
    size = x.shape[1]
    unknown = x.new_full((len(x), size, size), torch.nan)
    nowhere = torch.full_like(energy, -torch.inf)
    found = Solution(x, energy, unknown, nowhere, torch.zeros_like(x))
    rows, damping = torch.arange(len(x)), torch.full_like(energy, DAMPING)
    before = torch.zeros_like(x)
    for count in range(MAX_STEPS + 1):
        how: Any = {"damping": damping, "bounds": bounds, "reweightings": reweightings}
        step = gauss_newton_step(problem, prior, noise, x, linearised, **how)
        occam = 0.5 * (prior.log_determinant - step.log_determinant)
        done = (energy - step.objective < tolerance) | (count == MAX_STEPS)
        if minimum_evidence is not None and count:
            hopeless = (occam - step.objective <= minimum_evidence[rows]) & (damping <= DAMPING)
        else:
            hopeless = torch.zeros_like(done)
        ended = (done & ~hopeless).nonzero()[:, 0]
        if len(ended):
            # So much damping that steps gain nothing, or no more steps, are no optimum.
            open_ = _at_limits(x, bounds) | (damping > DAMPING) | (count == MAX_STEPS)
            gradient = _gradient(problem, prior, noise, x, linearised, done & open_)
            part = Solution(x, energy, step.curvature, occam - energy, gradient)
            found = found.put(rows[ended], part[ended])
        going = (~done & ~hopeless).nonzero()[:, 0]
        if not len(going):
            break
        end, curvature = step.x, step.curvature
        if len(going) < len(rows):
            end, curvature = end[going], curvature[going]
            problem, prior, rows = problem[going], prior[going], rows[going]
            x, energy, damping, before = x[going], energy[going], damping[going], before[going]
            linearised = linearised[0][going], linearised[1][going]
        move = end - x
        factor = _extrapolation(move, before, curvature)
        trial = x + factor[:, None] * move
        if bounds is not None:
            trial = bounds.moved(x, trial - x)
        tried = problem.linearised(trial)
        there = _objective(problem, prior, noise, trial, tried[0])
        better = there <= energy
        x = torch.where(better[:, None], trial, x)
        energy = torch.where(better, there, energy)
        if not better.all():
            worse = (~better).nonzero()[:, 0]
            residual, jacobian = (
                new.index_copy(0, worse, old[worse])
                for new, old in zip(tried, linearised, strict=True)
            )
            tried = residual, jacobian
        linearised = tried
        raised = (8 * damping).clamp(damping_after_failure, 1e6)
        raised = torch.where(factor > 1, damping, raised)
        damping = torch.where(better, (damping / 4).clamp_min(1e-9), raised)
        before = torch.where(better[:, None], move, 0.0)
    return found


def _objective(
    problem: Problem, prior: GaussianPrior, noise: Noise, x: Tensor, residual: Tensor
) -> Tensor:
    """Minus the log posterior (R,) at x (R, P), see `Solution`."""
    made = compiled_objective(problem, prior, noise, x, residual)
    if made is not None:
        return made
    return noise.misfit(problem, residual).sum(dim=1) + prior.energy(x)


def _at_limits(x: Tensor, bounds: Bounds | None) -> Tensor:
    """Rows (R,) of x (R, P) that a limit keeps from an optimum."""
    if bounds is None:
        return x.new_zeros(len(x), dtype=torch.bool)
    return ((x <= bounds.lower) | (x >= bounds.upper)).any(dim=1)


def _gradient(
    problem: Problem,
    prior: GaussianPrior,
    noise: Noise,
    x: Tensor,
    linearised: tuple[Tensor, Tensor],
    some: Tensor,
) -> Tensor:
    """The gradient (R, P) of a `Solution` at x of the rows `some` (R,) bool, 0 of the others."""
    gradient = torch.zeros_like(x)
    rows = some.nonzero()[:, 0]
    if len(rows):
        residual, jacobian = (each[rows] for each in linearised)
        weighted = (residual * noise.precision(problem[rows], residual)).flatten(1)
        slope = (jacobian.flatten(1, 2).mT @ weighted[..., None])[..., 0]
        gradient[rows] = prior[rows].gradient(x[rows]) - slope
    return gradient


def _extrapolation(move: Tensor, before: Tensor, metric: Tensor) -> Tensor:
    """The factor (R,) of moves (R, P) that converge linearly, as reweighting does: 1 / (1 - ρ).

    ρ is the part of the move before that is left, in the metric (R, P, P). The sum of a geometric
    series is what such moves would reach (Aitken's method). Moves in another direction than before
    have the factor 1.
    """
    left = (metric @ torch.stack([move, before], dim=-1)).mT
    own, common = (left[:, 0] * move).sum(dim=1), (left[:, 0] * before).sum(dim=1)
    last = (left[:, 1] * before).sum(dim=1).clamp_min(1e-30)
    ratio = (common / last).clamp(0.0, LARGEST_RATIO)
    # Cosine of the angle between successive moves above which they are extrapolated.
    aligned = (common > 0) & (common.square() > 0.9**2 * own * last)
    return torch.where(aligned, 1 / (1 - ratio), 1.0)


def _left(joined: Tensor, move: Tensor) -> Tensor:
    """Residual (R, K d) of the linearised problem after a move (R, P)."""
    return (joined @ torch.cat([-move, torch.ones_like(move[:, :1])], dim=1)[..., None])[..., 0]


def _solved(matrix: Tensor, right: Tensor) -> Tensor:
    """Solution (R, P) of linear equations, scaled to a unit diagonal: units differ by orders."""
    unit = matrix.diagonal(dim1=1, dim2=2).sqrt()
    scaled = matrix / unit[:, :, None] / unit[:, None, :]
    return torch.linalg.solve(scaled, right / unit) / unit
