"""The regularisers of Eq. 9, over segments or over samples, and the bounds in them."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.checks import require
from retwin.data.trajectories import Channels
from retwin.update.residual.residual import Residual

SMALLEST = 1e-12
"""Smallest value taken for the largest |z*|: a millionth of it still has a square in float32."""
BOUND_MARGIN = 1.25
"""Default bound b of Eq. 9, over the largest |z*|."""


def penalties(model: Residual, mean: Tensor, valid: Tensor) -> Tensor:
    """λ_s times the mean square step of z̄, plus λ_b times its mean square excess over b (Eq. 9).

    Parameters
    ----------
    model : Residual
        Its `bounds` are b, its `scale` the unit in which steps and excess are measured, and its
        `density` holds λ_s and λ_b.
    mean : Tensor
        (..., n, M, d_z), z̄ over M segments or samples.
    valid : Tensor
        (..., n, M) bool, what is averaged over.

    Returns
    -------
    Tensor
        (...).

    """
    step = (mean[..., 1:, :] - mean[..., :-1, :]) / model.scale
    beyond = torch.relu(mean.abs() - model.bounds) / model.scale
    roughness = mean_where(step.square().sum(-1), valid[..., 1:] & valid[..., :-1])
    excess = mean_where(beyond.square().sum(-1), valid)
    return model.density.smoothness * roughness + model.density.boundedness * excess


def mean_where(values: Tensor, valid: Tensor) -> Tensor:
    """The mean (...) of values (..., n, M) that are valid."""
    return torch.where(valid, values, 0.0).sum((-2, -1)) / valid.sum((-2, -1)).clamp_min(1)


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
