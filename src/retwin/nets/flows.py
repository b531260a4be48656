"""Conditional normalising flows: a density without a shape given beforehand, beside mixtures."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, ClassVar

import torch
from numpy.typing import NDArray
from scipy.stats import qmc
from torch import Tensor, nn
from torch.distributions import Distribution, constraints

from retwin.errors import InputError

if TYPE_CHECKING:
    from zuko.distributions import NormalizingFlow

__all__ = ["FlowHead", "FlowLaw"]


class FlowLaw(Distribution):
    """A flow in physical units: standard units times `scale` plus `shift`, both (D,)."""

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    support = constraints.real_vector

    def __init__(self, flow: NormalizingFlow, shift: Tensor, scale: Tensor) -> None:
        self.flow = flow
        self.shift = shift
        self.scale = scale
        super().__init__(flow.batch_shape, flow.event_shape, validate_args=False)

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> FlowLaw:
        """The same law, repeated to a larger batch."""
        return FlowLaw(self.flow.expand(torch.Size(batch_shape)), self.shift, self.scale)

    @property
    def mean(self) -> Tensor:
        """The mean (..., D), over points that fill the normal noise evenly."""
        return self._spread().mean(dim=0)

    @property
    def variance(self) -> Tensor:
        """Of each component, (..., D), over the same points."""
        return self._spread().var(dim=0)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density at `value` (..., D)."""
        standard = self.flow.log_prob((value - self.shift) / self.scale)
        return standard - self.scale.log().sum()

    def from_noise(self, uniform: Tensor, normal: Tensor) -> Tensor:
        """The draw (..., D) that normal noise (..., D) stands for; `uniform` is not needed."""
        return self.flow.transform.inv(normal) * self.scale + self.shift

    def normal_scores(self, value: Tensor) -> Tensor:
        """The noise (..., D) whose draw `value` is."""
        return self.flow.transform((value - self.shift) / self.scale)

    def _spread(self) -> Tensor:
        points = _even_noise(self.event_shape[0]).to(self.shift)
        shape = (len(points), *(1 for _ in self.batch_shape), -1)
        noise = points.view(shape).expand(len(points), *self.batch_shape, -1)
        return self.from_noise(noise, noise)


@cache
def _even_noise(width: int) -> Tensor:
    """Normal noise (32, width) that lies evenly: a scrambled Sobol sequence."""
    uniform = qmc.Sobol(width, rng=0).random(32)
    return torch.special.ndtri(torch.as_tensor(uniform).clamp(1e-6, 1 - 1e-6))


class FlowHead(nn.Module):
    """Encoded context (..., H) in, `FlowLaw` over `width` components of z out.

    Autoregressive rational-quadratic splines (zuko's NSF), at first the standard normal.

    Raises InputError when zuko is not installed.
    """

    def __init__(self, features: int, width: int, *, transforms: int, bins: int) -> None:
        super().__init__()
        try:
            from zuko.flows import NSF
        except ImportError:
            raise InputError(
                "density",
                expected="the package zuko for flows",
                got="an installation without it",
                remedy='install it: pip install "retwin[flows]"',
            ) from None
        self.flow = NSF(
            width, features, transforms=transforms, bins=bins, hidden_features=(features,)
        )

    def forward(self, encoded: Tensor, shift: Tensor, scale: Tensor) -> FlowLaw:
        """The law in physical units."""
        return FlowLaw(self.flow(encoded), shift, scale)

    @torch.no_grad()
    def initialise(self, values: NDArray, seed: int) -> None:
        """Start at the standard normal, in any context; `values` are in its units already."""
        for transform in self.flow.transform.transforms:
            transform.hyper[-1].weight.zero_()
            transform.hyper[-1].bias.zero_()
