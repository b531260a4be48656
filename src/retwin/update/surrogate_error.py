"""A surrogate's own error on commands, by which what is inferred through it is less certain."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.data.segments import Segments
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.twins.collected import SimulationError
from retwin.twins.twin import Twin
from retwin.update.corrections import Context
from retwin.update.corrections.delays import within
from retwin.update.surrogate import Surrogate, known_samples


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

    Warns
    -----
    UserWarning
        The twin refuses the commands, with the reason.

    """
    if not isinstance(surrogate, Surrogate) or surrogate.fitted is None:
        return None
    valid = torch.as_tensor(segments.valid)[..., None]
    held_out = surrogate.held_out_variance * valid
    if twin is None:
        return held_out
    try:
        simulated = twin.simulate(commands, seed=0)
    except (InputError, SimulationError) as reason:
        warnings.warn(
            f"twin: it does not simulate these commands ({reason}), so that the error of the "
            "surrogate is taken to be that on the simulations held out of its training",
            stacklevel=3,
        )
        return held_out
    error = torch.as_tensor(surrogate.predict(commands) - simulated.nominal, dtype=torch.float64)
    time = torch.arange(commands.shape[1], dtype=torch.float64)
    inside = within(time, segments.start, np.ceil(segments.stop) - 1) & valid
    # A simulation that ends early has no outputs from there on.
    inside = inside & torch.as_tensor(known_samples(simulated, np.arange(len(commands))))[:, None]
    count = inside.sum(dim=-1)[..., None]
    square = inside.double() @ error.square()
    return torch.where(count > 0, square / count.clamp_min(1), held_out)


def warn_of_error(context: Context, used: Trajectories, *, largest_share: float = 0.5) -> None:
    """Warn where the surrogate's own error is most of what outputs differ by.

    Parameters
    ----------
    largest_share : float, default 0.5
        Share of the mean square of the residual above which the surrogate's error is warned of.

    """
    if context.surrogate_variance is None:
        return
    valid = torch.as_tensor(context.segments.valid)
    error = context.surrogate_variance[valid].mean(dim=0).numpy()
    difference = np.where(used.mask, used.observed - context.path.numpy(), 0.0)
    square = np.square(difference, dtype=np.float64).sum(axis=(0, 1))
    count = used.mask.sum(axis=(0, 1))
    # Of an output that is never measured there is no difference.
    share = np.divide(error * count, square, out=np.zeros(len(error)), where=square > 0)
    worst = int(share.argmax())
    if share[worst] > largest_share:
        warnings.warn(
            f"surrogate: its own error is {np.sqrt(error[worst]):.3g} "
            f"{used.outputs.units[worst]} in {used.outputs.names[worst]} on these commands, "
            f"{share[worst]:.0%} of the mean square by which measured outputs differ from it; "
            "little can be inferred. Train it for longer or on other commands (fit_surrogate), or "
            "use the twin in its place",
            stacklevel=3,
        )
