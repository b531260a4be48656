"""The evidence for a hypothesis about commands: Gaussian beliefs, Student's t noise, Laplace.

Rows are hypotheses about trajectories, all solved together. Every belief is normalised, so that
rows with more freedom pay for it (Occam's factor: MacKay, Neural Comput. 4, 415, 1992), and what a
row leaves unseen costs nothing. The integral over x is Laplace's (Tierney and Kadane, J. Am. Stat.
Assoc. 81, 82, 1986); Student's t, which lets glitches pass, is met by reweighted least squares
(Lange, Little and Taylor, J. Am. Stat. Assoc. 84, 881, 1989).

The constants here are numerical: they trade time for accuracy. Those of the noise are those of
`retwin.update.corrections.command_inference`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from retwin.update.corrections.command_inference import LOOKS, TAILS
from retwin.update.corrections.command_problem import Problem
from retwin.update.corrections.warp import read

__all__ = ["Belief", "Fit", "Noise", "best_pattern", "reach", "solve"]

STEPS = 15
"""Of Gauss-Newton at most."""
DAMPING = 1e-3
"""Of the first step, in shares of the curvature."""
REWEIGHTED = 3
"""Times that readings are weighted anew within a step."""
ENOUGH = 1e-2
"""Gain of a step, in nats, at which a row is done."""
FLIPS = 3
"""Missed movements per row at most."""
WORST = 2
"""Movements of a row that one turn may try as missed."""
MARGIN = 20.0
"""Log evidence at which a row is given up: behind the best of its trajectory, or its own best."""


@dataclass(frozen=True, eq=False)
class Noise:
    """What is left unexplained of a healthy reading.

    Attributes
    ----------
    scale: (2, d_y) of an output's error at rest and in motion, in its unit.
    thinning: (2,) readings per independent one, at rest and in motion.

    """

    scale: Tensor
    thinning: Tensor

    def distance(self, problem: Problem, residual: Tensor) -> Tensor:
        """Square of the residual (R, S) in scales."""
        return (residual / self.scale[problem.moving.long()]).square().sum(dim=-1)

    def share(self, problem: Problem) -> Tensor:
        """How many independent readings each one is (R, S); 0 where nothing was measured."""
        return problem.seen / self.thinning[problem.moving.long()]

    def weights(self, problem: Problem, residual: Tensor) -> Tensor:
        """How much each reading (R, S) counts: 1 or so, less for glitches."""
        size = residual.shape[-1]
        return (TAILS + size) / (TAILS + self.distance(problem, residual))

    def misfit(self, problem: Problem, residual: Tensor) -> Tensor:
        """Minus the log likelihood of each reading (R, S), up to what all hypotheses share."""
        half = 0.5 * (TAILS + residual.shape[-1])
        return half * torch.log1p(self.distance(problem, residual) / TAILS) * self.share(problem)

    def usual(self, problem: Problem) -> Tensor:
        """The mean of `misfit` (R, S) if the hypothesis is true."""
        half = torch.tensor(0.5 * (TAILS + problem.observed.shape[-1]), dtype=torch.float64)
        tail = torch.tensor(0.5 * TAILS, dtype=torch.float64)
        return half * (torch.digamma(half) - torch.digamma(tail)) * self.share(problem)

    @classmethod
    def first(cls, residual: Tensor, problem: Problem) -> Noise:
        """As wide as the median of what is unexplained at first, (R, S, d_y)."""
        told = residual[problem.seen > 0].abs()
        scale = (
            1.4826 * told.median(dim=0).values
            if len(told)
            else residual.new_ones(residual.shape[-1])
        )
        return cls(scale.clamp_min(1e-12).repeat(2, 1), torch.ones(2, dtype=torch.float64))

    def learned(self, problem: Problem, fit: Fit) -> Noise:
        """The most likely noise of trajectories that were fitted, and how alike readings err."""
        residual, jacobian = problem.linearised(fit.x, fit.missed)
        unsure = torch.einsum("nsyp,npq,nsyq->nsy", jacobian, fit.covariance, jacobian)
        weights = self.weights(problem, residual)[..., None]
        scale, thinning = [], []
        rest, motion = problem.seen * (1 - problem.moving), problem.seen * problem.moving
        for k, (part, looks) in enumerate(zip((rest, motion), LOOKS, strict=True)):
            count = part.sum()
            if not count:
                scale.append(self.scale[k])
                thinning.append(self.thinning[k])
                continue
            square = weights * (residual.square() + unsure) * part[..., None]
            scale.append((square.sum(dim=(0, 1)) / count).sqrt())
            kept = residual / self.scale[k] * (weights * part[..., None]).sqrt()
            power = (kept[:, 1:].square() * part[:, :-1, None]).sum().clamp_min(1e-30)
            alike = ((kept[:, 1:] * kept[:, :-1]).sum() / power).clamp(0, 0.95)
            # Readings of one part of a movement err together: by rounding, by friction.
            crowd = count / (looks * problem.valid.sum().clamp_min(1))
            thinning.append(((1 + alike) / (1 - alike)).maximum(crowd))
        least = 1e-6 * torch.stack(scale).amax().clamp_min(1e-12)
        return Noise(torch.stack(scale).clamp_min(least), torch.stack(thinning))


@dataclass(frozen=True, eq=False)
class Belief:
    """What is believed of x before an output is seen: a Gaussian, and odds of missed movements.

    Attributes
    ----------
    mean: (R, P), the components of x (R, M, 1 + d_u) in a row.
    covariance: (R, P, P).
    odds: (R, M, d_u), log odds that an actuator misses a movement.

    """

    mean: Tensor
    covariance: Tensor
    odds: Tensor
    precision: Tensor
    volume: Tensor  # (R,) log determinant of the precision

    @classmethod
    def of(cls, mean: Tensor, covariance: Tensor, odds: Tensor) -> Belief:
        """The belief with that covariance."""
        precision = torch.linalg.inv(covariance)
        return cls(mean, covariance, odds, precision, -torch.linalg.slogdet(covariance)[1])

    def __getitem__(self, rows: Tensor) -> Belief:
        return Belief(*(each[rows] for each in vars(self).values()))

    def pull(self, x: Tensor) -> Tensor:
        """The slope (R, P) of minus the log density."""
        return torch.einsum("npq,nq->np", self.precision, x.flatten(1) - self.mean)

    def energy(self, x: Tensor) -> Tensor:
        """Minus the log density (R,), up to its normalisation."""
        return 0.5 * ((x.flatten(1) - self.mean) * self.pull(x)).sum(dim=1)

    def occam(self, curvature: Tensor) -> Tensor:
        """Log (R,) of the share of what was believed that a posterior of this curvature keeps."""
        return 0.5 * (self.volume - torch.linalg.slogdet(curvature)[1])

    def deviation(self) -> Tensor:
        """Standard deviations (R, P)."""
        return self.covariance.diagonal(dim1=1, dim2=2).sqrt()


@dataclass(frozen=True, eq=False)
class Fit:
    """The most probable x of every row.

    Attributes
    ----------
    x: (R, M, 1 + d_u).
    missed: (R, M, d_u), 1 for a movement that did not take place.
    covariance: (R, P, P), Laplace's.
    evidence: (R,) log evidence of this pattern of missed movements, its probability included.

    """

    x: Tensor
    missed: Tensor
    covariance: Tensor
    evidence: Tensor

    def __getitem__(self, rows: Tensor) -> Fit:
        return Fit(*(each[rows] for each in vars(self).values()))

    def put(self, rows: Tensor, other: Fit) -> Fit:
        """The same with other fits in some rows."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Fit(*(mine.index_copy(0, rows, theirs) for mine, theirs in pairs))


def solve(
    problem: Problem,
    x: Tensor,
    missed: Tensor,
    belief: Belief,
    noise: Noise,
    least: Tensor | None = None,
) -> Fit:
    """Gauss-Newton with Levenberg's damping and reweighting, until no row gains.

    A row that its second or a later step does not promise to bring within `MARGIN` of the log
    evidence `least` (R,) is given up: its evidence is -inf, its covariance NaN. Steps that are
    damped more than the first one promise too little to be judged by.
    """
    x = x.clone()
    energy = _energy(problem, x, missed, belief, noise)
    damping = torch.full((len(x),), DAMPING, dtype=torch.float64)
    # A held actuator can miss nothing any more: only the others' movements are at risk.
    risk = torch.nn.functional.softplus(belief.odds) * problem.healthy
    odds = (missed * belief.odds - risk).sum(dim=(1, 2))
    low, high = problem.operator.delay_range
    active, worth = torch.arange(len(x)), torch.ones(len(x), dtype=torch.bool)
    for step in range(STEPS):
        part, prior, pattern = problem[active], belief[active], missed[active]
        residual, jacobian = part.linearised(x[active], pattern)
        move, curvature = reach(part, x[active], residual, jacobian, prior, noise, damping[active])
        trial = x[active] + move.unflatten(1, x.shape[1:])
        going = torch.ones(len(active), dtype=torch.bool)
        if least is not None and step:
            left = residual - torch.einsum("nsyp,np->nsy", jacobian, move)
            promised = noise.misfit(part, left).sum(dim=1) + prior.energy(trial)
            promised = prior.occam(curvature) - promised + odds[active]
            going = (promised > least[active] - MARGIN) | (damping[active] > DAMPING)
            worth[active] = going
        trial[..., 0] = trial[..., 0].clamp(low, high)
        there = _energy(part, trial, pattern, prior, noise)
        gain = energy[active] - there
        better = gain >= 0
        x[active] = torch.where(better[:, None, None], trial, x[active])
        energy[active] = torch.where(better, there, energy[active])
        damping[active] = (damping[active] * torch.where(better, 0.25, 8.0)).clamp(1e-9, 1e6)
        active = active[going & ~(better & (gain < ENOUGH))]
        if not len(active):
            break
    evidence = torch.full_like(energy, -torch.inf)
    covariance = torch.full_like(belief.covariance, torch.nan)
    kept = worth.nonzero()[:, 0]
    if len(kept):
        part, prior = problem[kept], belief[kept]
        told = part.linearised(x[kept], missed[kept])
        curvature = _normal(part, *told, noise)[0] + prior.precision
        evidence[kept] = prior.occam(curvature) - energy[kept] + odds[kept]
        covariance[kept] = torch.linalg.inv(curvature)
    return Fit(x, missed, covariance, evidence)


def _energy(problem: Problem, x: Tensor, missed: Tensor, belief: Belief, noise: Noise) -> Tensor:
    """Minus the log posterior (R,), up to what all rows of a trajectory share."""
    misfit = noise.misfit(problem, problem.residual(x, missed))
    return misfit.sum(dim=1) + belief.energy(x)


def reach(
    problem: Problem,
    x: Tensor,
    residual: Tensor,
    jacobian: Tensor,
    belief: Belief,
    noise: Noise,
    damping: Tensor,
) -> tuple[Tensor, Tensor]:
    """The step (R, P) from x to the optimum of the linearised problem; its curvature (R, P, P).

    Reweighted on the way: that is cheap, and asking the surrogate is not.
    """
    pull = belief.pull(x)
    move = torch.zeros_like(pull)
    for _ in range(REWEIGHTED):
        left = residual - torch.einsum("nsyp,np->nsy", jacobian, move)
        curvature, slope = _normal(problem, left, jacobian, noise)
        curvature = curvature + belief.precision
        raised = damping[:, None] * curvature.diagonal(dim1=1, dim2=2)
        pulled = pull + torch.einsum("npq,nq->np", belief.precision, move) + raised * move
        move = move + torch.linalg.solve(curvature + torch.diag_embed(raised), slope - pulled)
    return move, curvature


def _normal(
    problem: Problem, residual: Tensor, jacobian: Tensor, noise: Noise
) -> tuple[Tensor, Tensor]:
    """Curvature (R, P, P) of the reweighted misfit, and how it falls (R, P)."""
    weight = noise.weights(problem, residual) * noise.share(problem)
    scaled = weight[..., None] / noise.scale[problem.moving.long()].square()
    weighted = (jacobian * scaled[..., None]).flatten(1, 2)
    curvature = weighted.mT @ jacobian.flatten(1, 2)
    return curvature, (weighted.mT @ residual.flatten(1)[..., None])[..., 0]


def best_pattern(
    problem: Problem, x: Tensor, belief: Belief, noise: Noise, group: Tensor
) -> tuple[Fit, Tensor]:
    """The most probable pattern of missed movements, and the log evidence (R,) of all tried.

    `group` (R,): the trajectory of each row. Greedy: in each turn the movements that are explained
    worst are tried as missed by every actuator that was to move. Rows that no pattern can bring
    near the best of their trajectory are left alone.
    """
    fit = solve(problem, x, torch.zeros_like(x[..., 1:]), belief, noise)
    total = fit.evidence
    rows = torch.arange(len(x))
    for _ in range(FLIPS):
        if not len(rows):
            break
        tries, movement, actuator = _suspects(problem, fit, belief, noise, group, rows)
        if not len(tries):
            break
        each = torch.arange(len(tries))
        pattern, begin = fit.missed[tries].clone(), fit.x[tries].clone()
        pattern[each, movement, actuator] = 1.0
        begin[each, movement, 1:] = 0.0
        told = fit.evidence[tries]
        tried = solve(problem[tries], begin, pattern, belief[tries], noise, told)
        rows, best = _best(tried.evidence, tries)
        total = _added(total, tried.evidence, tries)
        gains = tried.evidence[best] > fit.evidence[rows]
        rows, best = rows[gains], best[gains]
        fit = fit.put(rows, tried[best])
    return fit, total


def _best(evidence: Tensor, tries: Tensor) -> tuple[Tensor, Tensor]:
    """The rows that were tried, and the index of each one's best try."""
    order = torch.as_tensor(np.lexsort((evidence.numpy(), tries.numpy())))
    rows, counts = torch.unique_consecutive(tries[order], return_counts=True)
    return rows, order[counts.cumsum(dim=0) - 1]


def _added(total: Tensor, evidence: Tensor, tries: Tensor) -> Tensor:
    """Log of the sum of what each row had (R,) and what its tries add."""
    top = total.scatter_reduce(0, tries, evidence, "amax")
    share = (total - top).exp().index_add(0, tries, (evidence - top[tries]).exp())
    return top + share.log()


def _suspects(
    problem: Problem, fit: Fit, belief: Belief, noise: Noise, group: Tensor, rows: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Row, movement and actuator of every movement that is worth trying as missed."""
    part, prior = problem[rows], belief[rows]
    gain = (_surplus(part, fit[rows], prior, noise) + prior.odds.amax(dim=-1)).clamp_min(0)
    # What an actuator does in the movement in which it is held lasts through all that follow.
    lasting = part.healthy.clone()
    lasting[:, :-1] &= part.valid[:, 1:, None] & ~part.healthy[:, 1:]
    lasting[:, -1:] = False
    # A try cannot gain more than what is explained worse than usual, in as many movements.
    most = gain.topk(min(FLIPS, gain.shape[1]), dim=1).values.sum(dim=1)
    most = torch.where(lasting.any(dim=(1, 2)), gain.sum(dim=1), most)
    best = torch.full((len(fit.x),), -torch.inf, dtype=torch.float64)
    best = best.scatter_reduce(0, group, fit.evidence, "amax")
    hopeful = (most > 0) & (fit.evidence[rows] + most > best[group[rows]] - MARGIN)
    worst = (gain > 0) & (gain >= gain.topk(min(WORST, gain.shape[1]), dim=1).values[:, -1:])
    first, last = (
        read(part.told, torch.as_tensor(t)) for t in (part.segments.start, part.segments.settle)
    )
    # Where next to nothing was to move nothing can be missed.
    moving = (last - first).abs() > 2 * prior.deviation().unflatten(1, fit.x.shape[1:])[..., 1:]
    chosen = hopeful[:, None, None] & (worst[..., None] | lasting) & moving & part.healthy
    row, movement, actuator = (chosen & (fit.missed[rows] < 0.5)).nonzero().unbind(dim=1)
    return rows[row], movement, actuator


def _surplus(problem: Problem, fit: Fit, belief: Belief, noise: Noise) -> Tensor:
    """How much worse than usual each movement (R, M) is explained, in nats: the most to be gained.

    What is explained better than usual does not make up for an x that is strange.
    """
    residual = problem.residual(fit.x, fit.missed)
    misfit = noise.misfit(problem, residual) - noise.usual(problem)
    # Errors of movements are believed together: each one's share of what that costs.
    strange = 0.5 * (fit.x.flatten(1) - belief.mean) * belief.pull(fit.x)
    strange = strange.unflatten(1, fit.x.shape[1:]).sum(dim=-1)
    return (problem.inside() * misfit[:, None]).sum(dim=-1).clamp_min(0) + strange
