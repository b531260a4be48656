"""The most probable x of a hypothesis, and which segments its actuators missed.

Rows are hypotheses about trajectories, all solved together. The constants here are numerical: they
trade time for accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from retwin.diagnosis.latent_prior import LatentPrior
from retwin.inference.em import expectation_maximisation
from retwin.inference.evidence import added_evidence, best_per_row
from retwin.inference.losses import StudentT
from retwin.inference.noise import Noise
from retwin.inference.solver import Solution, solve
from retwin.update.corrections.command_problem import CommandProblem

__all__ = ["Fit", "best_fit", "fitted", "fitted_noise"]

SEARCHES = 3
"""Missed segments per row at most."""
WORST = 2
"""Segments of a row that one search may try as missed: the worst explained ones."""
MARGIN = 20.0
"""Log evidence at which a row is given up: behind the best of its trajectory, or its own best."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The most probable x of every row.

    Attributes
    ----------
    solution : Solution
        For `missed`.
    missed : Tensor
        (R, M, d_u), 1 for a segment that an actuator missed.
    evidence : Tensor
        (R,), log evidence of these missed segments, their probability included.

    """

    solution: Solution
    missed: Tensor
    evidence: Tensor

    @property
    def x(self) -> Tensor:
        """(R, P)."""
        return self.solution.x

    def __getitem__(self, rows: Tensor) -> Fit:
        """The fit of some rows."""
        return Fit(self.solution[rows], self.missed[rows], self.evidence[rows])

    def put(self, rows: Tensor, other: Fit) -> Fit:
        """The same with another fit in some rows."""
        return Fit(
            self.solution.put(rows, other.solution),
            self.missed.index_copy(0, rows, other.missed),
            self.evidence.index_copy(0, rows, other.evidence),
        )


def fitted(
    problem: CommandProblem,
    prior: LatentPrior,
    noise: Noise,
    start: Tensor,
    minimum_evidence: Tensor | None = None,
) -> Fit:
    """The most probable x (R, P) if the problem's segments were missed, and no others.

    Rows that are not predicted to reach the log evidence `minimum_evidence` (R,) are given up.
    """
    log_probability = prior.log_probability(problem)
    solution = solve(
        problem,
        prior.gaussian,
        noise,
        start,
        bounds=problem.bounds,
        minimum_evidence=None if minimum_evidence is None else minimum_evidence - log_probability,
    )
    return Fit(solution, problem.missed, solution.evidence + log_probability)


def best_fit(
    problem: CommandProblem, prior: LatentPrior, noise: Noise, start: Tensor, trajectory: Tensor
) -> tuple[Fit, Tensor]:
    """The most probable missed segments, and the log evidence (R,) of all that were tried.

    `trajectory` (R,) is the trajectory of each row. The search is greedy: each time the segments
    that are explained worst are tried as missed by every actuator that was to move. Rows that
    cannot come near the best of their trajectory are left alone.
    """
    fit = fitted(problem, prior, noise, start)
    total = fit.evidence
    rows = torch.arange(len(start))
    for _ in range(SEARCHES):
        tries, segment, actuator = _suspects(problem, fit, prior, noise, trajectory, rows)
        if not len(tries):
            break
        each = torch.arange(len(tries))
        missed, x = fit.missed[tries].clone(), fit.x[tries].clone()
        missed[each, segment, actuator] = 1.0
        problem.per_segment(x)[each, segment, 1:] = 0.0
        part = problem[tries].with_missed(missed)
        tried = fitted(part, prior[tries], noise, x, fit.evidence[tries] - MARGIN)
        total = added_evidence(total, tried.evidence, tries)
        rows, best = best_per_row(tried.evidence, tries)
        gains = tried.evidence[best] > fit.evidence[rows]
        rows, best = rows[gains], best[gains]
        fit = fit.put(rows, tried[best])
        if not len(rows):
            break
    return fit, total


def fitted_noise(problem: CommandProblem, prior: LatentPrior, *, rounds: int) -> Noise:
    """The noise of healthy trajectories, by so many rounds of expectation-maximisation."""
    start = prior.gaussian.mean
    nothing = Solution.of_prior(prior.gaussian, start)
    trajectory = torch.arange(len(start))

    def infer(fit: Fit, noise: Noise) -> Fit:
        return best_fit(problem, prior, noise, fit.x, trajectory)[0]

    def learn(fit: Fit, noise: Noise) -> Noise:
        residual, jacobian = problem.with_missed(fit.missed).linearised(fit.x)
        flat = jacobian.flatten(1, 2)
        variance = ((flat @ fit.solution.covariance) * flat).sum(dim=-1).view_as(residual)
        return noise.learned(
            problem, residual, max_effective=problem.max_effective, variance=variance
        )

    _, noise = expectation_maximisation(
        Fit(nothing, problem.missed, nothing.evidence),
        Noise.from_median(problem, problem.residual(start), groups=2),
        infer=infer,
        learn=learn,
        rounds=rounds,
    )
    return noise


def _suspects(
    problem: CommandProblem,
    fit: Fit,
    prior: LatentPrior,
    noise: Noise,
    trajectory: Tensor,
    rows: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Row, segment and actuator of all that is worth trying as missed."""
    part, own = problem[rows].with_missed(fit.missed[rows]), prior[rows]
    gain = (_surplus(part, fit.x[rows], own, noise) + own.odds.amax(dim=-1)).clamp_min(0)
    # What an actuator does in the segment in which it is held lasts through all that follow.
    lasting = part.healthy.clone()
    lasting[:, :-1] &= part.valid[:, 1:, None] & ~part.healthy[:, 1:]
    lasting[:, -1:] = False
    # A try cannot gain more than the surplus misfit, in as many segments as can be missed.
    bound = gain.topk(min(SEARCHES, gain.shape[1]), dim=1).values.sum(dim=1)
    bound = torch.where(lasting.any(dim=(1, 2)), gain.sum(dim=1), bound)
    best = torch.full((len(fit.x),), -torch.inf, dtype=torch.float64)
    best = best.scatter_reduce(0, trajectory, fit.evidence, "amax")
    hopeful = (bound > 0) & (fit.evidence[rows] + bound > best[trajectory[rows]] - MARGIN)
    worst = (gain > 0) & (gain >= gain.topk(min(WORST, gain.shape[1]), dim=1).values[:, -1:])
    # Where next to nothing was to move nothing can be missed.
    moving = part.distance > 2 * part.per_segment(own.deviation)[..., 1:]
    chosen = hopeful[:, None, None] & (worst[..., None] | lasting) & moving & part.healthy
    row, segment, actuator = (chosen & (part.missed < 0.5)).nonzero().unbind(dim=1)
    return rows[row], segment, actuator


def _surplus(problem: CommandProblem, x: Tensor, prior: LatentPrior, noise: Noise) -> Tensor:
    """How much more each segment (R, M) costs than expected of the truth, in nats.

    It bounds what can be gained. A misfit below its expectation does not make up for an improbable
    x.
    """
    residual = problem.residual(x)
    expected = cast(StudentT, noise.loss).expected(residual.shape[-1]) * noise.count(problem)
    misfit = noise.misfit(problem, residual) - expected
    # Errors of segments are correlated: each segment's share of what the prior costs.
    cost = 0.5 * (x - prior.gaussian.mean) * prior.gaussian.gradient(x)
    cost = problem.per_segment(cost).sum(dim=-1)
    return (problem.inside * misfit[:, None]).sum(dim=-1).clamp_min(0) + cost
