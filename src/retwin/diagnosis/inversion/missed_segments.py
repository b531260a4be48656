"""The best fit of a hypothesis, with segments missed where they are explained worst.

Rows are hypotheses about trajectories, all solved together. The constants here are numerical: they
trade time for accuracy.
"""

from __future__ import annotations

from functools import partial
from typing import cast

import torch
from torch import Tensor

from retwin.inference.noise import Noise, StudentT, predicted_variance
from retwin.update.corrections.commands.missed_segments import (
    MARGIN,
    SEARCHES,
    CommandFit,
    LatentPrior,
    MissedSearch,
    searched,
)
from retwin.update.corrections.commands.problem import CommandProblem


def best_fit(
    problem: CommandProblem, prior: LatentPrior, noise: Noise, start: Tensor, trajectory: Tensor
) -> MissedSearch:
    """The most probable missed segments, from x (R, P) and none missed on.

    `trajectory` (R,) is the trajectory of each row. Each time the segments that are explained worst
    are tried as missed by every actuator that was to move. Rows that cannot come near the best of
    their trajectory are left alone.
    """
    suspects = partial(_suspects, problem, prior, noise, trajectory)
    return searched(problem, prior, noise, CommandFit.of_prior(problem, prior, start), suspects)


def fitted_noise(problem: CommandProblem, prior: LatentPrior, *, rounds: int) -> Noise:
    """The noise of healthy trajectories, by so many rounds of expectation-maximisation."""
    x = prior.gaussian.mean
    noise = Noise.from_median(problem, problem.residual(x), groups=2)
    for _ in range(rounds):
        fit = best_fit(problem, prior, noise, x, torch.arange(len(x))).fit
        x = fit.x
        residual, jacobian = problem.with_missed(fit.missed).linearised(x)
        variance = predicted_variance(jacobian, fit.solution.covariance)
        noise = problem.learned_noise(noise, residual, variance)
    return noise


def _suspects(
    problem: CommandProblem,
    prior: LatentPrior,
    noise: Noise,
    trajectory: Tensor,
    fit: CommandFit,
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
    # Segments of a row that one search may try as missed: the worst explained ones.
    worst = (gain > 0) & (gain >= gain.topk(min(2, gain.shape[1]), dim=1).values[:, -1:])
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
    cost = 0.5 * (x - prior.gaussian.mean) * prior.gaussian.gradient(x) + prior.excess(x)
    cost = problem.per_segment(cost).sum(dim=-1)
    return (problem.inside * misfit[:, None]).sum(dim=-1).clamp_min(0) + cost
