"""`Problem`: the model whose latent variables are inferred, as the engine sees it; their prior."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Protocol, Self

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Rows:
    """A dataclass whose fields, tensors and other `Rows`, have a row for each of R problems."""

    shared: ClassVar[tuple[str, ...]] = ()
    """Fields that all rows share."""

    def __getitem__(self, rows: Any) -> Self:
        """Those of some rows."""
        own = {each.name: getattr(self, each.name) for each in fields(self)}
        kept = {k: v for k, v in own.items() if k not in self.shared and v is not None}
        return replace(self, **{name: value[rows] for name, value in kept.items()})

    def put(self, rows: Tensor, other: Self) -> Self:
        """The same with those of another one in some rows."""
        made = {}
        for name in (each.name for each in fields(self)):
            own, new = getattr(self, name), getattr(other, name)
            inside = isinstance(own, Rows)
            made[name] = own.put(rows, new) if inside else own.index_copy(0, rows, new)
        return replace(self, **made)


@dataclass(frozen=True, eq=False)
class CommonError(Rows):
    """A normal error of known variance that a block of samples has in common.

    Attributes
    ----------
    variance : Tensor
        (R, K, d), in the residual's unit squared.
    block : Tensor
        (R, K), the number of samples of the block that a sample belongs to.

    """

    variance: Tensor
    block: Tensor


class Problem(Protocol):
    """R independent rows of K samples of d outputs, each explained by P latent variables x.

    Attributes
    ----------
    group : Tensor
        (R, K) long, the group of samples with a common noise scale that each sample belongs to.
    measured : Tensor
        (R, K), the share of a sample's outputs that was measured; 0 for a sample without any.
    common : CommonError, optional
        A known error besides the noise.

    """

    @property
    def group(self) -> Tensor:
        """(R, K) long."""

    @property
    def measured(self) -> Tensor:
        """(R, K)."""

    @property
    def common(self) -> CommonError | None:
        """None without such an error."""

    def __getitem__(self, rows: Tensor) -> Problem:
        """The problem of some rows, by their indices."""

    def residual(self, x: Tensor) -> Tensor:
        """Measured minus predicted outputs (R, K, d) for x (R, P)."""

    def linearised(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The residual, and the Jacobian (R, K, d, P) of the predicted outputs."""


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
