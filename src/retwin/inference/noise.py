"""Robust noise: a scale and an effective sample size for each group of samples.

The scale of a group is learned by expectation-maximisation with the weights of the loss (Lange,
Little and Taylor, J. Am. Stat. Assoc. 84, 881, 1989). Successive samples have correlated errors, so
that fewer count than were measured: a first-order autoregression of coefficient ρ has (1 + ρ) /
(1 - ρ) samples per independent one.

A loss says how much a sample with a standardised residual costs, and how much it counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from retwin.inference.problem import Problem


class Loss(Protocol):
    """A loss ρ of the squared length q of a standardised residual with `size` components."""

    def value(self, square: Tensor, size: int) -> Tensor:
        """The loss ρ(q) in nats, 0 at q = 0."""

    def weight(self, square: Tensor, size: int) -> Tensor:
        """The weight 2 ρ'(q) of the sample in reweighted least squares."""


@dataclass(frozen=True)
class StudentT:
    """Minus the log density of a multivariate Student t distribution, up to a constant.

    Parameters
    ----------
    freedom : float
        Degrees of freedom, above 0. With the default outliers hardly count, and Gaussian errors
        lose little.

    References
    ----------
    Lange, Little and Taylor, J. Am. Stat. Assoc. 84, 881 (1989).

    """

    freedom: float = 4.0

    def value(self, square: Tensor, size: int) -> Tensor:
        """The loss in nats."""
        return 0.5 * (self.freedom + size) * torch.log1p(square / self.freedom)

    def weight(self, square: Tensor, size: int) -> Tensor:
        """The weight: about 1, less for outliers."""
        return (self.freedom + size) / (self.freedom + square)

    def expected(self, size: int) -> float:
        """The mean loss of residuals that have this distribution, in nats."""
        half = torch.tensor(0.5 * (self.freedom + size), dtype=torch.float64)
        tail = torch.tensor(0.5 * self.freedom, dtype=torch.float64)
        return float(half * (torch.digamma(half) - torch.digamma(tail)))


@dataclass(frozen=True)
class Tukey:
    """Tukey's biweight: samples beyond `cutoff` standard deviations do not count at all.

    Parameters
    ----------
    cutoff : float
        In standard deviations, above 0. The default has 95 % efficiency under Gaussian noise.

    References
    ----------
    Beaton and Tukey, Technometrics 16, 147 (1974).

    """

    cutoff: float = 4.685

    def value(self, square: Tensor, size: int) -> Tensor:
        """The loss in nats."""
        inside = (square / self.cutoff**2).clamp_max(1)
        return self.cutoff**2 / 6 * (1 - (1 - inside) ** 3)

    def weight(self, square: Tensor, size: int) -> Tensor:
        """The weight, from 1 to 0."""
        return (1 - (square / self.cutoff**2).clamp_max(1)).square()


HEAVY_TAILED = StudentT()
"""The loss of noise by default: glitches hardly count."""
LEVELS = 201
"""Levels of noise at which the common error of rounded values is computed, and terms of its sum."""


@dataclass(frozen=True, eq=False)
class Noise:
    """Errors of the outputs that the latent variables leave unexplained.

    Attributes
    ----------
    scale : Tensor
        (G, d), the scale of each output's error in every group of samples, in the residual's unit;
        (G, 1) if the outputs share one.
    thinning : Tensor
        (G,), samples per independent sample, at least 1.
    loss : Loss
        Student's t by default.

    """

    scale: Tensor
    thinning: Tensor
    loss: Loss = HEAVY_TAILED

    def square(self, problem: Problem, residual: Tensor) -> Tensor:
        """Squared length (R, K) of the residual (R, K, d) in scales."""
        return (residual.square() / self._variance(problem)).sum(dim=-1)

    def _variance(self, problem: Problem) -> Tensor:
        """Variance (R, K, d) of each sample, (R, K, 1) if all outputs have the same."""
        own = self.scale[problem.group].square()
        common = problem.common
        return own if common is None else own + common.variance

    def count(self, problem: Problem) -> Tensor:
        """Independent samples (R, K) that each sample is worth; 0 where nothing was measured.

        All samples of a block are together not more certain than the error that they have in
        common.
        """
        thinning = self.thinning[problem.group]
        common = problem.common
        if common is None:
            return problem.measured / thinning
        ratio = (common.variance / self.scale[problem.group].square()).mean(dim=-1)
        return problem.measured * (1 + ratio) / (thinning + common.block * ratio)

    def weights(self, problem: Problem, residual: Tensor) -> Tensor:
        """Robust weight (R, K) of each sample: about 1, less for outliers."""
        return self.loss.weight(self.square(problem, residual), residual.shape[-1])

    def misfit(self, problem: Problem, residual: Tensor) -> Tensor:
        """Minus the log likelihood (R, K) of each sample, 0 for a residual of 0."""
        loss = self.loss.value(self.square(problem, residual), residual.shape[-1])
        return loss * self.count(problem)

    def precision(self, problem: Problem, residual: Tensor) -> Tensor:
        """Weight (R, K, d) of each output in reweighted least squares."""
        weight = self.weights(problem, residual) * self.count(problem)
        return (weight[..., None] / self._variance(problem)).expand_as(residual)

    @classmethod
    def from_median(cls, problem: Problem, residual: Tensor, *, groups: int) -> Noise:
        """A first guess: the median absolute residual of each output, the same in all groups."""
        errors = residual[problem.measured > 0].abs()
        scale = residual.new_ones(residual.shape[-1])
        if len(errors):
            scale = 1.4826 * errors.median(dim=0).values
        return cls(scale.clamp_min(1e-12).repeat(groups, 1), residual.new_ones(groups))

    def learned(
        self,
        problem: Problem,
        residual: Tensor,
        *,
        common: float,
        blocks: float,
        rounding: tuple[float, ...] = (),
        variance: Tensor | float = 0.0,
        floor: float = 1e-18,
        max_correlation: float = 0.95,
        smallest_share: float = 1e-6,
    ) -> Noise:
        """The noise that makes residuals most probable: one step of maximisation.

        A group without any measured sample keeps its scale.

        Parameters
        ----------
        problem : Problem
            Of all rows that share the noise.
        residual : Tensor
            (R, K, d), at the most probable latent variables.
        common : float
            Variance of the error that is common to a block of successive samples, relative to that
            of a sample: it does not average out, however many samples a block has.
        blocks : float
            The number of blocks in all rows together, at least 1.
        rounding : tuple of float
            Variance of the error by rounding in each group, where values do not change in a block:
            the part of it that noise does not average out is common to the block too.
        variance : Tensor | float
            (R, K, d), the posterior variance of the predicted outputs.
        floor : float
            Smallest scale, in the residual's unit.
        max_correlation : float, default 0.95
            Largest lag-one autocorrelation that is learned: beyond it the estimate is too
            uncertain.
        smallest_share : float, default 1e-6
            Smallest scale relative to the largest one: it keeps exact outputs from infinite weight.

        """
        weights = self.weights(problem, residual)[..., None]
        square = weights * (residual.square() + variance)
        if (error := problem.common) is not None:
            # The expected square of the part of the residual that is not the common error.
            part = self.scale[problem.group].square() / self._variance(problem)
            square = part.square() * square + part * error.variance
        scale, thinning = [], []
        for k in range(len(self.scale)):
            part = (problem.measured * (problem.group == k))[..., None]
            seen, count = (part[..., 0] > 0).to(part), part.sum()
            if not count:
                scale.append(self.scale[k])
                thinning.append(self.thinning[k])
                continue
            variances = (square * part).sum(dim=(0, 1)) / count
            lattice = rounding[k] if rounding else 0.0
            shared = common_rounding(variances.mean(), lattice)
            variances = variances.clamp_min(lattice)
            scale.append((variances if len(self.scale[k]) > 1 else variances.mean(0, True)).sqrt())
            kept = residual / self.scale[k] * (weights * part).sqrt()
            time = correlation_time(kept, seen, rows=False, limit=max_correlation)
            # Exact outputs have a scale of 0.
            share = (shared / scale[-1].square().mean().clamp_min(1e-300)).clamp_min(common)
            thinning.append(time + share * seen.sum() / blocks)
        scales = torch.stack(scale)
        smallest = max(floor, smallest_share * float(scales.amax()))
        return Noise(scales.clamp_min(smallest), torch.stack(thinning), self.loss)


def common_rounding(within: Tensor, rounding: float) -> Tensor:
    """Variance of the rounding error of a constant value that its noise does not average out.

    A constant value with Gaussian noise of deviation s is rounded to multiples of d. The mean of
    many samples has an error of variance d²/(2 π²) Σ exp(-4 π² k² s²/d²)/k², over all constants
    (Widrow and Kollár, Quantization Noise, 2008, chapter 9): d²/12, the whole one, without noise,
    and next to none from s = d/2 on. Samples differ from their mean by the rest of s² + d²/12.

    Parameters
    ----------
    within : Tensor
        (...,), variances of the samples about their mean, from which s is found.
    rounding : float
        Variance d²/12 of the error of a sample; 0 for no lattice.

    """
    if rounding <= 0:
        return torch.zeros_like(within)
    step = (12 * rounding) ** 0.5
    noise = np.linspace(0.0, step, LEVELS)
    terms = np.arange(1, LEVELS)
    waves = np.exp(-((2 * np.pi * terms * noise[:, None] / step) ** 2)) / terms**2
    common = step**2 / (2 * np.pi**2) * waves.sum(axis=1)
    left = noise**2 + rounding - common
    return within.new_tensor(np.interp(within.numpy(), left, common))


def correlation_time(values: Tensor, counted: Tensor, *, rows: bool, limit: float) -> Tensor:
    """Samples per independent sample of a first-order autoregression.

    Parameters
    ----------
    values : Tensor
        (R, K, d), weighted residuals; 0 where a sample does not count.
    counted : Tensor
        (R, K), above 0 where a sample counts.
    rows : bool
        True for one number (R,) for each row, False for a single one () of all rows together.
    limit : float
        Largest autocorrelation, below 1.

    """
    dims = (1, 2) if rows else (0, 1, 2)
    power = (values[:, 1:].square() * counted[:, :-1, None]).sum(dim=dims).clamp_min(1e-30)
    correlation = ((values[:, 1:] * values[:, :-1]).sum(dim=dims) / power).clamp(0, limit)
    return (1 + correlation) / (1 - correlation)


def predicted_variance(jacobian: Tensor, covariance: Tensor) -> Tensor:
    """Variance (R, K, d) of outputs with a Jacobian (R, K, d, P) by x of covariance (R, P, P)."""
    flat = jacobian.flatten(1, 2)
    return ((flat @ covariance) * flat).sum(dim=-1).view(jacobian.shape[:3])
