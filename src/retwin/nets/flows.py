"""Conditional normalising flows: distributions of any shape, where a mixture is too coarse."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING

import torch
from numpy.typing import NDArray
from scipy.stats import qmc
from torch import Tensor, nn
from torch.distributions import Distribution

from retwin.checks import needs_extra
from retwin.nets.mixtures import Block

if TYPE_CHECKING:
    from zuko.distributions import NormalizingFlow


class FlowDistribution(Block):
    """A normalising flow in physical units.

    Parameters
    ----------
    flow : NormalizingFlow
        Distribution of z in standard units.
    shift, scale : Tensor
        (D,), z is its standard value times `scale` plus `shift`.
    wider : Tensor or float
        (..., D), standard deviation of the noise that the flow transforms.

    """

    def __init__(
        self, flow: NormalizingFlow, shift: Tensor, scale: Tensor, wider: Tensor | float = 1.0
    ) -> None:
        self.flow = flow
        self.shift = shift
        self.scale = scale
        self.wider = torch.as_tensor(wider, dtype=scale.dtype, device=scale.device)
        super().__init__(flow.batch_shape, flow.event_shape, validate_args=False)

    def expand(
        self, batch_shape: Sequence[int], _instance: Distribution | None = None
    ) -> FlowDistribution:
        """The same distribution for a larger batch."""
        flow = self.flow.expand(torch.Size(batch_shape))
        return FlowDistribution(flow, self.shift, self.scale, self.wider)

    @property
    def mean(self) -> Tensor:
        """The mean (..., D), by quasi Monte Carlo."""
        return self._quasi_random_draws().mean(dim=0)

    @property
    def variance(self) -> Tensor:
        """The variance of each component, (..., D), by quasi Monte Carlo."""
        return self._quasi_random_draws().var(dim=0)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density (...) at `value` (..., D)."""
        standard = (value - self.shift) / self.scale
        noise = self.flow.transform(standard)
        narrower = 0.5 * noise.square() * (1 - self.wider.square().reciprocal())
        density = self.flow.log_prob(standard) + narrower.sum(dim=-1)
        return density - (self.scale * self.wider).log().sum(dim=-1)

    def from_noise(self, uniform: Tensor, normal: Tensor) -> Tensor:
        """A draw (..., D) as a function of normal noise (..., D); `uniform` is not used."""
        return self.flow.transform.inv(self.wider * normal) * self.scale + self.shift

    def normal_scores(self, value: Tensor) -> Tensor:
        """The standard normal noise (..., D) of which `value` (..., D) is the draw."""
        return self.flow.transform((value - self.shift) / self.scale) / self.wider

    def widened(self, factor: Tensor) -> FlowDistribution:
        """The same with the deviations of the noise multiplied by `factor` (..., D)."""
        return FlowDistribution(self.flow, self.shift, self.scale, factor * self.wider)

    def _quasi_random_draws(self) -> Tensor:
        points = _quasi_random_noise(self.event_shape[0]).to(self.shift)
        shape = (len(points), *(1 for _ in self.batch_shape), -1)
        noise = points.view(shape).expand(len(points), *self.batch_shape, -1)
        return self.from_noise(noise, noise)


@cache
def _quasi_random_noise(width: int) -> Tensor:
    """Standard normal noise (32, width) from a scrambled Sobol sequence."""
    uniform = qmc.Sobol(width, rng=0).random(32)
    return torch.special.ndtri(torch.as_tensor(uniform).clamp(1e-6, 1 - 1e-6))


class FlowHead(nn.Module):
    """The last layer of a network that predicts a flow: rational-quadratic splines (zuko's NSF).

    Parameters
    ----------
    features : int
        Width H of the encoded context.
    width : int
        Number D of components of z.
    transforms : int
        Autoregressive transformations in series.
    bins : int
        Bins of each spline.

    Raises
    ------
    InputError
        The package zuko is not installed.

    References
    ----------
    Durkan et al., "Neural spline flows", NeurIPS 2019.

    """

    def __init__(self, features: int, width: int, *, transforms: int, bins: int) -> None:
        super().__init__()
        flows = needs_extra("zuko.flows", "flows", "holds the normalising flows")
        self.flow = flows.NSF(
            width, features, transforms=transforms, bins=bins, hidden_features=(features,)
        )

    def forward(self, encoded: Tensor, shift: Tensor, scale: Tensor) -> FlowDistribution:
        """The distribution of z for contexts (..., H); `shift` and `scale` (D,) are its units."""
        return FlowDistribution(self.flow(encoded), shift, scale)

    @torch.no_grad()
    def initialise(self, values: NDArray, seed: int) -> None:
        """Start at the standard normal, without context; z in standard units is near to it."""
        for transform in self.flow.transform.transforms:
            transform.hyper[-1].weight.zero_()
            transform.hyper[-1].bias.zero_()
