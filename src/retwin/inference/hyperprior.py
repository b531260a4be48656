"""What is expected of the hyperparameters of a `Hierarchy` before anything is measured."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp

import torch
from scipy.optimize import brentq
from scipy.special import polygamma
from torch import Tensor

LIMITS = -12.0, 24.0
"""Logarithms of the smallest and largest half of a number of degrees of freedom."""


@dataclass(frozen=True, eq=False)
class Variances:
    """Scaled inverse chi-squared distributions of variances.

    Attributes
    ----------
    expected : Tensor
        (G,), the scales.
    count : Tensor
        (G,), degrees of freedom: as many observations it counts as.

    """

    expected: Tensor
    count: Tensor

    @classmethod
    def of_logarithm(cls, mean: Tensor, variance: Tensor) -> Variances:
        """Those whose logarithms have this mean and variance (G,)."""
        halves = [_inverse_trigamma(each) for each in variance.tolist()]
        half = torch.tensor(halves, dtype=mean.dtype)
        return cls((mean + half.digamma()).exp() / half, 2 * half)


@dataclass(frozen=True, eq=False)
class Hyperprior:
    """The distribution of coefficients that are not shrunk, and of variances.

    Attributes
    ----------
    flat : tuple of Tensor or float
        (J,) means and variances of the coefficients of kind 0, in their order; one number of either
        for all of them. A variance is infinite where nothing is known.
    error, effect : Variances, optional
        Of the errors of each group, and of the effects that conditions have on it; by default they
        follow from the units.

    """

    flat: tuple[Tensor | float, Tensor | float] = (0.0, torch.inf)
    error: Variances | None = None
    effect: Variances | None = None


def _inverse_trigamma(value: float) -> float:
    """Where the trigamma function has this value, above 0."""
    return exp(brentq(lambda log: polygamma(1, exp(log)) - value, *LIMITS))
