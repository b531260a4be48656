"""z* of `CommandSpace` from outputs alone: maximum a posteriori, evidence, empirical Bayes.

Outputs seldom identify the errors of all actuators; where they do not, a prior decides. Its widths,
the noise and the probability of a missed segment are not set by hand but learned from all
trajectories together (type-II maximum likelihood, by expectation-maximisation with Laplace's
approximation). Whether an actuator missed a segment is decided by comparing evidence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from retwin.checks import require
from retwin.inference.em import expectation_maximisation
from retwin.inference.evidence import best_per_row
from retwin.inference.noise import Noise
from retwin.inference.priors import GaussianPrior
from retwin.inference.solver import Solution, solve
from retwin.update.corrections.command_delays import delay_variance
from retwin.update.corrections.command_problem import CommandProblem
from retwin.update.corrections.correction import Context, Discrepancy
from retwin.update.corrections.warp import gather_samples

__all__ = ["infer_commands"]

ROUNDS = 5
"""Rounds of expectation-maximisation, with a search for missed segments in each."""
SEARCHES = 3
"""Missed segments per trajectory that one round may find."""
SUSPECT = 2.5
"""Standard deviations of the prior beyond which an offset makes a segment suspect."""
OUTLYING = 3.0
"""Noise scales beyond which a sample is an outlier."""
OUTLYING_SHARE = 0.3
"""Share of outliers above which a segment is suspect."""
FLAT = 30.0
"""Standard deviation of the prior, in that of a healthy offset, where a fault may be anything."""
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
    problem.per_segment(start)[..., 0] = problem.first_delays()
    first = _Belief.of(problem, start)
    state, belief = expectation_maximisation(
        _State(problem, Solution.of_prior(first.prior(problem), start), problem.missed),
        first,
        infer=_State.improved,
        learn=_Belief.learned,
        rounds=ROUNDS,
    )
    return _discrepancy(state.solved(belief), belief, identified_below)


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


@dataclass(frozen=True, eq=False)
class _State:
    """What was inferred of every trajectory."""

    problem: CommandProblem
    solution: Solution
    probability: Tensor  # (n, M, d_u), that an actuator missed a segment

    def solved(self, belief: _Belief) -> _State:
        """The most probable x for the same missed segments."""
        problem = self.problem
        x, bounds = self.solution.x, problem.bounds
        solution = solve(problem, belief.prior(problem), belief.noise, x, bounds=bounds)
        return replace(self, solution=solution)

    def improved(self, belief: _Belief) -> _State:
        """The most probable x; missed segments flipped where that has the greater evidence.

        Of each trajectory one is flipped at a time, the one that gains most.
        """
        state = self.solved(belief)
        probability = state.problem.missed
        for _ in range(SEARCHES):
            rows, segment, actuator = state._suspects(belief)
            if not len(rows):
                break
            each = torch.arange(len(rows))
            pattern = state.problem.missed[rows].clone()
            pattern[each, segment, actuator] = 1 - pattern[each, segment, actuator]
            sign = 2 * pattern[each, segment, actuator] - 1
            tried = state._tried(belief, rows, segment, pattern)
            gain = tried.evidence - state.solution.evidence[rows] + belief.odds * sign
            probability = probability.index_put(
                (rows, segment, actuator), torch.sigmoid(gain * sign)
            )
            _, best = best_per_row(gain, rows)
            best = best[gain[best] > 0]
            if not len(best):
                break
            missed = state.problem.missed.index_copy(0, rows[best], pattern[best])
            state = _State(
                state.problem.with_missed(missed),
                state.solution.put(rows[best], tried[best]),
                probability,
            )
        return replace(state, probability=probability)

    def _tried(self, belief: _Belief, rows: Tensor, segment: Tensor, missed: Tensor) -> Solution:
        """The solution of some trajectories if other segments were missed."""
        problem = self.problem[rows].with_missed(missed)
        start = self.solution.x[rows].clone()
        problem.per_segment(start)[torch.arange(len(rows)), segment, 1:] = 0.0
        prior = belief.prior(problem)
        return solve(problem, prior, belief.noise, start, bounds=problem.bounds)

    def _suspects(self, belief: _Belief) -> tuple[Tensor, Tensor, Tensor]:
        """Trajectory, segment and actuator of every flip worth a try.

        A segment is suspect if an offset is far beyond its prior, or if many of its samples are
        outliers; then every actuator that was to move is. What is missed may always turn out not to
        be.
        """
        problem = self.problem
        offset = problem.per_segment(self.solution.x)[..., 1:]
        far = (offset.abs() > SUSPECT * belief.offset) & problem.healthy
        residual = problem.residual(self.solution.x)
        square = belief.noise.square(problem, residual)
        outlying = (square > OUTLYING**2) * problem.measured
        inside = problem.inside
        share = (inside * outlying[:, None]).sum(dim=-1) / inside.sum(dim=-1).clamp_min(1)
        moving = problem.distance > 3 * belief.offset
        suspect = far.any(dim=-1) | (share > OUTLYING_SHARE)
        flips = suspect[..., None] & moving & problem.healthy | (problem.missed > 0.5)
        rows, segment, actuator = flips.nonzero().unbind(dim=1)
        return rows, segment, actuator


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
        jitter = 1.4826 * (delay - delay.median()).abs().median() + 1.0
        measured = problem.measured > 0
        # The median and the spread of nothing are NaN.
        length = problem.residual(start).norm(dim=-1)[measured].median().nan_to_num(1.0)
        scale = length.clamp_min(FLOOR).expand(2, 1)
        commands = gather_samples(problem.reference, problem.sample)[measured]
        extent = (commands - commands.mean(dim=0)).square().mean(dim=0).sqrt()
        offset = 0.05 * extent.nan_to_num(1.0).clamp_min(1e-9)
        one = torch.ones(2, dtype=torch.float64)
        return cls(delay.median(), jitter, offset, -4.0 * one[0], Noise(scale, one))

    def deviation(self, problem: CommandProblem) -> Tensor:
        """Standard deviation of x before an output is measured, (n, M, 1 + d_u)."""
        offset = torch.where(problem.faulty, FLAT * self.offset, self.offset)
        return torch.cat([self.jitter.expand_as(offset[..., :1]), offset], dim=-1)

    def prior(self, problem: CommandProblem) -> GaussianPrior:
        """The distribution of x before an output is measured."""
        mean = problem.zero
        problem.per_segment(mean)[..., 0] = self.delay
        return GaussianPrior.independent(mean, self.deviation(problem).flatten(1).square())

    @staticmethod
    def learned(state: _State, belief: _Belief) -> _Belief:
        """The most probable hyperparameters, given what was inferred and how certain that is."""
        problem, x = state.problem, state.solution.x
        delay, offset = problem.per_segment(x).split([1, problem.missed.shape[2]], dim=-1)
        variance = problem.per_segment(state.solution.covariance.diagonal(dim1=1, dim2=2))
        used = (problem.healthy & (problem.missed < 0.5)).double()
        second = ((offset.square() + variance[..., 1:]) * used).sum(dim=(0, 1))
        weight = problem.valid.double() / problem.valid.sum()
        mean = (delay[..., 0] * weight).sum()
        spread = (((delay[..., 0] - mean).square() + variance[..., 0]) * weight).sum()
        # Pseudo-observations: with few segments no width shrinks to nothing.
        scatter = (second + 2 * belief.offset.square()) / (used.sum(dim=(0, 1)) + 2)
        missed = (problem.missed * problem.healthy).sum()
        return _Belief(
            delay=mean,
            jitter=spread.sqrt().clamp_min(0.1),
            offset=scatter.sqrt(),
            odds=((missed + 0.5) / (problem.healthy.sum() + 20.0)).logit(),
            noise=belief.noise.learned(
                problem, problem.residual(x), max_effective=problem.max_effective, floor=FLOOR
            ),
        )


def _discrepancy(state: _State, belief: _Belief, identified_below: float) -> Discrepancy:
    """z*, each segment's covariance, and which components the outputs identify."""
    problem, solution = state.problem, state.solution
    x, missed = problem.per_segment(solution.x), problem.missed
    n, segments, size = x.shape
    whole = solution.covariance.reshape(n, segments, size, segments, size)
    index = torch.arange(segments)
    inner = whole[:, index, :, index].transpose(0, 1).clone()
    wide = belief.deviation(problem).square()
    left = inner.diagonal(dim1=-2, dim2=-1) / wide
    severity = torch.where(problem.faulty, x[..., 1:], 0.0)
    # Under a fault nothing was learned of the discrepancy: the prior stands.
    learned = torch.cat([problem.valid[..., None], problem.healthy], dim=-1).double()
    own = torch.cat([wide[..., :1], belief.offset.square().expand_as(severity)], dim=-1)
    inner = inner * learned[..., None] * learned[..., None, :]
    inner = inner + torch.diag_embed(own * (1 - learned))
    # Offsets stay as they are, and as much correlated with the delay.
    delays = delay_variance(problem, belief.prior(problem), belief.noise, solution.x)
    stretch = torch.ones_like(wide)
    stretch[..., 0] = (delays / inner[..., 0, 0]).sqrt()
    inner = inner * stretch[..., None] * stretch[..., None, :]
    width = size + missed.shape[-1]
    covariance = torch.zeros(n, segments, width, width, dtype=torch.float64)
    covariance[..., :size, :size] = inner
    covariance[..., size:, size:] = torch.diag_embed(state.probability * (1 - state.probability))
    known = (left < identified_below) & (learned > 0)
    known[..., 1:] &= missed < 0.5
    seen = problem.inside.any(dim=-1)[..., None] & problem.healthy
    identified = torch.cat([known, seen], dim=-1) & problem.valid[..., None]
    z = torch.cat([x * learned, missed], dim=-1) * problem.valid[..., None]
    noise = (belief.noise.scale[0, 0] * problem.unit.mean()).expand(n)
    return Discrepancy(z, covariance, identified, noise, severity=severity, posterior=True)
