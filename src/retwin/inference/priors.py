"""`GaussianPrior`: the distribution of latent variables before any output is measured."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["GaussianPrior"]


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """A Gaussian over the latent variables of every row.

    Attributes
    ----------
    mean : Tensor
        (R, P).
    precision : Tensor
        (R, P, P), the inverse covariance.
    log_determinant : Tensor
        (R,), of the precision.

    """

    mean: Tensor
    precision: Tensor
    log_determinant: Tensor

    @classmethod
    def of(cls, mean: Tensor, covariance: Tensor) -> GaussianPrior:
        """The Gaussian of mean (R, P) and covariance (R, P, P)."""
        return cls(mean, torch.linalg.inv(covariance), -torch.linalg.slogdet(covariance)[1])

    @classmethod
    def independent(cls, mean: Tensor, variance: Tensor) -> GaussianPrior:
        """The Gaussian of independent variables, mean and variance (R, P)."""
        return cls(mean, torch.diag_embed(variance.reciprocal()), -variance.log().sum(dim=1))

    def __getitem__(self, rows: Tensor) -> GaussianPrior:
        """The prior of some rows."""
        return GaussianPrior(self.mean[rows], self.precision[rows], self.log_determinant[rows])

    def gradient(self, x: Tensor) -> Tensor:
        """Gradient (R, P) of minus the log density at x (R, P)."""
        return torch.einsum("npq,nq->np", self.precision, x - self.mean)

    def energy(self, x: Tensor) -> Tensor:
        """Minus the log density (R,) at x (R, P), in nats, 0 at the mean."""
        return 0.5 * ((x - self.mean) * self.gradient(x)).sum(dim=1)
