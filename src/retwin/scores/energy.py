"""The energy score: how well simulated trajectories agree with a measured one, as a whole."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor


@overload
def energy_score(simulated: NDArray, observed: NDArray) -> float: ...


@overload
def energy_score(simulated: Tensor, observed: Tensor) -> Tensor: ...


def energy_score(simulated: Any, observed: Any) -> Any:
    """Energy score of S simulations of one measured trajectory, E‖x − y‖ − E‖x − x'‖ / 2.

    All samples and outputs are one vector. Its norm is divided by √P, so that the score has the
    unit of the outputs. The estimator is unbiased for any number of simulations ("fair").

    Parameters
    ----------
    simulated : NDArray or Tensor
        (S, P, d), at least two simulations.
    observed : NDArray or Tensor
        (P, d), the measured samples.

    Returns
    -------
    float or Tensor
        The score; of tensors it is differentiable, also where two simulations are equal.

    References
    ----------
    Gneiting and Raftery, "Strictly proper scoring rules, prediction, and estimation", JASA 102
    (2007), Eq. 21.

    """
    # Distances pair by pair: scoringrules holds S² P d numbers at once.
    if isinstance(simulated, np.ndarray):
        from scipy.spatial.distance import pdist

        norm = np.linalg.norm
    else:
        from torch import pdist
        from torch.linalg import norm
    scale = math.sqrt(max(len(observed), 1))
    vectors = simulated.reshape(len(simulated), -1) / scale
    error = norm(vectors - observed.reshape(-1) / scale, axis=1).mean()
    return error - 0.5 * pdist(vectors).mean()
