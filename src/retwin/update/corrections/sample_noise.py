"""Covariance of a sample's error: of the outputs, and of the actuators' positions.

Where outputs are computed from the positions that an actuator's sensor reports, its noise and its
rounding act through the same gain as a change of the command: outputs err most where actuators have
a long lever. Both variances are learned from the residual at rest, within segments.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from retwin.inference.noise import Noise
from retwin.update.corrections.command_problem import CommandProblem

__all__ = ["SampleNoise"]

TOLERANCE = 1e-2
"""Relative change of the likelihood's variances below which they have converged."""
MAX_STEPS = 100
"""Steps of expectation-maximisation at most."""
HYPERPRIOR_SEGMENTS = 2.0
"""Segments that the hyperprior of an actuator's variance counts as much as."""
SMALLEST = 1e-6
"""Smallest share of a variance in the total: it keeps covariances from being singular."""


@dataclass(frozen=True, eq=False)
class SampleNoise:
    """Σ = σ² I + G diag(ρ²) Gᵀ of a sample at which the outputs have the gain G.

    Attributes
    ----------
    gain : Tensor
        (n, S, d_y, d_u), change of the outputs, in `CommandProblem.unit`, per change of a command.
    output : Tensor
        (), σ² in `CommandProblem.unit` squared.
    actuator : Tensor
        (d_u,), ρ² in the commands' units squared.

    """

    gain: Tensor
    output: Tensor
    actuator: Tensor

    @classmethod
    def of(cls, problem: CommandProblem) -> SampleNoise:
        """Of the outputs alone, which every residual explains."""
        gain = problem.gain()
        return cls(gain, gain.new_ones(()), gain.new_zeros(gain.shape[-1]))

    def whitening(self) -> Tensor:
        """Factors (n, S, d_y, d_y) W with Wᵀ W = Σ⁻¹, up to a common factor of all samples.

        The common factor keeps the mean square of what they whiten.
        """
        covariance = self._covariance(self.gain)
        size = covariance.shape[-1]
        mean = covariance.diagonal(dim1=-2, dim2=-1).mean()
        factor = torch.linalg.cholesky(covariance / mean)
        identity = torch.eye(size, dtype=factor.dtype).expand_as(factor)
        return torch.linalg.solve_triangular(factor, identity, upper=False)

    def learned(self, problem: CommandProblem, noise: Noise, x: Tensor) -> SampleNoise:
        """The most probable variances, by expectation-maximisation.

        Samples at rest count, with the weight that robust noise gives them. Without any, the
        variances stay as they are.
        """
        rest = (problem.measured > 0) & (problem.group == 0)
        if not rest.any():
            return self
        weights = noise.weights(problem, problem.residual(x))[rest]
        residual, gain = problem.unwhitened.residual(x)[rest], self.gain[rest]
        power = (weights[:, None] * residual.square()).mean().clamp_min(1e-30)
        lever = gain.square().sum(dim=1).mean(dim=0)
        floor = SMALLEST * power / lever.clamp_min(1e-30)
        output, actuator = self.output, self.actuator
        if not actuator.any():
            output, actuator = power / 2, power / 2 / lever.sum().clamp_min(1e-30) + 0 * lever
        # An actuator without any effect has no noise that could be seen.
        seen = lever > SMALLEST * lever.amax()
        # Few segments may show no change of a rounded position at all: the variances of actuators
        # are expected to be the same share of what their commands vary.
        spread = problem.spread.square()
        believed = HYPERPRIOR_SEGMENTS / max(1.0, float(problem.valid.sum()))
        for _ in range(MAX_STEPS):
            precision = torch.linalg.inv(
                output * torch.eye(residual.shape[1], dtype=gain.dtype)
                + (gain * actuator) @ gain.mT
            )
            score = (precision @ residual[..., None])[..., 0]
            slope = (gain.mT @ score[..., None])[..., 0]
            curvature = ((precision @ gain) * gain).sum(dim=1)
            step = weights[:, None] * slope.square() - curvature
            new = actuator + actuator.square() * step.mean(dim=0)
            expected = (actuator / spread)[seen].mean() * spread
            new = ((new + believed * expected) / (1 + believed)).maximum(floor)
            step = weights * score.square().sum(dim=-1) - precision.diagonal(dim1=1, dim2=2).sum(-1)
            level = (output + output.square() * step.mean() / residual.shape[1]).maximum(
                SMALLEST * power
            )
            change = torch.cat([(new / actuator)[seen], (level / output)[None]]).log().abs()
            output, actuator = level, torch.where(seen, new, 0.0)
            if change.amax() < TOLERANCE:
                break
        return SampleNoise(self.gain, output, actuator)

    def _covariance(self, gain: Tensor) -> Tensor:
        identity = torch.eye(gain.shape[-2], dtype=gain.dtype)
        return self.output * identity + (gain * self.actuator) @ gain.mT
