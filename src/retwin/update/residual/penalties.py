"""The regularisers of Eq. 9, over movements or over samples."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["penalties"]


def penalties(
    mean: Tensor, bounds: Tensor, scale: Tensor, valid: Tensor, smoothness: float, bounded: float
) -> Tensor:
    """λ_s times how rough z̄ (n, M, d_z) is from one to the next, λ_b times how far it is beyond b.

    Both in units of `scale`, averaged over what is `valid` (n, M).
    """
    step = (mean[:, 1:] - mean[:, :-1]) / scale
    both = valid[:, 1:] & valid[:, :-1]
    rough = (step.square().sum(-1) * both).sum() / both.sum().clamp_min(1)
    beyond = torch.relu(mean.abs() - bounds) / scale
    outside = (beyond.square().sum(-1) * valid).sum() / valid.sum().clamp_min(1)
    return smoothness * rough + bounded * outside
