"""z* of `CommandSpace` from outputs alone: maximum a posteriori, evidence, empirical Bayes.

Outputs seldom identify the errors of all actuators; where they do not, a prior decides. Its widths,
the noise and the probability of a missed segment are not set by hand but learned from all
trajectories together (type-II maximum likelihood, by expectation-maximisation with Laplace's
approximation). Whether an actuator missed a segment is decided by comparing evidence.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from retwin.checks import require
from retwin.inference.em import expectation_maximisation
from retwin.inference.noise import Noise
from retwin.inference.priors import GaussianPrior
from retwin.inference.solver import Solution
from retwin.update.corrections.command_delays import delay_variance
from retwin.update.corrections.command_problem import CommandProblem
from retwin.update.corrections.correction import Context, Discrepancy, block_diagonal
from retwin.update.corrections.delays import at_bound, first_delays
from retwin.update.corrections.missed_segments import Fit, LatentPrior, Search, fitted, searched
from retwin.update.corrections.warp import gather_samples

__all__ = ["infer_commands"]

ROUNDS = 5
"""Rounds of expectation-maximisation, with a search for missed segments in each."""
SUSPECT = 2.5
"""Standard deviations of the prior beyond which an offset makes a segment suspect."""
MOVING = 3.0
"""Distance, in standard deviations of an offset, above which an actuator is to move."""
OUTLYING = 3.0
"""Noise scales beyond which a sample is an outlier."""
OUTLYING_SHARE = 0.3
"""Share of outliers above which a segment is suspect."""
FLAT = 30.0
"""Standard deviation of the prior, in that of a healthy offset, where a fault may be anything."""
FIRST_JITTER, SMALLEST_JITTER = 1 / 35, 1 / 350
"""Standard deviations of a delay at first beyond what first delays show, and at least, in widths of
its range."""
FLOOR = 1e-6
"""Smallest noise scale, in standard deviations of the outputs: the rounding of single precision."""


def infer_commands(
    context: Context,
    observed: Tensor,
    mask: Tensor,
    *,
    delay_range: tuple[float, float],
    max_samples: int,
    identified_below: float,
) -> Discrepancy:
    """z* (n, M, 1 + 2 d_u) for measured outputs (n, T, d_y), see `CommandSpace`.

    The range of delays is in samples.

    Raises
    ------
    InputError
        A trajectory has no sample at which all outputs are measured, while another has one.

    """
    _require_samples(mask)
    problem = CommandProblem.of(
        context, observed, mask, delay_range=delay_range, max_samples=max_samples
    )
    if not problem.valid.shape[1]:
        return _empty(problem)
    start = problem.zero
    problem.per_segment(start)[..., 0] = first_delays(problem, start, problem.delay_range)
    first = _Belief.of(problem, start)

    def infer(found: Search, belief: _Belief) -> Search:
        prior, noise = belief.prior(problem), belief.noise
        return searched(problem, prior, noise, found.fit, partial(_suspects, problem, prior, noise))

    def learn(found: Search, belief: _Belief) -> _Belief:
        return belief.learned(problem.with_missed(found.fit.missed), found.fit.solution)

    fit = Fit.of_prior(problem, first.prior(problem), start)
    found, belief = expectation_maximisation(
        Search(fit, fit.missed, fit.evidence), first, infer=infer, learn=learn, rounds=ROUNDS
    )
    problem = problem.with_missed(found.fit.missed)
    last = fitted(problem, belief.prior(problem), belief.noise, found.fit.x)
    return _discrepancy(problem, last.solution, found.probability, belief, identified_below)


def _require_samples(mask: Tensor) -> None:
    """InputError that names the trajectories of `mask` (n, T, d_y) without a usable sample.

    Where nothing at all was measured the prior stands for every trajectory, and nothing is
    identified: that is what `Correction` requires.
    """
    empty = ~mask.all(dim=-1).any(dim=1)
    index = empty.nonzero()[:, 0].tolist()
    several = len(index) > 1
    require(
        not index or not mask.any(),
        "mask",
        expected="in every trajectory at least one sample at which all outputs are measured",
        got=f"none in {'trajectories' if several else 'trajectory'} {', '.join(map(str, index))}",
        remedy=f"leave {'them' if several else 'it'} out, or correct the mask",
    )


def _empty(problem: CommandProblem) -> Discrepancy:
    """The discrepancy of trajectories without any segment."""
    n, _, width = problem.missed.shape
    z = problem.missed.new_zeros(n, 0, 1 + 2 * width)
    matrix = z[..., None] * z[..., None, :]
    noise = z.new_zeros(n)
    return Discrepancy(z, matrix, z > 0, noise, severity=problem.missed, posterior=True)


def _suspects(
    problem: CommandProblem, prior: LatentPrior, noise: Noise, fit: Fit, rows: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Trajectory, segment and actuator of every flip worth a trial.

    A segment is suspect if an offset is far beyond its prior, or if many of its samples are
    outliers; then every actuator that was to move is. What is missed may always turn out not to be.
    """
    part, x = problem[rows].with_missed(fit.missed[rows]), fit.x[rows]
    width = part.per_segment(prior.gaussian.deviation[rows])[..., 1:]
    far = (part.per_segment(x)[..., 1:].abs() > SUSPECT * width) & part.healthy
    outlying = noise.square(part, part.residual(x)) > OUTLYING**2
    share = (part.inside * outlying[:, None]).sum(dim=-1) / part.inside.sum(dim=-1).clamp_min(1)
    suspect = far.any(dim=-1) | (share > OUTLYING_SHARE)
    moving = part.distance > MOVING * width
    flips = suspect[..., None] & moving & part.healthy | (part.missed > 0.5)
    row, segment, actuator = flips.nonzero().unbind(dim=1)
    return rows[row], segment, actuator


@dataclass(frozen=True, eq=False)
class _Belief:
    """Hyperparameters, learned from all trajectories together."""

    delay: Tensor  # () mean, in samples
    jitter: Tensor  # () standard deviation of a delay
    offset: Tensor  # (d_u,) standard deviation of an offset, in the commands' units
    odds: Tensor  # () log odds that an actuator misses a segment
    noise: Noise  # one scale for all outputs, in `CommandProblem.unit`

    @classmethod
    def of(cls, problem: CommandProblem, start: Tensor) -> _Belief:
        """Wide, from first delays only."""
        delay = problem.per_segment(start)[..., 0][problem.valid]
        jitter = 1.4826 * (delay - delay.median()).abs().median() + FIRST_JITTER * problem.width
        measured = problem.measured > 0
        # The median and the spread of nothing are NaN.
        length = problem.residual(start).norm(dim=-1)[measured].median().nan_to_num(1.0)
        scale = length.clamp_min(FLOOR).expand(2, 1)
        commands = gather_samples(problem.reference, problem.sample)[measured]
        extent = (commands - commands.mean(dim=0)).square().mean(dim=0).sqrt()
        offset = 0.05 * extent.nan_to_num(1.0).clamp_min(1e-9)
        one = torch.ones(2, dtype=torch.float64)
        return cls(delay.median(), jitter, offset, -4.0 * one[0], Noise(scale, one))

    def prior(self, problem: CommandProblem) -> LatentPrior:
        """The distribution of (x, missed) before an output is measured."""
        mean, variance = problem.zero, problem.zero
        problem.per_segment(mean)[..., 0] = self.delay
        problem.per_segment(variance)[..., 0] = self.jitter.square()
        wide = torch.where(problem.faulty, FLAT * self.offset, self.offset)
        problem.per_segment(variance)[..., 1:] = wide.square()
        return LatentPrior(
            GaussianPrior.independent(mean, variance), self.odds.expand(problem.missed.shape)
        )

    def learned(self, problem: CommandProblem, solution: Solution) -> _Belief:
        """The most probable hyperparameters, given what was inferred and how certain that is."""
        x = solution.x
        delay, offset = problem.per_segment(x).split([1, problem.missed.shape[2]], dim=-1)
        variance = problem.per_segment(solution.covariance.diagonal(dim1=1, dim2=2))
        used = (problem.healthy & (problem.missed < 0.5)).double()
        second = ((offset.square() + variance[..., 1:]) * used).sum(dim=(0, 1))
        weight = problem.valid.double() / problem.valid.sum()
        mean = (delay[..., 0] * weight).sum()
        spread = (((delay[..., 0] - mean).square() + variance[..., 0]) * weight).sum()
        # Pseudo-observations: with few segments no width shrinks to nothing.
        scatter = (second + 2 * self.offset.square()) / (used.sum(dim=(0, 1)) + 2)
        missed = (problem.missed * problem.healthy).sum()
        return _Belief(
            delay=mean,
            jitter=spread.sqrt().clamp_min(SMALLEST_JITTER * problem.width),
            offset=scatter.sqrt(),
            odds=((missed + 0.5) / (problem.healthy.sum() + 20.0)).logit(),
            noise=self.noise.learned(
                problem, problem.residual(x), max_effective=problem.max_effective, floor=FLOOR
            ),
        )


def _discrepancy(
    problem: CommandProblem,
    solution: Solution,
    probability: Tensor,
    belief: _Belief,
    identified_below: float,
) -> Discrepancy:
    """z*, each segment's covariance, and which components the outputs identify."""
    x, missed = problem.per_segment(solution.x), problem.missed
    prior = belief.prior(problem).gaussian
    inner = solution.blocks(x.shape[1])
    wide = problem.per_segment(prior.deviation.square())
    left = inner.diagonal(dim1=-2, dim2=-1) / wide
    severity = torch.where(problem.faulty, x[..., 1:], 0.0)
    # Under a fault nothing was learned of the discrepancy: the prior stands.
    learned = torch.cat([problem.valid[..., None], problem.healthy], dim=-1).double()
    own = torch.cat([wide[..., :1], belief.offset.square().expand_as(severity)], dim=-1)
    inner = inner * learned[..., None] * learned[..., None, :]
    inner = inner + torch.diag_embed(own * (1 - learned))
    # Offsets stay as they are, and as much correlated with the delay.
    delays = delay_variance(problem, prior, belief.noise, solution.x)
    stretch = torch.ones_like(wide)
    stretch[..., 0] = (delays / inner[..., 0, 0]).sqrt()
    inner = inner * stretch[..., None] * stretch[..., None, :]
    covariance = block_diagonal(inner, torch.diag_embed(probability * (1 - probability)))
    known = (left < identified_below) & (learned > 0)
    bounded = at_bound(x[..., 0], problem.delay_range) & problem.valid
    known[..., 0] &= ~bounded
    known[..., 1:] &= missed < 0.5
    seen = problem.inside.any(dim=-1)[..., None] & problem.healthy
    identified = torch.cat([known, seen], dim=-1) & problem.valid[..., None]
    z = torch.cat([x * learned, missed], dim=-1) * problem.valid[..., None]
    noise = (belief.noise.scale[0, 0] * problem.unit.mean()).expand(len(x))
    return Discrepancy(z, covariance, identified, noise, severity, True, bounded)
