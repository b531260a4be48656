"""Conditional Gaussian mixtures (Eq. 6): context in, torch `Distribution` out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.distributions import (
    Categorical,
    Distribution,
    MixtureSameFamily,
    MultivariateNormal,
    constraints,
)

__all__ = ["BernoulliHead", "Bernoullis", "Blocks", "GaussianMixture", "MixtureHead"]

FLOOR = 0.05
"""Least standard deviation of a component, in standard units: no component shrinks onto a point."""
SURE = (1e-4, 1 - 1e-4)
"""Shares beyond which a normal score goes no further."""


class GaussianMixture(MixtureSameFamily):
    """A mixture of K multivariate normals with full covariance (Eq. 6).

    Parameters
    ----------
    logits: (..., K), unnormalised log weights π.
    mean: (..., K, D), μ.
    factor: (..., K, D, D), Cholesky factor of Σ.

    """

    def __init__(self, logits: Tensor, mean: Tensor, factor: Tensor) -> None:
        self.means = mean
        self.factor = factor
        super().__init__(
            Categorical(logits=logits, validate_args=False),
            MultivariateNormal(mean, scale_tril=factor, validate_args=False),
            validate_args=False,
        )

    def expand(
        self, batch_shape: Sequence[int], _instance: Distribution | None = None
    ) -> GaussianMixture:
        """The same mixture, repeated to a larger batch."""
        shape = torch.Size(batch_shape)
        return GaussianMixture(
            self.mixture_distribution.logits.expand(*shape, -1),
            self.means.expand(*shape, -1, -1),
            self.factor.expand(*shape, -1, -1, -1),
        )

    def from_noise(self, uniform: Tensor, normal: Tensor) -> Tensor:
        """The draw (..., D) that this noise stands for: uniform (...) in [0, 1), normal (..., D).

        Noise is an input, so that the same noise gives the same draw anywhere.
        """
        weights = self.mixture_distribution.probs
        steps = weights.cumsum(dim=-1)
        chosen = (uniform[..., None] >= steps).sum(dim=-1).clamp_max(weights.shape[-1] - 1)
        size = normal.shape[-1]
        mean = self.means.gather(-2, chosen[..., None, None].expand(*chosen.shape, 1, size))[
            ..., 0, :
        ]
        factor = self.factor.gather(
            -3, chosen[..., None, None, None].expand(*chosen.shape, 1, size, size)
        )[..., 0, :, :]
        return mean + (factor @ normal[..., None])[..., 0]

    def marginal_cdf(self, value: Tensor) -> Tensor:
        """P(z_d <= value_d) of each component of z on its own, (..., D): the PIT of a value."""
        deviation = self.factor.square().sum(dim=-1).sqrt()
        distance = (value[..., None, :] - self.means) / deviation
        return (self.mixture_distribution.probs[..., None] * torch.special.ndtr(distance)).sum(-2)

    def normal_scores(self, value: Tensor) -> Tensor:
        """The PIT of `value` (..., D) in standard deviations of a normal law."""
        return torch.special.ndtri(self.marginal_cdf(value).clamp(*SURE))


class Bernoullis(Distribution):
    """D independent events, each 0 or 1, beside the mixtures of `Blocks`.

    Parameters
    ----------
    logits: (..., D), log odds.

    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    support = constraints.boolean

    def __init__(self, logits: Tensor) -> None:
        self.logits = logits
        super().__init__(logits.shape[:-1], logits.shape[-1:], validate_args=False)

    @property
    def mean(self) -> Tensor:
        """The probabilities (..., D)."""
        return self.logits.sigmoid()

    @property
    def variance(self) -> Tensor:
        """Of each event, (..., D)."""
        return self.mean * (1 - self.mean)

    def expand(
        self, batch_shape: Sequence[int], _instance: Distribution | None = None
    ) -> Bernoullis:
        """The same events, repeated to a larger batch."""
        return Bernoullis(self.logits.expand(*batch_shape, -1))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log probability of all events together; a value between 0 and 1 counts for both."""
        odds = nn.functional.logsigmoid
        return (value * odds(self.logits) + (1 - value) * odds(-self.logits)).sum(dim=-1)

    def from_noise(self, uniform: Tensor, normal: Tensor) -> Tensor:
        """The draw (..., D) that this normal noise (..., D) stands for; `uniform` is not needed."""
        return (torch.special.ndtr(normal) > 1 - self.mean).to(self.logits.dtype)

    def normal_scores(self, value: Tensor) -> Tensor:
        """P(z_d <= value_d) of each event (..., D), in standard deviations of a normal law."""
        share = torch.where(value < 1, 1 - self.mean, torch.ones_like(value))
        return torch.special.ndtri(share.clamp(*SURE))


class Law(Protocol):
    """What `Blocks` needs of each block, beside what torch's `Distribution` has."""

    @property
    def batch_shape(self) -> torch.Size: ...

    @property
    def event_shape(self) -> torch.Size: ...

    @property
    def mean(self) -> Tensor: ...

    @property
    def variance(self) -> Tensor: ...

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> Law: ...

    def log_prob(self, value: Tensor) -> Tensor: ...

    def from_noise(self, uniform: Tensor, normal: Tensor) -> Tensor: ...

    def normal_scores(self, value: Tensor) -> Tensor: ...


class Blocks(Distribution):
    """Independent distributions side by side: the distribution of their joined values (..., D)."""

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    support = constraints.real_vector

    def __init__(self, blocks: Sequence[Law]) -> None:
        self.blocks = list(blocks)
        self.widths = [block.event_shape[0] for block in self.blocks]
        super().__init__(
            self.blocks[0].batch_shape, torch.Size([sum(self.widths)]), validate_args=False
        )

    @property
    def mean(self) -> Tensor:
        """The mixture mean z̄ (Eq. 8), (..., D)."""
        return torch.cat([block.mean for block in self.blocks], dim=-1)

    @property
    def variance(self) -> Tensor:
        """Variance of each component of z, (..., D)."""
        return torch.cat([block.variance for block in self.blocks], dim=-1)

    def block_log_prob(self, value: Tensor) -> Tensor:
        """Log density of each block at its part of `value`, (..., blocks)."""
        parts = value.split(self.widths, dim=-1)
        return torch.stack(
            [block.log_prob(part) for block, part in zip(self.blocks, parts, strict=True)], dim=-1
        )

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density at `value` (..., D)."""
        return self.block_log_prob(value).sum(dim=-1)

    def sample(
        self, sample_shape: Sequence[int] = (), *, generator: torch.Generator | None = None
    ) -> Tensor:
        """Draws (*sample_shape, ..., D) from `generator`, or from torch's global one."""
        shape = torch.Size(sample_shape) + self.batch_shape
        uniform = torch.rand(*shape, len(self.blocks), generator=generator)
        normal = torch.randn(*shape, self.event_shape[0], generator=generator)
        return self.from_noise(uniform, normal)

    def from_noise(self, uniform: Tensor, normal: Tensor) -> Tensor:
        """The draw (..., D) that this noise stands for: uniform (..., blocks), normal (..., D)."""
        shape = normal.shape[:-1]
        parts = zip(self.blocks, uniform.unbind(-1), normal.split(self.widths, -1), strict=True)
        return torch.cat([block.expand(shape).from_noise(u, e) for block, u, e in parts], dim=-1)

    def normal_scores(self, value: Tensor) -> Tensor:
        """The normal noise (..., D) that draws `value`, each block on its own."""
        parts = value.split(self.widths, dim=-1)
        return torch.cat(
            [block.normal_scores(part) for block, part in zip(self.blocks, parts, strict=True)], -1
        )


class MixtureHead(nn.Module):
    """Encoded context (..., H) in, `GaussianMixture` over `width` components of z out."""

    def __init__(self, features: int, width: int, components: int) -> None:
        super().__init__()
        self.width = width
        self.components = components
        self.lower = width * (width + 1) // 2
        self.linear = nn.Linear(features, components * (1 + width + self.lower))

    def forward(self, encoded: Tensor, shift: Tensor, scale: Tensor) -> GaussianMixture:
        """The mixture in physical units: standard units times `scale` plus `shift`, both (D,)."""
        raw = self.linear(encoded).unflatten(-1, (self.components, -1))
        logits, mean, lower = raw.split([1, self.width, self.lower], dim=-1)
        factor = raw.new_zeros(*raw.shape[:-1], self.width, self.width)
        row, column = torch.tril_indices(self.width, self.width)
        factor[..., row, column] = lower
        diagonal = nn.functional.softplus(factor.diagonal(dim1=-2, dim2=-1)) + FLOOR
        factor = factor.tril(-1) + torch.diag_embed(diagonal)
        return GaussianMixture(logits[..., 0], mean * scale + shift, scale[:, None] * factor)

    @torch.no_grad()
    def initialise(self, values: NDArray, seed: int) -> None:
        """Start at the clusters (k-means++) of standard z (n, D), the same for every context.

        A cluster of few points takes most of its spread from the whole: it is no law yet.
        """
        from sklearn.cluster import KMeans

        count = min(self.components, len(np.unique(values, axis=0)))
        found = KMeans(count, n_init=5, random_state=seed).fit(values)
        whole = values.var(axis=0)
        bias = torch.zeros(self.components, 1 + self.width + self.lower)
        diagonal = [i * (i + 1) // 2 + i for i in range(self.width)]
        for k in range(self.components):
            members = values[found.labels_ == k % count]
            spread = (len(members) * members.var(axis=0) + 2 * whole) / (len(members) + 2)
            deviation = torch.as_tensor(np.sqrt(spread).clip(2 * FLOOR) - FLOOR)
            bias[k, 0] = np.log(len(members) / len(values))
            bias[k, 1 : 1 + self.width] = torch.as_tensor(found.cluster_centers_[k % count])
            bias[k, 1 + self.width :][diagonal] = torch.log(torch.expm1(deviation)).float()
        self.linear.bias.copy_(bias.flatten())
        self.linear.weight.mul_(0.1)


class BernoulliHead(nn.Module):
    """Encoded context (..., H) in, `Bernoullis` of `width` events out."""

    def __init__(self, features: int, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(features, width)

    def forward(self, encoded: Tensor, shift: Tensor, scale: Tensor) -> Bernoullis:
        """The events; they have no unit to shift or scale."""
        return Bernoullis(self.linear(encoded))

    @torch.no_grad()
    def initialise(self, values: NDArray, seed: int) -> None:
        """Start at how often each event was seen (n, D), in any context; rare ones as if shared."""
        common = (values.sum() + 0.5) / (values.size + 1)
        share = (values.sum(axis=0) + 10 * common) / (len(values) + 10)
        self.linear.bias.copy_(torch.as_tensor(np.log(share / (1 - share))))
        self.linear.weight.mul_(0.1)
