"""`GaussianPrior`: the distribution of latent variables before any output is measured."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from retwin.inference.problem import Rows

ROUNDING = 1e-12
"""Added to the unit diagonal of a precision: what outputs without noise leave open may be lost in
the rounding of what they determine."""


@dataclass(frozen=True, eq=False)
class GaussianPrior(Rows):
    """A Gaussian over the latent variables of every row.

    Attributes
    ----------
    mean : Tensor
        (R, P).
    covariance : Tensor
        (R, P, P).
    precision : Tensor
        (R, P, P), the inverse covariance.
    log_determinant : Tensor
        (R,), of the precision.

    """

    mean: Tensor
    covariance: Tensor
    precision: Tensor
    log_determinant: Tensor

    @classmethod
    def of(cls, mean: Tensor, covariance: Tensor) -> GaussianPrior:
        """The Gaussian of mean (R, P) and covariance (R, P, P)."""
        precision = torch.linalg.inv(covariance)
        return cls(mean, covariance, precision, -torch.linalg.slogdet(covariance)[1])

    @classmethod
    def independent(cls, mean: Tensor, variance: Tensor) -> GaussianPrior:
        """The Gaussian of independent variables, mean and variance (R, P)."""
        covariance, precision = torch.diag_embed(variance), torch.diag_embed(variance.reciprocal())
        return cls(mean, covariance, precision, -variance.log().sum(dim=1))

    def widened(self, variance: Tensor) -> GaussianPrior:
        """The same with more variance (R, P)."""
        return GaussianPrior.of(self.mean, self.covariance + torch.diag_embed(variance))

    @property
    def deviation(self) -> Tensor:
        """Standard deviations (R, P)."""
        return self.covariance.diagonal(dim1=1, dim2=2).sqrt()

    def gradient(self, x: Tensor) -> Tensor:
        """Gradient (R, P) of minus the log density at x (R, P)."""
        return torch.einsum("npq,nq->np", self.precision, x - self.mean)

    def energy(self, x: Tensor) -> Tensor:
        """Minus the log density (R,) at x (R, P), in nats, 0 at the mean."""
        return 0.5 * ((x - self.mean) * self.gradient(x)).sum(dim=1)


def inverse(precision: Tensor) -> Tensor:
    """Covariance (R, P, P) of a precision, scaled to a unit diagonal: units differ by orders."""
    unit = precision.diagonal(dim1=1, dim2=2).rsqrt()
    scale = unit[:, :, None] * unit[:, None, :]
    identity = torch.eye(precision.shape[1], dtype=precision.dtype)
    found = torch.linalg.inv(precision * scale + ROUNDING * identity) * scale
    return (found + found.mT) / 2
