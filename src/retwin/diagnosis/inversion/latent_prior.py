"""The prior of `CommandSpace`'s z in a healthy trajectory, from a fitted residual model."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor

from retwin.errors import InputError
from retwin.inference.problem import GaussianPrior
from retwin.nets.mixtures import Bernoullis, GaussianMixture
from retwin.nets.student import Student
from retwin.update.corrections import CommandSpace, Context, Correction, before_sensor
from retwin.update.corrections.commands.missed_segments import LatentPrior
from retwin.update.corrections.commands.problem import CommandProblem
from retwin.update.corrections.delay_range import range_in_samples
from retwin.update.residual import ResidualModel


def command_space(correction: Correction) -> CommandSpace:
    """The operator that acts on commands, alone or before a sensor.

    Raises
    ------
    InputError
        The correction does something else to outputs.

    """
    operator = before_sensor(correction)
    if isinstance(operator, CommandSpace):
        return operator
    expected = "a residual model of the actuators' effective commands"
    remedy = "fit it with CommandSpace(), or with a Chain of it and a SampledSensor()"
    raise InputError("residual", expected=expected, got=repr(correction), remedy=remedy)


def command_problem(
    residual: ResidualModel, context: Context, observed: Tensor, mask: Tensor
) -> CommandProblem:
    """The problem of those trajectories, in the outputs' own units.

    So no trajectory's diagnosis depends on the spread of the others' outputs.
    """
    operator = command_space(residual.correction)
    return CommandProblem.of(
        context,
        observed,
        mask,
        delay_range=range_in_samples(operator.delay_range, context, observed, mask),
        max_samples=operator.max_samples,
        unit=torch.ones(observed.shape[2], dtype=torch.float64),
    )


@torch.no_grad()
def healthy_prior(residual: ResidualModel, context: Context) -> LatentPrior:
    """The prior of a healthy trajectory: a normal distribution near the residual model's.

    It has the moments of the latter, or where that is Student's t, 90 % intervals as wide.

    Errors of a trajectory's segments are correlated as far as the residual model has learned
    that they persist.
    """
    delay, offset, missed = residual(context).blocks
    mean = torch.cat([delay.mean, offset.mean], dim=-1).double()
    n, segments, size = mean.shape
    own = torch.zeros(n, segments, size, size, dtype=torch.float64)
    own[..., :1, :1] = _covariance(delay)
    own[..., 1:, 1:] = _covariance(offset)
    factor = torch.linalg.cholesky(own)
    common = factor * residual.persistence[:size].double().sqrt()
    whole = torch.einsum("nmip,nkjp->nmikj", common, common)
    valid = torch.as_tensor(context.segments.valid).double()
    whole = whole * valid[:, :, None, None, None] * valid[:, None, None, :, None]
    index = torch.arange(segments)
    whole[:, index, :, index] = own.transpose(0, 1)
    flat = whole.reshape(n, segments * size, segments * size)
    gaussian = GaussianPrior.of(mean.flatten(1), flat)
    return LatentPrior(gaussian, cast(Bernoullis, missed).logits.double())


def _covariance(distribution: Any, *, draws: int = 2000) -> Tensor:
    """Covariance (..., D, D) of a block of z, double precision; without a formula, from draws.

    Parameters
    ----------
    draws : int, default 2000
        Draws from a distribution whose covariance has no closed form.

    """
    if isinstance(distribution, Student):
        return _covariance(distribution.normal)
    if isinstance(distribution, GaussianMixture):
        weights = distribution.mixture_distribution.probs.double()[..., None, None]
        means, factor = distribution.means.double(), distribution.factor.double()
        away = (means - (weights[..., 0] * means).sum(dim=-2, keepdim=True))[..., None]
        return (weights * (factor @ factor.mT + away @ away.mT)).sum(dim=-3)
    shape, (size,) = distribution.batch_shape, distribution.event_shape
    generator = torch.Generator().manual_seed(0)
    # The same noise for every segment: the prior of one does not depend on the others.
    noise = torch.rand(draws, generator=generator), torch.randn(draws, size, generator=generator)
    rows = (each.reshape(draws, *[1] * len(shape), -1) for each in noise)
    uniform, normal = (each.expand(draws, *shape, -1) for each in rows)
    drawn = distribution.expand((draws, *shape)).from_noise(uniform[..., 0], normal).double()
    away = drawn - drawn.mean(dim=0)
    return torch.einsum("k...i,k...j->...ij", away, away) / (draws - 1)
