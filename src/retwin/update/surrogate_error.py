"""A surrogate's own error on commands, by which what is inferred through it is less certain."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.data.segments import Segments
from retwin.errors import InputError
from retwin.twins.twin import SimulationError, Twin
from retwin.update.corrections.warp import within
from retwin.update.surrogate import Surrogate

__all__ = ["surrogate_variance"]


def surrogate_variance(
    surrogate: Surrogate, twin: Twin | None, commands: NDArray, segments: Segments
) -> Tensor | None:
    """Mean square (n, M, d_y) of a surrogate's error in each segment, in output units squared.

    Parameters
    ----------
    surrogate : Surrogate
        Another object, such as a twin in its place, has no error.
    twin : Twin, optional
        The twin that it was trained on, which simulates the commands. Without it, or if it refuses
        them, the error is that on the simulations that were held out of the training.
    commands : NDArray
        (n, T, d_u), without faults.
    segments : Segments
        M at most; 0 where a segment does not exist.

    """
    if not isinstance(surrogate, Surrogate) or surrogate.fitted is None:
        return None
    valid = torch.as_tensor(segments.valid)[..., None]
    try:
        exact = None if twin is None else twin.simulate(commands, seed=0).nominal
    except (InputError, SimulationError):
        exact = None
    if exact is None:
        return surrogate.held_out_variance * valid
    error = torch.as_tensor(surrogate.predict(commands) - exact, dtype=torch.float64)
    time = torch.arange(commands.shape[1], dtype=torch.float64)
    inside = within(time, segments.start, np.ceil(segments.stop) - 1) & valid
    square = inside.double() @ error.square()
    return square / inside.sum(dim=-1).clamp_min(1)[..., None]
