"""z* of `CommandSpace` from outputs alone: maximum a posteriori, evidence, empirical Bayes.

Outputs seldom tell all actuators apart; where they do not, a prior decides. Its widths, the noise
and the rate of missed movements are not set by hand but learned from all trajectories together
(type-II maximum likelihood, by expectation-maximisation with Laplace's approximation). Whether a
movement was missed is decided by comparing evidence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from retwin.errors import InputError
from retwin.update.corrections.command_delays import delay_variance
from retwin.update.corrections.command_problem import TAILS, Problem
from retwin.update.corrections.correction import Context, Discrepancy
from retwin.update.corrections.warp import gather_samples, read

if TYPE_CHECKING:
    from retwin.update.corrections.command_space import CommandSpace

__all__ = ["infer_commands"]

ROUNDS = 5
"""Of expectation and maximisation, with a search for missed movements in each."""
STEPS = 12
"""Of Gauss-Newton at most in each round."""
TURNS = 3
"""Missed movements per trajectory that one round may find."""
LOOKS = (6.0, 1.0)
"""Independent looks that a movement's readings at rest, and in motion, are worth at most."""
SUSPECT = 2.5
"""Standard deviations of the prior beyond which an offset makes a movement suspect."""
FREE = 30.0
"""Width of the prior, in widths of a healthy one, where a fault may be anything."""


def infer_commands(
    operator: CommandSpace, context: Context, observed: Tensor, mask: Tensor
) -> Discrepancy:
    """z* (n, M, 1 + 2 d_u) for measured outputs (n, T, d_y), see `CommandSpace.infer`."""
    _require_samples(mask)
    problem = Problem(operator, context, observed, mask)
    x, missed = problem.nothing()
    if not x.shape[1]:
        empty = torch.cat([x, missed], dim=-1)
        matrix = empty[..., None] * empty[..., None, :]
        noise = torch.zeros(len(x), dtype=torch.float64)
        return Discrepancy(empty, matrix, empty > 0, noise, severity=missed, posterior=True)
    x[..., 0] = problem.first_delays()
    prior = _Prior.first(problem, x)
    chance = missed
    for _ in range(ROUNDS):
        fit = _solve(problem, x, missed, prior, STEPS)
        fit, missed, chance = _find_missed(problem, fit, missed, prior)
        x = fit.x
        prior = prior.learned(problem, fit, missed)
    fit = _solve(problem, x, missed, prior, STEPS)
    return _told(problem, fit, missed, chance, prior)


def _require_samples(mask: Tensor) -> None:
    """InputError that names the trajectories of `mask` (n, T, d_y) without a usable sample.

    Where nothing at all was measured the prior stands for every trajectory, and nothing is
    identified: that is what `Correction` requires.
    """
    empty = ~mask.all(dim=-1).any(dim=1)
    if not mask.any() or not empty.any():
        return
    index = empty.nonzero()[:, 0].tolist()
    several = len(index) > 1
    raise InputError(
        "mask",
        expected="in every trajectory at least one sample at which all outputs are measured",
        got=f"none in {'trajectories' if several else 'trajectory'} {', '.join(map(str, index))}",
        remedy=f"leave {'them' if several else 'it'} out, or correct the mask",
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    """The most probable x, minus its log posterior, and the curvature there."""

    x: Tensor  # (n, M, 1 + d_u)
    energy: Tensor  # (n,)
    curvature: Tensor  # (n, P, P)

    def evidence(self) -> Tensor:
        """Laplace's log evidence (n,), up to what all patterns of missed movements share."""
        return -self.energy - 0.5 * torch.linalg.slogdet(self.curvature)[1]

    def covariance(self) -> Tensor:
        """(n, P, P)."""
        return torch.linalg.inv(self.curvature)

    def variance(self) -> Tensor:
        """(n, M, 1 + d_u)."""
        return self.covariance().diagonal(dim1=-2, dim2=-1).unflatten(1, self.x.shape[1:])

    def replaced(self, row: int, other: _Fit, at: int) -> _Fit:
        """The same with one trajectory from another fit."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return _Fit(*(_with(mine, row, theirs[at]) for mine, theirs in pairs))


@dataclass(frozen=True, eq=False)
class _Prior:
    """What is believed before an output is seen, learned from all trajectories together."""

    late: Tensor  # () mean delay in samples
    jitter: Tensor  # () standard deviation of a delay
    offset: Tensor  # (d_u,) standard deviation of an offset, in the commands' units
    odds: Tensor  # () log odds that an actuator misses a movement
    noise: Tensor  # (2,) scale of an output's error at rest and in motion, in `Problem.unit`
    thinning: Tensor  # (2,) samples per independent one, at rest and in motion

    @classmethod
    def first(cls, problem: Problem, x: Tensor) -> _Prior:
        """Wide, from nothing but delays."""
        late = x[..., 0][problem.valid]
        spread = 1.4826 * (late - late.median()).abs().median() + 1.0
        residual = problem.residual(x, torch.zeros_like(x[..., 1:]))
        seen = problem.seen > 0
        # Of nothing at all, the median and the spread are NaN.
        noise = residual.norm(dim=-1)[seen].median().nan_to_num(1.0).clamp_min(1e-6).repeat(2)
        told = gather_samples(problem.told, problem.at)[seen]
        extent = (told - told.mean(dim=0)).square().mean(dim=0).sqrt()
        width = 0.05 * extent.nan_to_num(1.0).clamp_min(1e-9)
        one = torch.ones((), dtype=torch.float64)
        return cls(late.median(), spread, width, -4.0 * one, noise, one.repeat(2))

    def centre(self, problem: Problem) -> Tensor:
        """The mean of x, (n, M, 1 + d_u)."""
        x, _ = problem.nothing()
        x[..., 0] = self.late
        return x

    def precision(self, problem: Problem) -> Tensor:
        """One over the variance of each component of x, (n, M, 1 + d_u)."""
        x, _ = problem.nothing()
        x[..., 0] = self.jitter.square().reciprocal()
        wide = torch.where(problem.faulty, FREE * self.offset, self.offset)
        x[..., 1:] = wide.square().reciprocal()
        return x

    def learned(self, problem: Problem, fit: _Fit, missed: Tensor) -> _Prior:
        """The most likely prior, given what was found and how sure that is."""
        variance = fit.variance()
        used = (problem.healthy & (missed < 0.5)).double()
        second = ((fit.x[..., 1:].square() + variance[..., 1:]) * used).sum(dim=(0, 1))
        # A few pseudo-observations: with few movements no width shrinks to nothing.
        offset = (second + 2 * self.offset.square()) / (used.sum(dim=(0, 1)) + 2)
        late, weight = fit.x[..., 0], problem.valid.double()
        mean = (late * weight).sum() / weight.sum()
        spread = (((late - mean).square() + variance[..., 0]) * weight).sum() / weight.sum()
        chance = ((missed * problem.healthy).sum() + 0.5) / (problem.healthy.sum() + 20.0)
        residual = problem.residual(fit.x, missed)
        weights = self.weights(problem, residual)
        square = weights * residual.square().sum(dim=-1)
        noise, thinning = [], []
        rest, motion = problem.seen * (1 - problem.moving), problem.seen * problem.moving
        for part, looks in zip((rest, motion), LOOKS, strict=True):
            total = part.sum().clamp_min(1)
            noise.append(((square * part).sum() / total / residual.shape[-1]).sqrt())
            kept = residual * (weights * part).sqrt()[..., None]
            power = (kept[:, 1:].square() * part[:, :-1, None]).sum().clamp_min(1e-30)
            alike = ((kept[:, 1:] * kept[:, :-1]).sum() / power).clamp(0, 0.95)
            # Readings of one part of a movement err together: by rounding, by friction.
            crowd = total / (looks * problem.valid.sum())
            thinning.append(((1 + alike) / (1 - alike)).maximum(crowd))
        return _Prior(
            late=mean,
            jitter=spread.sqrt().clamp_min(0.1),
            offset=offset.sqrt(),
            odds=chance.logit(),
            noise=torch.stack(noise).clamp_min(1e-6),
            thinning=torch.stack(thinning),
        )

    def scale(self, problem: Problem) -> tuple[Tensor, Tensor]:
        """Noise and thinning of every sample, (n, S) each."""
        part = problem.moving.long()
        return self.noise[part], self.thinning[part]

    def weights(self, problem: Problem, residual: Tensor) -> Tensor:
        """How much each sample (n, S) counts under Student's t: 1 or so, less for glitches."""
        square = residual.square().sum(dim=-1) / self.scale(problem)[0].square()
        return (TAILS + residual.shape[-1]) / (TAILS + square)

    def energy(self, problem: Problem, x: Tensor, residual: Tensor) -> Tensor:
        """Minus the log posterior (n,) of x, up to a constant."""
        noise, thinning = self.scale(problem)
        square = residual.square().sum(dim=-1) / noise.square()
        size = residual.shape[-1]
        misfit = 0.5 * (TAILS + size) * torch.log1p(square / TAILS) * problem.seen / thinning
        away = (x - self.centre(problem)).square() * self.precision(problem)
        return misfit.sum(dim=1) + 0.5 * away.sum(dim=(1, 2))


def _solve(problem: Problem, x: Tensor, missed: Tensor, prior: _Prior, steps: int) -> _Fit:
    """Gauss-Newton with Levenberg's damping and reweighting, until no trajectory gains."""
    x = x.clone()
    energy = prior.energy(problem, x, problem.residual(x, missed))
    damping = torch.full((len(x),), 1e-3, dtype=torch.float64)
    low, high = problem.operator.delay_range
    active = torch.arange(len(x))
    for _ in range(steps):
        part, told = problem[active], missed[active]
        normal, right = _normal(part, x[active], told, prior)
        raised = damping[active, None] * normal.diagonal(dim1=1, dim2=2)
        move = torch.linalg.solve(normal + torch.diag_embed(raised), right)
        trial = x[active] + move.unflatten(1, x.shape[1:])
        trial[..., 0] = trial[..., 0].clamp(low, high)
        there = prior.energy(part, trial, part.residual(trial, told))
        gain = energy[active] - there
        better = gain >= 0
        x[active] = torch.where(better[:, None, None], trial, x[active])
        energy[active] = torch.where(better, there, energy[active])
        factor = torch.where(better, 0.25, 8.0)
        damping[active] = (damping[active] * factor).clamp(1e-9, 1e6)
        active = active[~(better & (gain < 1e-2))]
        if not len(active):
            break
    return _Fit(x, energy, _normal(problem, x, missed, prior)[0])


def _normal(problem: Problem, x: Tensor, missed: Tensor, prior: _Prior) -> tuple[Tensor, Tensor]:
    """Curvature (n, P, P) of the log posterior, and its slope (n, P)."""
    noise, thinning = prior.scale(problem)
    residual, jacobian = problem.linearised(x, missed)
    weight = prior.weights(problem, residual) * problem.seen / noise.square() / thinning
    weighted = jacobian * weight[..., None, None]
    precision = prior.precision(problem)
    ridge = torch.diag_embed(precision.flatten(1))
    normal = torch.einsum("nsyp,nsyq->npq", weighted, jacobian) + ridge
    right = torch.einsum("nsyp,nsy->np", weighted, residual)
    return normal, right - ((x - prior.centre(problem)) * precision).flatten(1)


def _find_missed(
    problem: Problem, fit: _Fit, missed: Tensor, prior: _Prior
) -> tuple[_Fit, Tensor, Tensor]:
    """Flip what was missed where that has the greater evidence, one per trajectory and turn.

    Returns the fit, what was missed (n, M, d_u), and how probable each of it is.
    """
    chance = missed
    for _ in range(TURNS):
        rows, movement, actuator = _suspects(problem, fit, missed, prior)
        if not len(rows):
            break
        each = torch.arange(len(rows))
        pattern = missed[rows].clone()
        pattern[each, movement, actuator] = 1 - pattern[each, movement, actuator]
        now = pattern[each, movement, actuator]
        begin = fit.x[rows].clone()
        begin[each, movement, 1:] = 0.0
        tried = _solve(problem[rows], begin, pattern, prior, STEPS)
        gain = tried.evidence() - fit.evidence()[rows] + prior.odds * (2 * now - 1)
        chance = chance.clone()
        chance[rows, movement, actuator] = torch.sigmoid(gain * (2 * now - 1))
        flipped = False
        for row in rows.unique().tolist():
            mine = (rows == row).nonzero()[:, 0]
            best = int(mine[gain[mine].argmax()])
            if gain[best] > 0:
                flipped = True
                missed = _with(missed, row, pattern[best])
                fit = fit.replaced(row, tried, best)
        if not flipped:
            break
    return fit, missed, chance


def _suspects(
    problem: Problem, fit: _Fit, missed: Tensor, prior: _Prior
) -> tuple[Tensor, Tensor, Tensor]:
    """Trajectory, movement and actuator of every flip worth a try.

    A movement is suspect when an offset is far beyond its prior, or when much of what was seen of
    it passes for glitches; then every actuator that was to move is. What is missed may always
    turn out not to be.
    """
    far = (fit.x[..., 1:].abs() > SUSPECT * prior.offset) & problem.healthy
    residual = problem.residual(fit.x, missed)
    strange = (residual.norm(dim=-1) > 3 * prior.scale(problem)[0]) * problem.seen
    inside = problem.inside()
    share = (inside * strange[:, None]).sum(dim=-1) / inside.sum(dim=-1).clamp_min(1)
    first = read(problem.told, torch.as_tensor(problem.segments.start))
    last = read(problem.told, torch.as_tensor(problem.segments.settle))
    moving = (last - first).abs() > 3 * prior.offset
    suspect = (far.any(dim=-1) | (share > 0.3))[..., None] & moving & problem.healthy
    rows, movement, actuator = (suspect | (missed > 0.5)).nonzero().unbind(dim=1)
    return rows, movement, actuator


def _with(values: Tensor, row: int, value: Tensor) -> Tensor:
    changed = values.clone()
    changed[row] = value
    return changed


def _delay_variance(problem: Problem, fit: _Fit, missed: Tensor, prior: _Prior) -> Tensor:
    """(n, M), actuators that are unevenly late accounted for."""
    noise, thinning = prior.scale(problem)
    weights = prior.weights(problem, problem.residual(fit.x, missed)) * problem.seen
    precision = prior.precision(problem)
    return delay_variance(
        problem,
        fit.x,
        missed,
        precision=precision,
        pull=(fit.x - prior.centre(problem)) * precision,
        rest=weights * (1 - problem.moving) / noise.square() / thinning,
    )


def _told(
    problem: Problem, fit: _Fit, missed: Tensor, chance: Tensor, prior: _Prior
) -> Discrepancy:
    """z*, each movement's covariance, and which components the outputs tell."""
    n, most, size = fit.x.shape
    whole = fit.covariance().reshape(n, most, size, most, size)
    index = torch.arange(most)
    inner = whole[:, index, :, index].transpose(0, 1).clone()
    wide = prior.precision(problem).reciprocal()
    left = inner.diagonal(dim1=-2, dim2=-1) / wide
    severity = torch.where(problem.faulty, fit.x[..., 1:], 0.0)
    # Where a fault is in its place nothing was learned of the discrepancy: the prior stands.
    told = torch.cat([problem.valid[..., None], problem.healthy], dim=-1).double()
    own = torch.cat([wide[..., :1], prior.offset.square().expand_as(severity)], dim=-1)
    inner = inner * told[..., None] * told[..., None, :] + torch.diag_embed(own * (1 - told))
    # Offsets stay as they are, and as much correlated with the delay.
    stretch = torch.ones_like(wide)
    stretch[..., 0] = (_delay_variance(problem, fit, missed, prior) / inner[..., 0, 0]).sqrt()
    inner = inner * stretch[..., None] * stretch[..., None, :]
    width = size + missed.shape[-1]
    covariance = torch.zeros(n, most, width, width, dtype=torch.float64)
    covariance[..., :size, :size] = inner
    covariance[..., size:, size:] = torch.diag_embed(chance * (1 - chance))
    known = (left < problem.operator.known) & (told > 0)
    known[..., 1:] &= missed < 0.5
    watched = problem.inside().any(dim=-1)[..., None] & problem.healthy
    identified = torch.cat([known, watched], dim=-1) & problem.valid[..., None]
    z = torch.cat([fit.x * told, missed], dim=-1) * problem.valid[..., None]
    noise = (prior.noise[0] * problem.unit.mean()).expand(n)
    return Discrepancy(z, covariance, identified, noise, severity=severity, posterior=True)
