"""`Additive`: z is added to the nominal output at every sample (Eq. 4 and 6 per time step)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from retwin.data.trajectories import Channels
from retwin.update.corrections.correction import Context, Discrepancy, Head


@dataclass(frozen=True)
class Additive:
    """ỹ_t = ŷ_t + z_t: one z per output and sample, so M is T.

    It can express any discrepancy, and explains none: z contains the noise of the measurement. It
    suits systems with a permanent discrepancy, such as hidden dynamics that the twin lacks; where
    each segment has an error of its own, other operators explain more with fewer parameters.
    """

    resolution: ClassVar[str] = "step"
    """One z per sample."""

    def latent(self, inputs: Channels, outputs: Channels) -> Channels:
        """A residual of every output, in its unit."""
        return Channels(tuple(f"residual_{name}" for name in outputs.names), outputs.units)

    def heads(self, inputs: Channels, outputs: Channels) -> tuple[Head, ...]:
        """One block: residuals of the outputs at a sample belong together."""
        return (Head("residual", len(outputs)),)

    def apply(self, context: Context, z: Tensor) -> Tensor:
        """The path plus z, both (n, T, d_y)."""
        return context.path + z

    def infer(self, context: Context, observed: Tensor, mask: Tensor) -> Discrepancy:
        """z* = y - ŷ where y was measured, and nothing elsewhere; exact, so without covariance."""
        with torch.no_grad():
            z = torch.where(mask, observed - context.path, 0.0)
        certain = z.new_zeros(*z.shape, z.shape[-1])
        return Discrepancy(z, certain, identified=mask.clone(), noise=z.new_zeros(len(z)))
