"""Each trajectory beside the predictive distribution of its commands without a fault.

Components of z are shown as pages show them: delays in ms, though they are in samples inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.data.segments import Segments
from retwin.data.trajectories import Channels, Trajectories
from retwin.evaluation.fidelity.figures import StoredArrays
from retwin.progress import Progress, tracked
from retwin.scores.distributions import quantiles
from retwin.update.corrected import CorrectedTwin
from retwin.update.residual import infer_discrepancy, segment
from retwin.update.training_range import checked_once


def shown_latents(latent: Channels, rate: float) -> tuple[Channels, NDArray]:
    """Names and units of z as shown, and the factor (k,) by which each component is multiplied."""
    samples = np.array([unit == "samples" for unit in latent.units])
    units = ("ms" if each else unit for each, unit in zip(samples, latent.units, strict=True))
    return Channels(latent.names, tuple(units)), np.where(samples, 1000 / rate, 1.0)


@dataclass(frozen=True, eq=False)
class Overlay(StoredArrays):
    """Predictive overlay of n trajectories at P samples of d outputs, with at most M segments.

    Attributes
    ----------
    latent : Channels
        Names and units of the k components of z.
    ids : NDArray
        Names of the trajectories (n,).
    bands : NDArray
        5, 25, 50, 75 and 95 % quantiles of the outputs without a fault (n, 5, P, d).
    z, deviation : NDArray
        Inferred discrepancy of each segment under the assumption that there is no fault, and its
        standard deviation (n, M, k); NaN where the outputs do not identify it.
    times : NDArray
        Onset, end of the motion part and end of each segment in s (n, M, 3); NaN for none.

    """

    latent: Channels
    ids: NDArray
    bands: NDArray
    z: NDArray
    deviation: NDArray
    times: NDArray


@checked_once
def predictive_overlay(
    twin: CorrectedTwin,
    trajectories: Trajectories,
    *,
    draws: int = 100,
    seed: int,
    rate: float,
    progress: Progress | None = None,
) -> Overlay:
    """Simulate each trajectory's commands without a fault, and infer its z without a fault.

    Where there is a fault, outputs leave the bands and z is implausible.

    Parameters
    ----------
    twin : CorrectedTwin
        Calibrated on healthy trajectories.
    trajectories : Trajectories
        n measured trajectories with commands, healthy or not.
    draws : int
        Simulations of each trajectory.
    seed : int
        The same seed gives the same bytes on the same machine.
    rate : float
        Sample rate of the bands in Hz; the rate of the trajectories is a whole multiple of it.
    progress : Progress, optional
        Called with the share that is done.

    Returns
    -------
    Overlay
        Bands, discrepancies and segment times. z is NaN for corrections per sample.

    """
    segments = segment(
        trajectories.commands,
        twin.surrogate.predict(trajectories.commands),
        twin.residual.segmentation or "commands",
    )
    stride = max(1, round(trajectories.rate / rate))
    seeds = np.random.SeedSequence(seed).generate_state(len(trajectories)).tolist()
    bands = []
    for i, twin_seed in tracked(enumerate(seeds), len(seeds), progress):
        commands = np.repeat(trajectories.commands[[i]], draws, axis=0)
        bands.append(quantiles(twin.simulate(commands, seed=twin_seed).observed[:, ::stride]))
    z, deviation = _discrepancies(twin, trajectories, segments)
    latent, factor = shown_latents(
        twin.residual.correction.latent(twin.inputs, twin.outputs), trajectories.rate
    )
    times = np.stack([segments.start, segments.settle, segments.stop], axis=-1)
    return Overlay(
        latent,
        trajectories.ids,
        np.stack(bands).astype(np.float32),
        (factor * z).astype(np.float32),
        (factor * deviation).astype(np.float32),
        np.where(segments.valid[..., None], times / trajectories.rate, np.nan),
    )


def _discrepancies(
    twin: CorrectedTwin, trajectories: Trajectories, segments: Segments
) -> tuple[NDArray, NDArray]:
    """Inferred z and its standard deviation (n, M, k); NaN where it is not identified."""
    correction = twin.residual.correction
    if correction.resolution != "segment":
        latent = correction.latent(twin.inputs, twin.outputs)
        missing = np.full((*segments.valid.shape, len(latent)), np.nan)
        return missing, missing
    _, found = infer_discrepancy(twin.surrogate, trajectories, correction, segments=segments)
    variance = found.covariance.diagonal(dim1=2, dim2=3).clamp_min(0.0)
    known = found.identified & torch.as_tensor(segments.valid)[..., None]
    z = torch.where(known, found.z, torch.nan).numpy()
    return z, torch.where(known, variance.sqrt(), torch.nan).numpy()
