"""Whether the bands of a fitted residual model hold what it was calibrated on."""

from __future__ import annotations

import math
import warnings

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.update.corrections import Chain, Context, measured_outputs, sensor_of
from retwin.update.residual.residual import Residual

DRAWS = 59
"""Draws of each trajectory: a measured sample has one of 60 ranks among them, all equally probable
if the model is right."""
TOO_FEW = 0.7
"""Share of measured samples in a band of 90 % below which a warning is given: it misses three times
as many as it states."""


@torch.no_grad()
def coverage(
    model: Residual, context: Context, observed: Tensor, mask: Tensor, *, seed: int, outer: int = 3
) -> NDArray:
    """Share of measured samples in the central 90 % of draws, (n, d_y); NaN where none is measured.

    Parameters
    ----------
    model : Residual
        Fitted.
    context : Context
        Of n trajectories.
    observed, mask : Tensor
        (n, T, d_y), with a mask that is True for the sensor's own samples.
    seed : int
        Of the draws.
    outer : int, default 3
        Ranks outside the band at each end: 54 of 60 ranks are 90 %.

    """
    generator = torch.Generator().manual_seed(seed)
    rank = torch.zeros(observed.shape, dtype=torch.int16)
    for _ in range(DRAWS):
        z = model.sample(context, generator=generator)
        drawn = measured_outputs(model.correction, context, z, generator)
        # Equal values, as of a sensor that rounds, are below and above in turn.
        above = torch.rand(drawn.shape, generator=generator) < 0.5
        rank += (drawn < observed) | ((drawn == observed) & above)
    inside = (rank >= outer) & (rank <= DRAWS - outer) & mask
    count = mask.sum(dim=1)
    return torch.where(count > 0, inside.sum(dim=1).double() / count, torch.nan).numpy()


def coverage_figures(
    model: Residual, context: Context, observed: Tensor, mask: Tensor, *, seed: int
) -> dict[str, float]:
    """`coverage90_NAME` of each measured output, on trajectories that the model was fitted to.

    Warns
    -----
    UserWarning
        Bands hold less than TOO_FEW of the samples of an output, also at the upper end of its 99 %
        interval over trajectories.

    """
    # Trajectories that are compared, so that it takes seconds.
    part = slice(0, 60)
    shares = coverage(model, context[part], observed[part], mask[part], seed=seed)
    figures, low = {}, {}
    for name, own in zip(model.outputs.names, shares.T, strict=True):
        own = own[np.isfinite(own)]
        if not len(own):
            continue
        figures[f"coverage90_{name}"] = mean = float(own.mean())
        error = own.std(ddof=1) / math.sqrt(len(own)) if len(own) > 1 else math.inf
        if mean + 2.33 * error < TOO_FEW:
            low[name] = mean
    if low:
        listed = ", ".join(f"{share:.0%} of the samples of {name}" for name, share in low.items())
        remedy = "take another one, such as Additive()"
        if sensor_of(model.correction) is None:
            remedy += ", or end it with a SampledSensor() if measurement noise is what it lacks"
        operators = " and ".join(_operators(model.correction))
        warnings.warn(
            f"correction: bands of 90 % hold {listed} of the calibration itself, since "
            f"{operators} cannot express what was measured; {remedy} (docs/correct.md)",
            stacklevel=4,
        )
    return figures


def _operators(correction: object) -> list[str]:
    """The names of the operators of a correction, in series."""
    if isinstance(correction, Chain):
        return [*_operators(correction.first), *_operators(correction.second)]
    return [type(correction).__name__]
