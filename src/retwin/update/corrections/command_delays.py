"""How well `CommandSpace` knows delays: the actuators of one movement are not equally late.

z has one delay per movement, what its actuators have in common. Each follows in its own time
besides, by a dead zone or by play, and that errs alike in all readings of a movement. Here every
actuator has a delay of its own beside z. How widely these scatter, and what noise is left in
motion, is learned from all trajectories together (type-II maximum likelihood, by
expectation-maximisation). z* stays as it is; its delays are as wide as all this leaves them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from retwin.update.corrections.command_problem import TAILS, Problem

__all__ = ["delay_variance"]

ROUNDS = 20
"""Of expectation and maximisation."""
WIDE = 1.0
"""Standard deviation of an actuator's own delay to begin with, in samples."""


def delay_variance(
    problem: Problem, x: Tensor, missed: Tensor, *, precision: Tensor, pull: Tensor, rest: Tensor
) -> Tensor:
    """Variance (n, M) of the delays in x.

    Parameters
    ----------
    x, missed: the most probable ones, see `Problem`.
    precision, pull: curvature and slope of minus the log prior there, (n, M, 1 + d_u).
    rest: (n, S), one over the variance that each sample at rest stands for, 0 in motion.

    """
    motion = problem.moving * problem.seen
    residual, jacobian = problem.linearised(x, missed)
    apart = problem.apart(x, missed)
    turns = torch.cat([jacobian, apart], dim=-1)
    heard = (apart != 0).any(dim=1).any(dim=1)  # (n, M d_u), actuators that move
    known = jacobian.shape[-1]
    size, count = residual.shape[-1], motion.sum().clamp_min(1)
    own = torch.tensor(WIDE, dtype=x.dtype).square()
    share = torch.ones_like(motion)
    noise = (residual.square().sum(dim=-1) * motion).sum() / count / size
    noise = noise.clamp_min(1e-12)
    for _ in range(ROUNDS):
        weight = rest + motion * share / noise
        weighted = turns * weight[..., None, None]
        prior = torch.cat([precision.flatten(1), (1 / own).expand(heard.shape)], dim=1)
        normal = torch.einsum("nsyp,nsyq->npq", weighted, turns) + torch.diag_embed(prior)
        right = torch.einsum("nsyp,nsy->np", weighted, residual)
        right[:, :known] -= pull.flatten(1)
        covariance = torch.linalg.inv(normal)
        mean = (covariance @ right[..., None])[..., 0]
        left = residual - torch.einsum("nsyp,np->nsy", turns, mean)
        # What stays unexplained, and what may still be explained in another way.
        unsure = torch.einsum("nsyp,npq,nsyq->ns", turns, covariance, turns)
        square = left.square().sum(dim=-1) + unsure
        share = (TAILS + size) / (TAILS + square / noise)
        noise = ((share * square * motion).sum() / count / size).clamp_min(1e-12)
        # Two pseudo-observations, as for every width: with few movements none shrinks to nothing.
        second = mean.square() + covariance.diagonal(dim1=1, dim2=2)
        own = ((second[:, known:] * heard).sum() + 2 * own) / (heard.sum() + 2)
    variance = covariance.diagonal(dim1=1, dim2=2)[:, :known]
    return variance.unflatten(1, x.shape[1:])[..., 0]
