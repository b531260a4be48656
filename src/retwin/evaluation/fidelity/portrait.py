"""Each measured trajectory beside what a corrected twin would do when nothing is broken."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.data.trajectories import Channels, Trajectories
from retwin.evaluation.fidelity.figures import LEVELS
from retwin.progress import Progress
from retwin.serialisation.files import write_atomically
from retwin.update.corrected import CorrectedTwin
from retwin.update.residual import infer_discrepancy, segment

__all__ = ["Overlay", "predictive_overlay"]

_ARRAYS = ("ids", "bands", "z", "deviation", "times")


@dataclass(frozen=True, eq=False)
class Overlay:
    """n trajectories at P moments in d outputs, with at most M movements.

    Attributes
    ----------
    latent: names and units of the k components of z.
    ids: (n,).
    bands: (n, 5, P, d), the 5, 25, 50, 75 and 95 % quantiles of what the twin would do.
    z, deviation: (n, M, k), what explains the outputs if nothing is broken, and how well that is
        known; NaN where the outputs do not tell it.
    times: (n, M, 3) in s, a movement's onset, the end of its motion, and its end; NaN for none.

    """

    latent: Channels
    ids: NDArray
    bands: NDArray
    z: NDArray
    deviation: NDArray
    times: NDArray

    def save(self, file: str | Path) -> None:
        """Write an NPZ file; `load` reads it."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        latent = np.array([self.latent.names, self.latent.units])
        with write_atomically(Path(file)) as part:
            np.savez_compressed(part, allow_pickle=False, latent=latent, **arrays)

    @classmethod
    def load(cls, file: str | Path) -> Overlay:
        """Read what `save` wrote."""
        with np.load(file, allow_pickle=False) as found:
            latent = Channels(*(tuple(row.tolist()) for row in found["latent"]))
            return cls(latent, **{name: found[name] for name in _ARRAYS})

    @classmethod
    def concatenate(cls, parts: list[Overlay]) -> Overlay:
        """Several sets of trajectories as one; those with fewer movements are filled up."""
        most = max(part.times.shape[1] for part in parts)

        def filled(values: NDArray) -> NDArray:
            missing = most - values.shape[1]
            return np.pad(values, ((0, 0), (0, missing), (0, 0)), constant_values=np.nan)

        return cls(
            parts[0].latent,
            np.concatenate([part.ids for part in parts]),
            np.concatenate([part.bands for part in parts]),
            *(
                np.concatenate([filled(getattr(part, name)) for part in parts])
                for name in ("z", "deviation", "times")
            ),
        )


def predictive_overlay(
    twin: CorrectedTwin,
    trajectories: Trajectories,
    *,
    draws: int = 100,
    seed: int,
    rate: float,
    progress: Progress | None = None,
) -> Overlay:
    """Simulate each trajectory's commands `draws` times as if healthy, and infer its z likewise.

    Where something is broken, outputs leave the bands and z is not believable: that is what a
    portrait shows. `rate`: samples per second to keep, a whole part of the data's.
    """
    correction = twin.residual.correction
    latent = correction.latent(twin.inputs, twin.outputs)
    movements = segment(
        trajectories.commands,
        twin.surrogate.predict(trajectories.commands),
        twin.residual.segmentation or "commands",
    )
    shape = (len(trajectories), movements.max_count, len(latent))
    z, deviation = np.full(shape, np.nan), np.full(shape, np.nan)
    if correction.resolution == "segment":
        _, found = infer_discrepancy(twin.surrogate, trajectories, correction, segments=movements)
        variance = found.covariance.diagonal(dim1=2, dim2=3).clamp_min(0.0)
        told = found.identified & torch.as_tensor(movements.valid)[..., None]
        z = torch.where(told, found.z, torch.nan).numpy()
        deviation = torch.where(told, variance.sqrt(), torch.nan).numpy()
    times = np.stack([movements.start, movements.settle, movements.stop], axis=-1)
    every = max(1, round(trajectories.rate / rate))
    seeds = np.random.SeedSequence(seed).generate_state(len(trajectories)).tolist()
    bands = []
    for i, for_twin in enumerate(seeds):
        commands = np.repeat(trajectories.commands[[i]], draws, axis=0)
        made = twin.simulate(commands, seed=for_twin).observed[:, ::every]
        bands.append(np.quantile(made, LEVELS, axis=0, method="weibull"))
        if progress is not None:
            progress((i + 1) / len(trajectories))
    return Overlay(
        latent,
        trajectories.ids,
        np.stack(bands).astype(np.float32),
        z.astype(np.float32),
        deviation.astype(np.float32),
        np.where(movements.valid[..., None], times / trajectories.rate, np.nan),
    )
