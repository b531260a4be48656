"""How pages show the components of z: delays in ms, though they are in samples inside."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Channels


def shown_latents(latent: Channels, rate: float) -> tuple[Channels, NDArray]:
    """Names and units of z as shown, and the factor (k,) by which each component is multiplied."""
    samples = np.array([unit == "samples" for unit in latent.units])
    units = ("ms" if each else unit for each, unit in zip(samples, latent.units, strict=True))
    return Channels(latent.names, tuple(units)), np.where(samples, 1000 / rate, 1.0)
