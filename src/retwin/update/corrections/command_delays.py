"""Posterior variance of the delays of `CommandSpace`: actuators have unequal delays.

z has one delay per segment, common to its actuators. Each has a delay of its own besides, by a dead
zone or by play, which is common to all samples of a segment. Here every actuator has a delay of its
own beside z. The variance of these, and that of the noise in motion, are learned from all
trajectories together (type-II maximum likelihood, by expectation-maximisation). z* stays as it is;
the variance of its delays accounts for them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from retwin.inference.em import expectation_maximisation
from retwin.inference.noise import Noise, predicted_variance
from retwin.inference.priors import GaussianPrior
from retwin.update.corrections.command_problem import CommandProblem

__all__ = ["delay_variance"]

ROUNDS = 20
"""Rounds of expectation-maximisation."""
FIRST = 1 / 35
"""Standard deviation of an actuator's own delay to begin with, in widths of the range of delays."""


def delay_variance(
    problem: CommandProblem, prior: GaussianPrior, noise: Noise, x: Tensor
) -> Tensor:
    """Variance (n, M) of the delays in the most probable x (n, P), in samples squared."""
    model = _OwnDelays.of(problem, prior, noise, x)
    count = len(model.identified[0])
    first = x.new_zeros(len(x), count), x.new_zeros(len(x), count, count)
    square = (model.residual.square() * model.motion[..., None]).sum()
    scale = (square / model.motion.sum().clamp_min(1) / model.residual.shape[-1]).clamp_min(1e-12)
    widths = _Widths(
        scale, x.new_tensor((FIRST * problem.width) ** 2), torch.ones_like(model.motion)
    )
    (_, covariance), _ = expectation_maximisation(
        first, widths, infer=model.posterior, learn=model.learned, rounds=ROUNDS
    )
    variance = covariance.diagonal(dim1=1, dim2=2)[:, : x.shape[1]]
    return problem.per_segment(variance)[..., 0]


@dataclass(frozen=True, eq=False)
class _Widths:
    """Hyperparameters, and the robust weights that go with them."""

    noise: Tensor  # () variance of the residual in motion
    own: Tensor  # () variance of an actuator's own delay
    weights: Tensor  # (n, S)


@dataclass(frozen=True, eq=False)
class _OwnDelays:
    """The linearised problem in (x, own delays): P + M d_u variables."""

    residual: Tensor  # (n, S, d_y)
    jacobian: Tensor  # (n, S, d_y, P + M d_u)
    precision: Tensor  # (n, P, P), of the prior of x
    gradient: Tensor  # (n, P), of minus its log density
    rest: Tensor  # (n, S), inverse variance of a sample at rest, 0 in motion
    motion: Tensor  # (n, S), 1 for measured samples in motion
    identified: Tensor  # (n, M d_u), whether the actuator moves
    noise: Noise

    @classmethod
    def of(
        cls, problem: CommandProblem, prior: GaussianPrior, noise: Noise, x: Tensor
    ) -> _OwnDelays:
        residual, jacobian = problem.linearised(x)
        own = problem.actuator_delay_jacobian(x)
        precision = noise.precision(problem, residual)[..., 0]
        return cls(
            residual,
            torch.cat([jacobian, own], dim=-1),
            prior.precision,
            prior.gradient(x),
            rest=torch.where(problem.group == 0, precision, 0.0),
            motion=problem.measured * problem.group,
            identified=(own != 0).any(dim=1).any(dim=1),
            noise=noise,
        )

    def posterior(self, before: object, widths: _Widths) -> tuple[Tensor, Tensor]:
        """Mean and covariance of (move of x, own delays)."""
        weight = self.rest + self.motion * widths.weights / widths.noise
        weight = weight[..., None].expand_as(self.residual).flatten(1)
        flat = self.jacobian.flatten(1, 2)
        weighted = flat * weight[..., None]
        own = torch.diag_embed((1 / widths.own).expand(self.identified.shape))
        normal = weighted.mT @ flat
        size = self.gradient.shape[1]
        normal[:, :size, :size] += self.precision
        normal[:, size:, size:] += own
        right = (weighted.mT @ self.residual.flatten(1)[..., None])[..., 0]
        right[:, :size] -= self.gradient
        covariance = torch.linalg.inv(normal)
        return (covariance @ right[..., None])[..., 0], covariance

    def learned(self, found: tuple[Tensor, Tensor], widths: _Widths) -> _Widths:
        """The most probable hyperparameters, given the posterior."""
        mean, covariance = found
        size = self.residual.shape[-1]
        left = self.residual - torch.einsum("nsyp,np->nsy", self.jacobian, mean)
        # The variance of the predicted outputs adds to what stays unexplained.
        variance = predicted_variance(self.jacobian, covariance)
        square = (left.square() + variance).sum(dim=-1)
        weights = self.noise.loss.weight(square / widths.noise, size)
        total = self.motion.sum().clamp_min(1) * size
        noise = ((weights * square * self.motion).sum() / total).clamp_min(1e-12)
        # Two pseudo-observations, as for every width: with few segments none shrinks to nothing.
        second = mean.square() + covariance.diagonal(dim1=1, dim2=2)
        own = (second[:, self.gradient.shape[1] :] * self.identified).sum()
        own = (own + 2 * widths.own) / (self.identified.sum() + 2)
        return _Widths(noise, own, weights)
