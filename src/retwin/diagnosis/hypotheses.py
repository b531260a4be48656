"""What each class of faults says of the commands, as beliefs about `CommandSpace`'s z.

Healthy: z is as the residual model has learned it. Biased: one actuator's offsets may be as large
as the fault says on top of that. Stuck: one actuator's effective command stands still from an onset
on. Rows are trajectories times classes, all solved together.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from retwin.diagnosis.evidence import Belief, Fit, Noise, best_pattern
from retwin.diagnosis.onsets import Onsets
from retwin.diagnosis.severity import draw_biases
from retwin.errors import InputError
from retwin.nets.mixtures import Bernoullis, GaussianMixture
from retwin.twins.faults import ActuatorBias, Fault, Stuck
from retwin.update.corrections import Chain, CommandSpace, Context, Correction, SampledSensor
from retwin.update.corrections.command_effect import effective
from retwin.update.corrections.command_problem import Problem
from retwin.update.residual import ResidualModel

__all__ = [
    "COVER",
    "Hypotheses",
    "Inversion",
    "checked",
    "command_space",
    "healthy_belief",
    "posed",
]

CAUTION = 2.0
"""Trajectories' worth of variance added to what the residual model has learned.

Chosen on the emulated arm: with it, 90 % intervals of biases cover, calibrated on 4 or on 8.
"""
DRAWS = 2000
"""Of a law whose covariance has no formula."""
COVER = 0.9
"""Of all intervals."""


def checked(faults: Mapping[str, Fault | None]) -> dict[str, Fault | None]:
    """The faults; InputError for fewer than two, or one that cannot be inverted."""
    if len(faults) < 2:
        raise InputError(
            "faults",
            expected="at least two classes, None for healthy",
            got=f"{list(faults)}",
            remedy="give the faults of a case",
        )
    for fault in faults.values():
        _told(fault, 1)
    return dict(faults)


def command_space(correction: Correction) -> CommandSpace:
    """The operator that acts on commands, alone or before a sensor.

    Raises InputError for a correction that does something else to outputs.
    """
    operator = correction
    if isinstance(correction, Chain) and isinstance(correction.second, SampledSensor):
        operator = correction.first
    if isinstance(operator, CommandSpace):
        return operator
    raise InputError(
        "residual",
        expected="a residual model of what actuators are effectively told",
        got=repr(correction),
        remedy="fit it with CommandSpace(), or with a Chain of it and a SampledSensor()",
    )


def posed(residual: ResidualModel, context: Context, observed: Tensor, mask: Tensor) -> Problem:
    """The problem of those trajectories, in the outputs' own units.

    What one trajectory tells must not depend on the spread of those beside it.
    """
    # Readings were chosen already, for each trajectory on its own.
    operator = replace(command_space(residual.correction), most=context.segments.steps)
    problem = Problem(operator, context, observed, mask)
    problem.observed = problem.observed * problem.unit
    problem.unit = torch.ones_like(problem.unit)
    return problem


@torch.no_grad()
def healthy_belief(residual: ResidualModel, context: Context) -> Belief:
    """The residual model's law of x = (delay, offsets) by its moments, and the odds to miss.

    Movements of a trajectory err alike as far as the residual model says that errors persist.
    """
    delay, offset, missed = residual(context).blocks
    mean = torch.cat([delay.mean, offset.mean], dim=-1).double()
    n, movements, size = mean.shape
    own = torch.zeros(n, movements, size, size, dtype=torch.float64)
    own[..., :1, :1] = _covariance(delay)
    own[..., 1:, 1:] = _covariance(offset)
    factor = torch.linalg.cholesky(own)
    common = factor * residual.persistence[:size].double().sqrt()
    whole = torch.einsum("nmip,nkjp->nmikj", common, common)
    valid = torch.as_tensor(context.segments.valid).double()
    whole = whole * valid[:, :, None, None, None] * valid[:, None, None, :, None]
    index = torch.arange(movements)
    whole[:, index, :, index] = own.transpose(0, 1)
    flat = whole.reshape(n, movements * size, movements * size)
    if residual.fitted is not None:
        # What few trajectories taught is less sure than it looks.
        flat = flat * (1 + CAUTION / max(1.0, residual.fitted.figures.get("trajectories", np.inf)))
    odds = cast(Bernoullis, missed).logits.double()
    return Belief.of(mean.flatten(1), flat, odds)


def _covariance(law: Any) -> Tensor:
    """Of a block of z (..., D, D), double precision; of a law without a formula, from draws."""
    if isinstance(law, GaussianMixture):
        weights = law.mixture_distribution.probs.double()[..., None, None]
        means, factor = law.means.double(), law.factor.double()
        away = (means - (weights[..., 0] * means).sum(dim=-2, keepdim=True))[..., None]
        return (weights * (factor @ factor.mT + away @ away.mT)).sum(dim=-3)
    shape, (size,) = law.batch_shape, law.event_shape
    generator = torch.Generator().manual_seed(0)
    # The same noise for every movement: what one is believed to do does not depend on the others.
    uniform, normal = (
        each.reshape(DRAWS, *[1] * len(shape), -1).expand(DRAWS, *shape, -1)
        for each in (
            torch.rand(DRAWS, generator=generator),
            torch.randn(DRAWS, size, generator=generator),
        )
    )
    drawn = law.expand((DRAWS, *shape)).from_noise(uniform[..., 0], normal).double()
    away = drawn - drawn.mean(dim=0)
    return torch.einsum("k...i,k...j->...ij", away, away) / (DRAWS - 1)


@dataclass(frozen=True, eq=False)
class Inversion:
    """What the outputs say of every row.

    Attributes
    ----------
    evidence: (R,), log marginal likelihood, up to a constant of each trajectory.
    level, doubt: (R,), where the faulty actuator stands in the end, and how unsure that is.
    onsets: of a stuck actuator.
    bias: (R, M, 3), mean and interval of the bias in every movement; NaN where there is none.
    fit: the most probable z.

    """

    evidence: Tensor
    level: Tensor
    doubt: Tensor
    onsets: Onsets
    bias: Tensor
    fit: Fit


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """All classes about n trajectories: row r is class r % C of trajectory r // C.

    Attributes
    ----------
    problem, belief: of the rows.
    classes: C.
    actuator: (R,), which is faulty; 0 where none is.
    size: (R, 2), least and greatest size of a bias; 0 where there is none.
    onsets: (R, 2), first and last onset of a stuck actuator; T where none is stuck.

    """

    problem: Problem
    belief: Belief
    classes: int
    actuator: Tensor
    size: Tensor
    onsets: Tensor

    @classmethod
    def of(
        cls,
        faults: Sequence[Fault | None],
        residual: ResidualModel,
        context: Context,
        observed: Tensor,
        mask: Tensor,
    ) -> Hypotheses:
        """Every fault about every trajectory; `mask` is True at true readings only."""
        n, steps, _ = context.commands.shape
        rows = torch.arange(n).repeat_interleave(len(faults))
        told = [_told(fault, steps) for fault in faults]
        actuator, size, onsets = (
            torch.tensor(column).repeat(n, *[1] * np.ndim(column[0]))
            for column in zip(*told, strict=True)
        )
        problem = posed(residual, context[rows.numpy()], observed[rows], mask[rows])
        belief = healthy_belief(residual, context)[rows]
        made = cls(problem, belief, len(faults), actuator, size.double(), onsets)
        made = replace(made, belief=made._loosened())
        return made.held(onsets[:, 0])

    @property
    def group(self) -> Tensor:
        """The trajectory of each row (R,)."""
        return torch.arange(len(self.actuator)) // self.classes

    @property
    def stuck(self) -> Tensor:
        """Whether the row's actuator stands still (R,) bool."""
        return self.onsets[:, 0] < self.problem.told.shape[1]

    @property
    def width(self) -> Tensor:
        """Standard deviation of a bias (R,); 0 where there is none."""
        low, high = self.size.unbind(dim=1)
        return ((low.square() + low * high + high.square()) / 3).sqrt()

    def held(self, onset: Tensor) -> Hypotheses:
        """The same with stuck actuators held from `onset` (R,) on."""
        problem = copy.copy(self.problem)
        steps, width = problem.told.shape[1:]
        mine = torch.nn.functional.one_hot(self.actuator, width).bool()
        problem.frozen = torch.where(mine, onset[:, None], steps).double()
        start = torch.as_tensor(problem.segments.start)[..., None]
        problem.healthy = problem.valid[..., None] & (start < problem.frozen[:, None])
        return replace(self, problem=problem)

    def inverted(self, noise: Noise) -> Inversion:
        """Everything that the outputs say of every row."""
        onsets = Onsets.of(self, noise)
        made = self.held(onsets.best)
        fit, evidence = best_pattern(made.problem, made.start(), made.belief, noise, made.group)
        bias, limited = made._biases(fit)
        level, doubt = made._level(fit, onsets.best)
        doubt = (doubt.square() + made._glance(fit, noise)).sqrt()
        return Inversion(evidence + onsets.gain + limited, level, doubt, onsets, bias, fit)

    def __getitem__(self, rows: Tensor) -> Hypotheses:
        """Some of the rows."""
        parts = (self.actuator[rows], self.size[rows], self.onsets[rows])
        return Hypotheses(self.problem[rows], self.belief[rows], self.classes, *parts)

    def start(self) -> Tensor:
        """The x (R, M, 1 + d_u) that is believed beforehand."""
        return self.belief.mean.unflatten(1, (self.problem.valid.shape[1], -1))

    def _loosened(self) -> Belief:
        """The belief, wider where a bias may add to an offset."""
        extra = torch.zeros_like(self.belief.mean)
        place = self._place()
        extra.scatter_(1, place, self.width.square()[:, None].expand(place.shape))
        return Belief.of(
            self.belief.mean, self.belief.covariance + torch.diag_embed(extra), self.belief.odds
        )

    def _place(self) -> Tensor:
        """Where in x the faulty actuator's offset of every movement is, (R, M)."""
        movements, width = self.problem.valid.shape[1], self.problem.told.shape[2]
        return (1 + width) * torch.arange(movements) + 1 + self.actuator[:, None]

    def _biases(self, fit: Fit) -> tuple[Tensor, Tensor]:
        """`Inversion.bias`, and the log evidence (R,) that the limits of its size add."""
        place = self._place()
        told = torch.full((*place.shape, 3), torch.nan, dtype=torch.float64)
        gain = torch.zeros(len(place), dtype=torch.float64)
        loose = (self.width > 0).nonzero()[:, 0]
        if not len(loose):
            return told, gain
        square = self.width[loose].square()[:, None, None]
        pick = torch.nn.functional.one_hot(place[loose], self.belief.mean.shape[1]).double()
        # What an actuator's whole error says of the bias in it.
        share = square * pick @ self.belief.precision[loose]
        away = fit.x.flatten(1)[loose] - self.belief.mean[loose]
        rest = square * (torch.eye(place.shape[1], dtype=torch.float64) - share @ pick.mT)
        drawn = draw_biases(
            (share @ away[..., None])[..., 0],
            share @ fit.covariance[loose] @ share.mT + rest,
            width=self.width[loose],
            size=self.size[loose],
        )
        told[loose], gain[loose] = drawn.summary(COVER), drawn.gain
        return told, gain

    def _level(self, fit: Fit, onset: Tensor) -> tuple[Tensor, Tensor]:
        """Where the faulty actuator ends, and the standard deviation of that."""
        problem = self.problem
        x = fit.x.clone().requires_grad_()
        last = onset.clamp_max(problem.told.shape[1] - 1)[:, None]
        with torch.enable_grad():
            z = torch.cat([x, fit.missed], dim=-1)
            reached = effective(problem.told, problem.segments, z, last)
            level = reached[:, 0].gather(1, self.actuator[:, None])[:, 0]
            slope = torch.autograd.grad(level.sum(), x, allow_unused=True)[0]
        flat = torch.zeros_like(x) if slope is None else slope
        doubt = torch.einsum("np,npq,nq->n", flat.flatten(1), fit.covariance, flat.flatten(1))
        return level.detach(), doubt.clamp_min(0).sqrt()

    def _glance(self, fit: Fit, noise: Noise) -> Tensor:
        """Variance (R,) of the level in one look: all looks at what stands still err alike."""
        problem = self.problem
        told = problem.commands(fit.x, fit.missed)
        step = torch.nn.functional.one_hot(self.actuator, told.shape[2])[:, None]
        turn = problem.predicted(told + step) - problem.predicted(told)
        square = (turn.double() / noise.scale[0]).square().sum(dim=-1) * problem.seen
        return problem.seen.sum(dim=1) / square.sum(dim=1).clamp_min(1e-12)


def _told(fault: Fault | None, steps: int) -> tuple[int, tuple[float, float], tuple[int, int]]:
    """Actuator, limits of the size of a bias, and of the onset of standing still."""
    match fault:
        case None:
            return 0, (0.0, 0.0), (steps, steps)
        case Stuck(actuator=actuator, onset=onset):
            low, high = (onset, onset) if isinstance(onset, int) else onset
            return actuator, (0.0, 0.0), (min(low, steps - 1), min(high, steps - 1))
        case ActuatorBias(actuator=actuator, size=size, bias=()):
            return actuator, size, (steps, steps)
    raise InputError(
        "faults",
        expected="None, Stuck, or ActuatorBias with its bias open",
        got=repr(fault),
        remedy="leave out what cannot be inverted, or train a diagnoser",
    )
