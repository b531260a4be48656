"""Robust losses of a standardised residual: how much a sample costs, and how much it counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


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
