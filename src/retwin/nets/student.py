"""Distributions whose width was estimated from few values: Student's t in place of the normal."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from scipy import stats
from torch import Tensor
from torch.distributions import Distribution

from retwin.nets.mixtures import PIT_RANGE, Block

FACTORS = 64
"""Values of the factor, equally probable. 50 to 95 % intervals of a normal block are those of
Student's t within 0.5 %, 99 % intervals within 6 %, from one degree of freedom on. The largest
factor, the quantile at 127/128, bounds what draws are: 102 for one degree, 3.9 for four."""


class Student(Block):
    """A block whose deviations have an unknown common factor.

    A variance that is estimated with ν degrees of freedom is, relative to the true one, distributed
    as χ²_ν / ν. Given the estimate, the deviations therefore have the factor √(ν / χ²_ν), and a
    normal block becomes Student's t (Gelman et al., Bayesian Data Analysis, 3rd ed., section 3.2).

    Parameters
    ----------
    block : Block
        The distribution with the estimated width.
    degrees : float
        ν, above 0; infinite if the width is known.

    """

    def __init__(self, block: Block, degrees: float) -> None:
        self.block = block
        self.degrees = degrees
        super().__init__(block.batch_shape, block.event_shape, validate_args=False)

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> Student:
        """The same distribution for a larger batch."""
        return Student(self.block.expand(torch.Size(batch_shape)), self.degrees)

    @property
    def mean(self) -> Tensor:
        """The mean (..., D) of the block, as if that of a flow did not depend on its width."""
        return self.block.mean

    @property
    def variance(self) -> Tensor:
        """The variance (..., D), finite since the largest factor is; of a flow approximately."""
        return self.block.variance * _factors(self.degrees).square().mean().to(self.mean)

    @property
    def normal(self) -> Block:
        """The block, widened to 90 % intervals as wide, for what cannot use heavy tails."""
        size = self.event_shape[0]
        return self.block.widened(self.mean.new_full((size,), widening(self.degrees)))

    def widened(self, factor: Tensor) -> Student:
        """The same with all deviations multiplied by `factor` (D,)."""
        return Student(self.block.widened(factor), self.degrees)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density (...) at `value` (..., D)."""
        return self._every(value).log_prob(value).logsumexp(dim=0) - np.log(FACTORS)

    def normal_scores(self, value: Tensor) -> Tensor:
        """The quantiles (..., D) of the standard normal at the PIT of `value` (..., D)."""
        level = torch.special.ndtr(self._every(value).normal_scores(value)).mean(dim=0)
        return torch.special.ndtri(level.clamp(*PIT_RANGE))

    def from_noise(self, uniform: Tensor, normal: Tensor) -> Tensor:
        """A draw (..., D) as a function of uniform (...) and normal (..., D) noise.

        Of `uniform` the first digits select the factor, the others are those of the block.
        """
        place = FACTORS * uniform
        index = place.floor().clamp_max(FACTORS - 1)
        factor = _factors(self.degrees).to(normal)[index.long()]
        return self.block.widened(factor[..., None]).from_noise(place - index, normal)

    def _every(self, value: Tensor) -> Block:
        """The blocks of all factors, (FACTORS, ...)."""
        factors = _factors(self.degrees).to(value)
        shape = torch.broadcast_shapes(self.batch_shape, value.shape[:-1])
        block = self.block.expand((FACTORS, *shape))
        return block.widened(factors.view(-1, *[1] * len(shape), 1))


def shared_factor(shared: Tensor, own: Tensor) -> Tensor:
    """Uniform noise that selects the factor by `shared` (n, 1, B) and the rest by `own` (n, M, B).

    The variance is one unknown number, so that the segments of a trajectory have the same factor.
    Trajectories have factors of their own: a set with one factor in common would be a single draw
    from what is known about the variance, too narrow or too wide as a whole.
    """
    return ((FACTORS * shared).floor() + own) / FACTORS


@cache
def widening(degrees: float) -> float:
    """Ratio of the ends of the 90 % intervals of Student's t and of the normal distribution."""
    level = 0.95
    return float(stats.t.ppf(level, degrees) / stats.norm.ppf(level))


@cache
def _factors(degrees: float) -> Tensor:
    """(FACTORS,) quantiles of √(ν / χ²_ν) at equally probable levels, ascending."""
    levels = (np.arange(FACTORS) + 0.5) / FACTORS
    finite = not np.isinf(degrees)
    factors = np.sqrt(degrees / stats.chi2.isf(levels, degrees)) if finite else np.ones(FACTORS)
    return torch.from_numpy(factors).float()
