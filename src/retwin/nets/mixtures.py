"""Conditional Gaussian mixtures (Eq. 6) and events, as torch distributions, and their heads."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.distributions import (
    Categorical,
    Distribution,
    Independent,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
    constraints,
)

FLOOR = 0.05
"""Smallest standard deviation of a component, in standard units. It keeps a component from
collapsing onto a single example, where its likelihood has no bound."""
STARTED_FROM = 2000
"""Examples, drawn at random from more, to which the initial mixture of a network is fitted."""
PIT_RANGE = (1e-4, 1 - 1e-4)
"""Range to which a PIT is clipped before it becomes a normal score, which is then finite, within
3.7 standard deviations."""


class Block(Distribution):
    """A distribution that `Blocks` can join: one of torch's with three methods more."""

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    support: Any = constraints.real_vector

    @abstractmethod
    def from_noise(self, uniform: Tensor, normal: Tensor) -> Tensor:
        """Draws by uniform (*batch) and normal (*batch, width) noise."""

    @abstractmethod
    def normal_scores(self, value: Tensor) -> Tensor:
        """Standard Gaussian scores of values (*batch, width) within their distribution."""

    @abstractmethod
    def widened(self, factor: Tensor) -> Block:
        """The distributions with deviations from the mean times `factor` (width,)."""


class GaussianMixture(MixtureSameFamily, Block):
    """A mixture of K multivariate normals with full covariance (Eq. 6).

    Parameters
    ----------
    logits : Tensor
        (..., K), unnormalised logarithms of the weights π.
    mean : Tensor
        (..., K, D), the means μ of the components.
    factor : Tensor
        (..., K, D, D), the Cholesky factors of the covariances Σ.

    """

    def __init__(self, logits: Tensor, mean: Tensor, factor: Tensor) -> None:
        self.means = mean
        self.factor = factor
        components: Distribution
        if mean.shape[-1] == 1:  # much faster than to invert matrices of one element
            alone = Normal(mean, factor[..., 0], validate_args=False)
            components = Independent(alone, 1, validate_args=False)
        else:
            components = MultivariateNormal(mean, scale_tril=factor, validate_args=False)
        weights = Categorical(logits=logits, validate_args=False)
        super().__init__(weights, components, validate_args=False)

    @property
    def parts(self) -> tuple[Tensor, Tensor, Tensor]:
        """The logits, means and factors of which it is made."""
        return self.mixture_distribution.logits, self.means, self.factor

    def expand(
        self, batch_shape: Sequence[int], _instance: Distribution | None = None
    ) -> GaussianMixture:
        """The same mixture for a larger batch."""
        shape = torch.Size(batch_shape)
        if shape == self.batch_shape:
            return self
        size = len(self.batch_shape)
        return GaussianMixture(*(each.expand(*shape, *each.shape[size:]) for each in self.parts))

    def from_noise(self, uniform: Tensor, normal: Tensor) -> Tensor:
        """A draw (..., D) as a function of noise, which gives the same draw on every device.

        Parameters
        ----------
        uniform : Tensor
            (...), in [0, 1), selects the component.
        normal : Tensor
            (..., D), standard normal, selects the value within the component.

        """
        weights = self.mixture_distribution.probs
        cumulative = weights.cumsum(dim=-1)
        chosen = (uniform[..., None] >= cumulative).sum(dim=-1).clamp_max(weights.shape[-1] - 1)
        # `take_along_dim` would fix the number of samples in a graph that is exported.
        size, place = normal.shape[-1], chosen[..., None, None]
        mean = self.means.gather(-2, place.expand(*chosen.shape, 1, size))[..., 0, :]
        place = place[..., None].expand(*chosen.shape, 1, size, size)
        factor = self.factor.gather(-3, place)[..., 0, :, :]
        return mean + (factor @ normal[..., None])[..., 0]

    def widened(self, factor: Tensor) -> GaussianMixture:
        """The same with all deviations from the mean multiplied by `factor` (..., D)."""
        middle, factor = self.mean[..., None, :], factor[..., None, :]
        means = middle + factor * (self.means - middle)
        return GaussianMixture(self.parts[0], means, factor[..., None] * self.factor)

    def marginal_cdf(self, value: Tensor) -> Tensor:
        """The marginal probabilities P(z_d <= value_d), (..., D): the PIT of `value`."""
        deviation = self.factor.square().sum(dim=-1).sqrt()
        distance = (value[..., None, :] - self.means) / deviation
        return (self.mixture_distribution.probs[..., None] * torch.special.ndtr(distance)).sum(-2)

    def normal_scores(self, value: Tensor) -> Tensor:
        """The quantiles (..., D) of the standard normal at the PIT of `value` (..., D)."""
        return torch.special.ndtri(self.marginal_cdf(value).clamp(*PIT_RANGE))


class Bernoullis(Block):
    """The distribution of D independent events, each 0 or 1.

    Parameters
    ----------
    logits : Tensor
        (..., D), the logarithms of the odds.

    """

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
        """The variance of each event, (..., D)."""
        return self.mean * (1 - self.mean)

    def expand(
        self, batch_shape: Sequence[int], _instance: Distribution | None = None
    ) -> Bernoullis:
        """The same events for a larger batch."""
        return Bernoullis(self.logits.expand(*batch_shape, -1))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log probability (...) of `value` (..., D); within 0 to 1, minus its cross entropy."""
        log_probability = nn.functional.logsigmoid
        one, zero = log_probability(self.logits), log_probability(-self.logits)
        return (value * one + (1 - value) * zero).sum(dim=-1)

    def from_noise(self, uniform: Tensor, normal: Tensor) -> Tensor:
        """A draw (..., D) as a function of normal noise (..., D); `uniform` is not used."""
        return (torch.special.ndtr(normal) > 1 - self.mean).to(self.logits.dtype)

    def normal_scores(self, value: Tensor) -> Tensor:
        """The quantiles (..., D) of the standard normal at P(z_d <= value_d)."""
        probability = torch.where(value < 1, 1 - self.mean, torch.ones_like(value))
        return torch.special.ndtri(probability.clamp(*PIT_RANGE))

    def widened(self, factor: Tensor) -> Bernoullis:
        """The same events: they have no width."""
        return self


class Blocks(Block):
    """The joint distribution of independent blocks of z, (..., D).

    Parameters
    ----------
    blocks : sequence of Block
        One distribution for each block of components, with the same batch shape.

    """

    def __init__(self, blocks: Sequence[Block]) -> None:
        self.blocks = list(blocks)
        self.widths = [block.event_shape[0] for block in self.blocks]
        width = torch.Size([sum(self.widths)])
        super().__init__(self.blocks[0].batch_shape, width, validate_args=False)

    @property
    def mean(self) -> Tensor:
        """The mean z̄ (Eq. 8), (..., D)."""
        return torch.cat([block.mean for block in self.blocks], dim=-1)

    @property
    def variance(self) -> Tensor:
        """The variance of each component of z, (..., D)."""
        return torch.cat([block.variance for block in self.blocks], dim=-1)

    def block_log_prob(self, value: Tensor) -> Tensor:
        """Log density of each block at its part of `value` (..., D), (..., blocks)."""
        return torch.stack([block.log_prob(part) for block, part in self._split(value)], dim=-1)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density (...) at `value` (..., D)."""
        return self.block_log_prob(value).sum(dim=-1)

    def sample(
        self, sample_shape: Sequence[int] = (), *, generator: torch.Generator | None = None
    ) -> Tensor:
        """Draws (*sample_shape, ..., D) with `generator`, or with torch's global one."""
        shape = torch.Size(sample_shape) + self.batch_shape
        uniform = torch.rand(*shape, len(self.blocks), generator=generator)
        normal = torch.randn(*shape, self.event_shape[0], generator=generator)
        return self.from_noise(uniform, normal)

    def from_noise(self, uniform: Tensor, normal: Tensor) -> Tensor:
        """A draw (..., D) as a function of uniform (..., blocks) and normal (..., D) noise."""
        shape = normal.shape[:-1]
        parts = zip(self.blocks, uniform.unbind(-1), normal.split(self.widths, -1), strict=True)
        return torch.cat([block.expand(shape).from_noise(u, e) for block, u, e in parts], dim=-1)

    def normal_scores(self, value: Tensor) -> Tensor:
        """The quantiles (..., D) of the standard normal at the PIT of `value` (..., D)."""
        return torch.cat([block.normal_scores(part) for block, part in self._split(value)], dim=-1)

    def widened(self, factor: Tensor) -> Blocks:
        """The same with all deviations from the mean multiplied by `factor` (D,), but of events."""
        return Blocks([block.widened(part) for block, part in self._split(factor)])

    def _split(self, value: Tensor) -> Iterator[tuple[Block, Tensor]]:
        """Each block, with its part of `value` (..., D)."""
        return zip(self.blocks, value.split(self.widths, dim=-1), strict=True)


class MixtureHead(nn.Module):
    """The last layer of a mixture density network (Eq. 6).

    Parameters
    ----------
    features : int
        Width H of the encoded context.
    width : int
        Number D of components of z.
    components : int
        Number K of components of the mixture.

    """

    def __init__(self, features: int, width: int, components: int) -> None:
        super().__init__()
        self.width = width
        self.components = components
        self.lower = width * (width + 1) // 2
        self.linear = nn.Linear(features, components * (1 + width + self.lower))

    def forward(self, encoded: Tensor, shift: Tensor, scale: Tensor) -> GaussianMixture:
        """The mixture of z for contexts (..., H); `shift` and `scale` (D,) are its units."""
        return self.mixture(self.linear(encoded), shift, scale)

    def mixture(self, raw: Tensor, shift: Tensor, scale: Tensor) -> GaussianMixture:
        """The mixture of outputs `raw` (..., K (1 + D + D (D + 1) / 2)) of the linear layer."""
        raw = raw.unflatten(-1, (self.components, -1))
        logits, mean, lower = raw.split([1, self.width, self.lower], dim=-1)
        factor = raw.new_zeros(*raw.shape[:-1], self.width, self.width)
        row, column = torch.tril_indices(self.width, self.width, device=raw.device)
        positive = nn.functional.softplus(lower) + FLOOR
        factor[..., row, column] = torch.where(row == column, positive, lower)
        return GaussianMixture(logits[..., 0], mean * scale + shift, scale[:, None] * factor)

    @torch.no_grad()
    def initialise(self, values: NDArray, seed: int) -> None:
        """Start at a mixture of independent components of z (n, D) in standard units.

        It is the best of several runs of expectation maximisation, and nearly without context.
        Clusters would be no start: groups of outliers take most of them, and the component that is
        left for all other examples is too wide. The variance of a component is shrunk towards that
        of all examples, which counts as two examples: that of a few is no estimate.
        """
        from sklearn.mixture import GaussianMixture as MixtureByEM

        if len(values) > STARTED_FROM:
            values = np.random.default_rng(seed).choice(values, STARTED_FROM, replace=False)
        count = min(self.components, len(np.unique(values, axis=0)))
        fitted = MixtureByEM(
            count,
            covariance_type="diag",
            init_params="random_from_data",
            n_init=10,
            max_iter=1000,
            reg_covar=(2 * FLOOR) ** 2,
            random_state=seed,
            # The library refuses a single example, which may be all there is.
        ).fit(np.resize(values, (max(2, len(values)), self.width)))
        examples = fitted.weights_[:, None] * len(values)
        shrunk = (examples * fitted.covariances_ + 2 * values.var(axis=0)) / (examples + 2)
        deviations = torch.as_tensor(np.sqrt(shrunk).clip(2 * FLOOR) - FLOOR)
        bias = torch.zeros(self.components, 1 + self.width + self.lower)
        diagonal = [i * (i + 1) // 2 + i for i in range(self.width)]
        for k in range(self.components):
            bias[k, 0] = np.log(max(fitted.weights_[k % count], 1 / len(values)))
            bias[k, 1 : 1 + self.width] = torch.as_tensor(fitted.means_[k % count])
            bias[k, 1 + self.width :][diagonal] = deviations[k % count].expm1().log().float()
        self.linear.bias.copy_(bias.flatten())
        self.linear.weight.mul_(0.1)


class BernoulliHead(nn.Module):
    """The last layer of a network that predicts the probabilities of events.

    Parameters
    ----------
    features : int
        Width H of the encoded context.
    width : int
        Number D of events.

    """

    def __init__(self, features: int, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(features, width)

    def forward(self, encoded: Tensor, shift: Tensor, scale: Tensor) -> Bernoullis:
        """The events for contexts (..., H); they have no unit, `shift` and `scale` are not used."""
        return Bernoullis(self.linear(encoded))

    @torch.no_grad()
    def initialise(self, values: NDArray, seed: int) -> None:
        """Start at the frequency of each event (n, D), nearly without context.

        Frequencies are shrunk towards that of all events, which counts as ten examples.
        """
        common = (values.sum() + 0.5) / (values.size + 1)
        frequency = (values.sum(axis=0) + 10 * common) / (len(values) + 10)
        self.linear.bias.copy_(torch.as_tensor(np.log(frequency / (1 - frequency))))
        self.linear.weight.mul_(0.1)
