"""What a twin says of measured records, sample by sample, and how far off it is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.evaluation.fidelity.figures import LEVELS
from retwin.progress import Progress
from retwin.serialisation.files import write_atomically
from retwin.twins.twin import Twin

__all__ = ["Simulation", "simulate_records"]

_ARRAYS = ("ids", "observed", "mean", "bands", "crps")


@dataclass(frozen=True, eq=False)
class Simulation:
    """n records of T samples in d outputs, simulated many times from their commands alone.

    Attributes
    ----------
    ids: (n,).
    observed: (n, T, d), NaN where nothing was measured.
    mean: (n, T, d), of the draws.
    bands: (n, 5, T, d), their 5, 25, 50, 75 and 95 % quantiles.
    crps: (n, T, d) in the outputs' units, without the bias of few draws; NaN like `observed`.

    """

    ids: NDArray
    observed: NDArray
    mean: NDArray
    bands: NDArray
    crps: NDArray

    @property
    def random(self) -> bool:
        """Whether the twin has any chance in it; one without has no bands to speak of."""
        return bool(np.any(self.bands[:, 0] < self.bands[:, -1]))

    def inside(self, level: int) -> NDArray:
        """Whether each sample (n, T, d) lies inside the central 50 or 90 % band; NaN like it."""
        low, high = (self.bands[:, i] for i in ((1, 3) if level == 50 else (0, 4)))
        within = (low <= self.observed) & (self.observed <= high)
        return np.where(np.isnan(self.observed), np.nan, within)

    def save(self, file: str | Path) -> None:
        """Write an NPZ file; `load` reads it."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        with write_atomically(Path(file)) as part:
            np.savez_compressed(part, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, file: str | Path) -> Simulation:
        """Read what `save` wrote."""
        with np.load(file, allow_pickle=False) as found:
            return cls(**{name: found[name] for name in _ARRAYS})


def simulate_records(
    twin: Twin,
    records: Trajectories,
    *,
    draws: int = 500,
    seed: int,
    progress: Progress | None = None,
) -> Simulation:
    """Simulate each record's commands `draws` times; measured outputs are only held against it.

    This is simulation, not prediction: no measured output is used, at no sample.
    """
    import scoringrules

    seeds = np.random.SeedSequence(seed).generate_state(len(records)).tolist()
    measured = np.where(records.mask, records.observed, np.nan).astype(np.float64)
    means, bands, scores = [], [], []
    for i, for_twin in enumerate(seeds):
        commands = np.repeat(records.commands[[i]], draws, axis=0)
        made = twin.simulate(commands, seed=for_twin).observed.astype(np.float64)
        means.append(made.mean(axis=0))
        bands.append(np.quantile(made, LEVELS, axis=0, method="weibull"))
        scores.append(scoringrules.crps_ensemble(measured[i], made, m_axis=0, estimator="pwm"))
        if progress is not None:
            progress((i + 1) / len(records))
    return Simulation(records.ids, measured, *map(np.stack, (means, bands, scores)))
