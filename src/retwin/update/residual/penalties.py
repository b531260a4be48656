"""The regularisers of Eq. 9, over segments or over samples, and the bounds in them."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.checks import require
from retwin.data.trajectories import Channels

__all__ = ["checked_bounds", "penalties"]


def penalties(
    mean: Tensor,
    bounds: Tensor,
    scale: Tensor,
    valid: Tensor,
    smoothness: float,
    boundedness: float,
) -> Tensor:
    """λ_s times the mean square step of z̄, plus λ_b times its mean square excess over b (Eq. 9).

    Parameters
    ----------
    mean : Tensor
        (n, M, d_z), z̄ over M segments or samples.
    bounds, scale : Tensor
        (d_z,), b, and the unit of z in which steps and excess are measured.
    valid : Tensor
        (n, M) bool, what is averaged over.
    smoothness, boundedness : float
        λ_s and λ_b.

    Returns
    -------
    Tensor
        A scalar.

    """
    step = (mean[:, 1:] - mean[:, :-1]) / scale
    both = valid[:, 1:] & valid[:, :-1]
    roughness = (step.square().sum(-1) * both).sum() / both.sum().clamp_min(1)
    beyond = torch.relu(mean.abs() - bounds) / scale
    excess = (beyond.square().sum(-1) * valid).sum() / valid.sum().clamp_min(1)
    return smoothness * roughness + boundedness * excess


def checked_bounds(bounds: NDArray, latent: Channels) -> Tensor:
    """The bounds b (d_z,) that a user gives; InputError unless each is positive."""
    require(
        np.shape(bounds) == (len(latent),) and (np.asarray(bounds) > 0).all(),
        "bounds",
        expected=f"one positive bound for each of {', '.join(latent.names)}",
        got=repr(bounds),
        remedy="leave bounds out to take them from the data",
    )
    return torch.as_tensor(bounds, dtype=torch.float32)
