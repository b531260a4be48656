"""z* of `CommandSpace` from outputs alone: maximum a posteriori, evidence, empirical Bayes.

Outputs seldom identify the errors of all actuators; where they do not, a prior decides. Its mean,
which may depend on the pose and on the direction and the distance of the motion, its widths, the
noise and the probability of a missed segment are not set by hand but learned from all trajectories
together (type-II maximum likelihood, by expectation-maximisation with Laplace's approximation).
Whether an actuator missed a segment is decided by comparing evidence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from retwin.checks import require
from retwin.inference.hierarchy import CONDITION, Design, Hierarchy, Likelihood, normal
from retwin.inference.hyperprior import Hyperprior
from retwin.inference.noise import Noise
from retwin.inference.solver import Solution, blocks
from retwin.update.corrections.commands.first_missed import first_missed
from retwin.update.corrections.commands.held_out_conditions import regression_predicts_better
from retwin.update.corrections.commands.machines import MISSED, OtherMachines
from retwin.update.corrections.commands.machines import learned as machine
from retwin.update.corrections.commands.missed_segments import (
    CommandFit,
    LatentPrior,
    MissedSearch,
    fitted,
    searched,
)
from retwin.update.corrections.commands.offset_features import OffsetFeatures
from retwin.update.corrections.commands.problem import CommandProblem
from retwin.update.corrections.correction import Context, Discrepancy, block_diagonal
from retwin.update.corrections.delays import at_bound, first_delays
from retwin.update.corrections.sample_noise import SampleNoise
from retwin.workers.threads import one_thread

MOVING = 3.0
"""Distance, in standard deviations of an offset, above which an actuator is to move."""
FIRST_JITTER = 1 / 35
"""Standard deviation of a delay at first, beyond what first delays show, in widths of its range."""
FLOOR = 1e-6
"""Smallest noise scale, in standard deviations of the outputs: the rounding of single precision."""


@one_thread()
def infer_commands(
    context: Context,
    observed: Tensor,
    mask: Tensor,
    *,
    delay_range: tuple[float, float],
    max_samples: int,
    identified_below: float,
    max_rounds: int = 12,
    first_odds: float = -4.0,
) -> tuple[Discrepancy, Hyperparameters | None]:
    """z* (n, M, 1 + 2 d_u) for measured outputs (n, T, d_y), see `CommandSpace`.

    The range of delays is in samples.

    Parameters
    ----------
    max_rounds : int, default 12
        Rounds of expectation-maximisation at most, with a search for missed segments in each.
    first_odds : float, default -4.0
        Log odds at first that an actuator misses a segment: about one in fifty.

    Returns
    -------
    Discrepancy
        z* and what is known of it.
    Hyperparameters or None
        What was learned of the prior and the noise; None without any segment.

    Raises
    ------
    InputError
        A trajectory has no sample at which all outputs are measured, while another has one.

    """
    _require_samples(mask)
    problem = CommandProblem.of(
        context, observed, mask, delay_range=delay_range, max_samples=max_samples
    )
    problem = replace(problem, own_delays=True)
    if not problem.valid.shape[1]:
        return _empty(problem), None
    features, start = OffsetFeatures.of(problem), problem.zero
    replicates = features.replicates(problem)
    uncertain = problem.counted_once(replicates)
    problem = uncertain.where_certain
    missed = first_missed(problem, features.unit, first_odds)
    problem = problem.with_missed(missed)
    problem.per_segment(start)[..., 0] = first_delays(problem, start, problem.delay_range)
    others = context.others
    if others is not None:
        features = replace(features, constants_expected=True)
    first = Hyperparameters.of(problem, features, start, others, context.rate)
    # Replicates show no more of the variances than one does where the surrogate errs in all alike.
    weight = torch.ones_like(start[:, :1])
    if uncertain.common is not None:
        weight = (1 / replicates).mean(dim=1, keepdim=True)

    def infer(found: MissedSearch, given: Hyperparameters) -> MissedSearch:
        white, prior, noise = given.whitened(problem), given.prior(problem), given.noise
        return searched(white, prior, noise, found.fit, partial(_suspects, white, prior, noise))

    fit = CommandFit.of_prior(problem, first.prior(problem), start)
    found, learned = MissedSearch(fit, fit.missed, fit.evidence), first
    for regression in (False, True):
        if regression and not learned.explained(problem, found.fit, weight):
            break
        learned = learned.with_regression(problem, regression)
        for _ in range(max_rounds):
            found, before = infer(found, learned), learned
            missed, solution = found.fit.missed, found.fit.solution
            learned = before.learned(problem.with_missed(missed), solution, weight)
            if learned.near(before):
                break
    certain = None
    if uncertain.common is not None:
        certain = learned.linearised(problem, found.fit).weighted(weight)
        problem = uncertain
        found = infer(MissedSearch(fit, fit.missed, fit.evidence), learned)
    likelihood = learned.linearised(problem, found.fit)
    problem = problem.with_missed(found.fit.missed)
    posterior = learned.hierarchy.integrated(learned.features.design(problem), likelihood, certain)
    made = _discrepancy(
        problem, likelihood.x, posterior, found.probability, learned, identified_below
    )
    constant = learned.with_regression(problem, False)
    design = constant.features.design(problem)
    draws = constant.hierarchy.draws(design, certain or likelihood)
    shown = machine(draws, problem.missed, problem.healthy, context.rate)
    predicted = _predict_runs(problem, design, draws, learned.missed)
    return replace(made, learned=shown, predicted=predicted), learned


def _require_samples(mask: Tensor) -> None:
    """InputError that names the trajectories of `mask` (n, T, d_y) without a usable sample.

    Where nothing at all was measured the prior stands for every trajectory, and nothing is
    identified: that is what `Correction` requires.
    """
    empty = ~mask.all(dim=-1).any(dim=1)
    index = empty.nonzero()[:, 0].tolist()
    several = len(index) > 1
    expected = "in every trajectory at least one sample at which all outputs are measured"
    got = f"none in {'trajectories' if several else 'trajectory'} {', '.join(map(str, index))}"
    remedy = f"leave {'them' if several else 'it'} out, or correct the mask"
    require(not index or not mask.any(), "mask", expected=expected, got=got, remedy=remedy)


def _empty(problem: CommandProblem) -> Discrepancy:
    """The discrepancy of trajectories without any segment."""
    n, _, width = problem.missed.shape
    z = problem.missed.new_zeros(n, 0, 1 + 2 * width)
    matrix = z[..., None] * z[..., None, :]
    noise = z.new_zeros(n)
    return Discrepancy(z, matrix, z > 0, noise, severity=problem.missed, posterior=True)


def _suspects(
    problem: CommandProblem, prior: LatentPrior, noise: Noise, fit: CommandFit, rows: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Trajectory, segment and actuator of every flip worth a trial.

    A segment is suspect if an offset is far beyond its prior, or if many of its samples are
    outliers; then every actuator that was to move is. What is missed may always turn out not to be.
    """
    part, x = problem[rows].with_missed(fit.missed[rows]), fit.x[rows]
    offsets = slice(1, 1 + part.missed.shape[2])
    width = part.per_segment(prior.gaussian.deviation[rows])[..., offsets]
    away = part.per_segment(x - prior.gaussian.mean[rows])[..., offsets]
    # Standard deviations of the prior beyond which an offset makes a segment suspect.
    far = (away.abs() > 2.5 * width) & part.healthy
    # Noise scales beyond which a sample is an outlier.
    outlying = noise.square(part, part.residual(x)) > 3.0**2
    share = (part.inside * outlying[:, None]).sum(dim=-1) / part.inside.sum(dim=-1).clamp_min(1)
    # Share of outliers above which a segment is suspect.
    suspect = far.any(dim=-1) | (share > 0.3)
    moving = part.way > MOVING * width
    flips = suspect[..., None] & moving & part.healthy | (part.missed > 0.5)
    row, segment, actuator = flips.nonzero().unbind(dim=1)
    return rows[row], segment, actuator


@dataclass(frozen=True, eq=False)
class Hyperparameters:
    """Hyperparameters of the prior and the noise, learned from all trajectories together.

    Attributes
    ----------
    features : OffsetFeatures
        What the mean of an offset depends on.
    hierarchy : Hierarchy
        The prior of delays and offsets.
    odds : Tensor
        (), log odds that an actuator misses a segment.
    samples : SampleNoise
        Covariance of a sample's error, up to a factor.
    noise : Noise
        Size of that error, in `CommandProblem.unit`.
    missed : tuple of float
        Missed segments, and segments, that are assumed besides those measured.

    """

    features: OffsetFeatures
    hierarchy: Hierarchy
    odds: Tensor
    samples: SampleNoise
    noise: Noise
    missed: tuple[float, float]

    @classmethod
    def of(
        cls,
        problem: CommandProblem,
        features: OffsetFeatures,
        start: Tensor,
        others: OtherMachines | None,
        rate: float,
    ) -> Hyperparameters:
        """Those before anything is inferred: from first delays, or from what others have shown."""
        moved = (problem.distance * (1 - problem.missed) > 0).any(dim=-1) & problem.valid
        shown = moved if moved.any() else problem.valid
        delay = problem.per_segment(start)[..., 0][shown]
        deviation = 1.4826 * (delay - delay.median()).abs().median()
        jitter = deviation + FIRST_JITTER * problem.width
        measured = problem.measured > 0
        # The median of nothing is NaN.
        length = problem.residual(start).norm(dim=-1)[measured].median().nan_to_num(1.0)
        scale = length.clamp_min(FLOOR).expand(2, 1)
        design = features.design(problem)
        coefficients = torch.zeros(len(design.owner), dtype=torch.float64)
        coefficients[0] = delay.median()
        variance = torch.cat([jitter[None], features.unit, jitter[None]]).square()
        one = torch.ones(2, dtype=torch.float64)
        # Within its range a common delay may be anything, as by a uniform distribution.
        limits = problem.delay_range
        expected, missed = Hyperprior((sum(limits) / 2, problem.width**2 / 12)), MISSED
        if others is not None:
            expected = others.hyperprior(rate, replicated=len(features.replicated) > 0)
            missed = others.missed
            coefficients[: len(features.unit) + 1] = torch.as_tensor(expected.flat[0])
        return cls(
            features,
            Hierarchy.of(design, variance, coefficients, expected),
            _odds(problem, missed),
            SampleNoise.of(problem),
            Noise(scale, one),
            missed,
        )

    def explained(self, problem: CommandProblem, fit: CommandFit, weight: Tensor) -> bool:
        """Whether a regression predicts offsets under new conditions better than a constant."""
        likelihood = self.linearised(problem, fit).weighted(weight)
        problem = problem.with_missed(fit.missed)
        return regression_predicts_better(self.features, self.hierarchy, problem, likelihood)

    def linearised(self, problem: CommandProblem, fit: CommandFit) -> Likelihood:
        """The likelihood of x at the most probable one, if the segments of `fit` were missed."""
        problem = self.whitened(problem.with_missed(fit.missed))
        prior = self.prior(problem)
        solution = fitted(problem, prior, self.noise, fit.x).solution
        return Likelihood.of(solution, prior.gaussian)

    def with_regression(self, problem: CommandProblem, regression: bool) -> Hyperparameters:
        """The same to begin with, where offsets depend on direction, distance and pose, or not.

        Otherwise they have a constant mean.
        """
        if self.features.regression == regression:
            return self
        features = replace(self.features, regression=regression)
        adapted = self.hierarchy.adapted(features.design(problem))
        return replace(self, features=features, hierarchy=adapted)

    def whitened(self, problem: CommandProblem) -> CommandProblem:
        """The problem in which the errors of a sample's outputs are independent."""
        return replace(problem, whitening=self.samples.whitening())

    def prior(self, problem: CommandProblem) -> LatentPrior:
        """The distribution of (x, missed) before an output is measured."""
        gaussian = self.hierarchy.prior(self.features.design(problem))
        return LatentPrior(gaussian, self.odds.expand(problem.missed.shape))

    def learned(
        self, problem: CommandProblem, solution: Solution, weight: Tensor
    ) -> Hyperparameters:
        """The most probable hyperparameters, given what was inferred and how certain that is.

        Rows have the `weight` (n, 1) where variances are learned.
        """
        white, x, design = self.whitened(problem), solution.x, self.features.design(problem)
        samples = self.samples.learned(white, self.noise, x)
        white = replace(white, whitening=samples.whitening())
        likelihood = Likelihood.of(solution, self.hierarchy.prior(design)).weighted(weight)
        return replace(
            self,
            hierarchy=self.hierarchy.learned(design, likelihood),
            odds=_odds(problem, self.missed),
            samples=samples,
            noise=self._noise(white, solution),
        )

    def _noise(self, white: CommandProblem, solution: Solution) -> Noise:
        """The noise of residuals, of which z* has fitted a part: few samples seem too exact."""
        residual = white.residual(solution.x)
        learned = white.learned_noise(self.noise, residual, floor=FLOOR)
        design = self.features.design(white)
        likelihood = Likelihood.of(solution, self.hierarchy.prior(design))
        covariance = self.hierarchy.posterior_covariance(design, likelihood)
        fitted = (likelihood.curvature * covariance).sum()  # dimensions that outputs determine
        count = white.measured.sum() * white.observed.shape[2]
        # Smallest share of the samples that is taken to be left after z* has been fitted to them.
        left = (1 - fitted / count.clamp_min(1.0)).clamp(0.1, 1.0)
        rest, path = learned.thinning
        rest = rest.clamp_min(white.creep(learned, residual))
        thinning = torch.stack([rest, path])
        return replace(learned, scale=learned.scale / left.sqrt(), thinning=thinning)

    def near(self, other: Hyperparameters, *, tolerance: float = 0.02) -> bool:
        """Whether all standard deviations are about those of `other`.

        Parameters
        ----------
        tolerance : float, default 0.02
            Relative change of all standard deviations below which they have converged.

        """
        pairs = (
            (self.hierarchy.total().sqrt(), other.hierarchy.total().sqrt()),
            (self.noise.scale, other.noise.scale),
        )
        return all(bool(((a / b).log().abs() < tolerance).all()) for a, b in pairs)


def _discrepancy(
    problem: CommandProblem,
    at: Tensor,
    posterior: tuple[Tensor, Tensor],
    probability: Tensor,
    hyperparameters: Hyperparameters,
    identified_below: float,
) -> Discrepancy:
    """z*, each segment's covariance, and which components the outputs identify.

    The posterior, mean (n, P) and covariance (n, P, P) of x, is that of the problem linearised `at`
    x (n, P).
    """
    missed, segments = problem.missed, problem.missed.shape[1]
    hierarchy = hyperparameters.hierarchy
    prior = hyperparameters.prior(problem).gaussian
    common = _common(problem)
    found, covariance = posterior
    both = (problem.per_segment(each)[..., None] for each in (found, prior.mean))
    x, mean = ((common @ each)[..., 0] for each in both)
    parts = (blocks(each, segments) for each in (covariance, prior.covariance))
    inner, wide = (common @ each @ common.mT for each in parts)
    x[..., 0].clamp_(*problem.delay_range)
    left, wide = inner.diagonal(dim1=-2, dim2=-1), wide.diagonal(dim1=-2, dim2=-1)
    severity = torch.where(problem.faulty, (x - mean)[..., 1:], 0.0)
    # Under a fault nothing was learned of the discrepancy: the prior stands.
    learned = torch.cat([problem.valid[..., None], problem.healthy], dim=-1).double()
    known = (left < identified_below * wide) & (learned > 0)
    # The common delay is bounded, whatever those of the actuators are.
    delay = problem.per_segment(at)[..., 0]
    bounded = at_bound(delay, problem.delay_range) & problem.valid
    known[..., 0] &= ~bounded
    known[..., 1:] &= missed < 0.5
    own = torch.cat([wide[..., :1], hierarchy.total()[1:-1].expand_as(severity)], dim=-1)
    inner = inner * learned[..., None] * learned[..., None, :]
    inner = inner + torch.diag_embed(own * (1 - learned))
    covariance = block_diagonal(inner, torch.diag_embed(probability * (1 - probability)))
    # What was hardly to move shows neither that it did nor that it did not.
    seen = problem.inside.any(dim=-1)[..., None] & problem.healthy
    seen &= problem.way > MOVING * wide[..., 1:].sqrt()
    identified = torch.cat([known, seen], dim=-1) & problem.valid[..., None]
    z = torch.cat([torch.where(learned > 0, x, mean), missed], dim=-1) * problem.valid[..., None]
    noise = (hyperparameters.noise.scale[0, 0] * problem.unit.mean()).expand(len(x))
    return Discrepancy(z, covariance, identified, noise, severity, True, bounded)


def _odds(problem: CommandProblem, assumed: tuple[float, float]) -> Tensor:
    """Log odds () that an actuator misses a segment, given those that were missed."""
    missed = (problem.missed * problem.healthy).sum()
    return ((missed + assumed[0]) / (problem.healthy.sum() + assumed[1])).logit()


def _predict_runs(
    problem: CommandProblem, design: Design, draws: list[Hierarchy], assumed: tuple[float, float]
) -> Tensor | None:
    """Draws (J, M, 1 + 2 d_u) of z in further runs, under conditions that were not seen.

    None from enough runs.
    """
    # Runs, measured and predicted, from which a distribution is learned: as many trajectories as a
    # residual model is calibrated on. Of fewer, the hyperparameters' posterior predicts the rest.
    further = 20 - len(problem)
    if further <= 0:
        return None
    rng, runs = np.random.default_rng(2), []
    missed = float((problem.missed * problem.healthy).sum()) + assumed[0]
    moved = float(problem.healthy.sum()) + assumed[1] - missed
    common = _common(problem)
    features = torch.where(design.kind == CONDITION, 0.0, design.features)
    for j in range(further):
        row, drawn = j % len(problem), draws[j * len(draws) // further]
        mean = features[row] @ drawn.coefficients
        x = mean + drawn.total()[design.group].sqrt() * normal(mean, rng)
        z = (common[row] @ x.view(len(common[row]), -1, 1))[..., 0]
        z[..., 0].clamp_(*problem.delay_range)
        events = rng.random(problem.missed.shape[1:]) < rng.beta(missed, max(moved, assumed[0]))
        runs.append(torch.cat([z, torch.from_numpy(events).to(z)], dim=-1))
    return torch.stack(runs)


def _common(problem: CommandProblem) -> Tensor:
    """The matrices (n, M, 1 + d_u, P / M) from x to one delay and the offsets of each segment.

    The delay of a segment is the mean of its actuators' delays, weighted as least squares weights
    them: by the square of the distance, in standard deviations of the commands.
    """
    n, segments, width = problem.missed.shape
    weight = (problem.distance / problem.spread).square()
    weight = weight / weight.sum(dim=-1, keepdim=True).clamp_min(1e-12)
    matrix = torch.eye(1 + width, problem.size, dtype=weight.dtype).repeat(n, segments, 1, 1)
    matrix[:, :, 0, 1 + width :] = weight
    return matrix
