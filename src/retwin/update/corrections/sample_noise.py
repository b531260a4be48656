"""Covariance of a sample's error: of the outputs, and of the actuators' positions.

Where outputs are computed from the positions that an actuator's sensor reports, its noise and its
rounding act through the same gain as a change of the command: outputs err most where actuators have
a long lever. Both variances are learned from the residual at rest, within segments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from retwin.inference.noise import Noise
from retwin.update.corrections.commands.problem import CommandProblem

SMALLEST = 1e-6
"""Smallest share of the residual's power that a variance explains: it keeps covariances from being
singular."""


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
        covariance = _covariance(self.output, self.actuator, self.gain)
        size = covariance.shape[-1]
        mean = covariance.diagonal(dim1=-2, dim2=-1).mean()
        factor = torch.linalg.cholesky(covariance / mean)
        identity = torch.eye(size, dtype=factor.dtype).expand_as(factor)
        return torch.linalg.solve_triangular(factor, identity, upper=False)

    def learned(self, problem: CommandProblem, noise: Noise, x: Tensor) -> SampleNoise:
        """The most probable variances of Gaussian errors.

        Samples at rest count, with the weight that robust noise gives them. Without any, the
        variances stay as they are.
        """
        rest = (problem.measured > 0) & (problem.group == 0)
        if not rest.any():
            return self
        weights = noise.weights(problem, problem.residual(x))[rest]
        residual, gain = replace(problem, whitening=None).residual(x)[rest], self.gain[rest]
        power = (weights[:, None] * residual.square()).mean().clamp_min(1e-30)
        lever = gain.square().sum(dim=1).mean(dim=0)
        # An actuator without any effect has no noise that could be seen.
        seen = lever > SMALLEST * lever.amax()
        gain, spread = gain[..., seen], problem.spread.square()[seen]
        # By parts of the residual's power, which each of them could explain alone.
        alone = torch.cat([power[None], power / lever[seen]])
        before = torch.cat([self.output[None], self.actuator[seen]])
        if not self.actuator.any():
            before = alone / len(alone)
        # Few segments may show no change of a rounded position at all: the variances of actuators
        # are expected to be about the same share of what their commands vary.
        usual = (alone[1:] / spread).log()
        # Segments that the hyperprior of an actuator's variance counts as much as.
        believed = 2.0 / max(1.0, float(problem.valid.sum()))

        def objective(logarithm: NDArray) -> tuple[float, NDArray]:
            variance = alone * torch.as_tensor(logarithm).exp()
            covariance = _covariance(variance[0], variance[1:], gain)
            precision = torch.linalg.inv(covariance)
            score = (precision @ residual[..., None])[..., 0]
            slope = (gain.mT @ score[..., None])[..., 0]
            curvature = ((precision @ gain) * gain).sum(dim=1)
            value = torch.logdet(covariance) + weights * (residual * score).sum(dim=-1)
            trace = precision.diagonal(dim1=1, dim2=2).sum(dim=-1)
            by_output = (trace - weights * score.square().sum(dim=-1)).mean()
            by_actuator = (curvature - weights[:, None] * slope.square()).mean(dim=0)
            share = torch.as_tensor(logarithm)[1:] + usual
            away = share - share.mean()
            gradient = torch.cat([by_output[None], by_actuator]) * variance
            gradient[1:] += 2 * believed * away
            return float(value.mean() + believed * away.square().sum()), gradient.numpy()

        start = (before / alone).clamp(SMALLEST, 1 / SMALLEST).log().numpy()
        bounds = [(math.log(SMALLEST), -math.log(SMALLEST))] * len(start)
        found = minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds)
        variance = alone * torch.as_tensor(found.x).exp()
        actuator = torch.zeros_like(self.actuator)
        actuator[seen] = variance[1:]
        return SampleNoise(self.gain, variance[0], actuator)


def _covariance(output: Tensor, actuator: Tensor, gain: Tensor) -> Tensor:
    """Covariance (..., d_y, d_y) of samples with a gain (..., d_y, d_u)."""
    return output * torch.eye(gain.shape[-2], dtype=gain.dtype) + (gain * actuator) @ gain.mT
