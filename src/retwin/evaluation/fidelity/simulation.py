"""Test records simulated from their commands alone, and the scores of that simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.evaluation.fidelity.figures import StoredArrays
from retwin.progress import Progress, tracked
from retwin.scores.distributions import central_band, crps, inside, log_score, quantiles
from retwin.twins.twin import Twin
from retwin.update.training_range import checked_once


@dataclass(frozen=True, eq=False)
class Simulation(StoredArrays):
    """n records of T samples in d outputs, each simulated many times from its commands alone.

    Attributes
    ----------
    ids : NDArray
        Names of the records (n,).
    observed : NDArray
        Measured outputs (n, T, d); NaN where nothing was measured.
    mean : NDArray
        Mean of the draws (n, T, d).
    bands : NDArray
        5, 25, 50, 75 and 95 % quantiles of the draws (n, 5, T, d).
    crps : NDArray
        CRPS (n, T, d) in the outputs' units, without the bias of a finite ensemble; NaN where
        nothing was measured.
    nll : NDArray
        Negative log density (n, T, d), see `retwin.scores.log_score`.

    """

    ids: NDArray
    observed: NDArray
    mean: NDArray
    bands: NDArray
    crps: NDArray
    nll: NDArray

    @property
    def random(self) -> bool:
        """Whether the draws differ; the bands of a deterministic twin have no width."""
        return bool(np.any(self.bands[:, 0] < self.bands[:, -1]))

    def per_sample(self) -> NDArray:
        """Squared error, CRPS, whether a value is inside the 50 and the 90 % band, and the NLL.

        Returns
        -------
        NDArray
            (n, T, d, 5); NaN where nothing was measured. Both shares of a deterministic twin are
            NaN; so is the NLL of a twin whose draws do not vary at some measured sample.

        """
        error = np.square(self.mean - self.observed)
        bounds = [central_band(self.bands, level) for level in (50, 90)]
        hits = [inside(self.observed, *each) for each in bounds]
        if not self.random:
            hits = [np.full_like(error, np.nan)] * 2
        nll = np.full_like(self.nll, np.nan) if np.isinf(self.nll).any() else self.nll
        return np.stack([error, self.crps, *hits, nll], axis=-1)

    @classmethod
    def joined(cls, parts: Sequence[Simulation], ids: NDArray) -> Simulation:
        """Simulations of several folds as one, in the order of `ids`."""
        every = cls.concatenate(parts)
        names = every.ids.tolist()
        order = [names.index(name) for name in ids.tolist()]
        return cls(*(each[order] for each in vars(every).values()))


@checked_once
def simulate_records(
    twin: Twin,
    records: Trajectories,
    *,
    draws: int = 500,
    seed: int,
    progress: Progress | None = None,
) -> Simulation:
    """Simulate each record's commands many times, and score the draws.

    No measured output is used in the simulation, at no sample: this is no one-step prediction.

    Parameters
    ----------
    twin : Twin
        It simulates the commands of the records.
    records : Trajectories
        n records with commands.
    draws : int
        Simulations of each record; a twin that is `deterministic` is simulated once.
    seed : int
        The same seed gives the same bytes on the same machine.
    progress : Progress, optional
        Called with the share that is done.

    Returns
    -------
    Simulation
        Draws of the records, summarised.

    """
    once = getattr(twin, "deterministic", False)
    seeds = np.random.SeedSequence(seed).generate_state(len(records)).tolist()
    measured = records.measured.astype(np.float64)
    means, bands, scores, densities = [], [], [], []
    for i, twin_seed in tracked(enumerate(seeds), len(seeds), progress):
        commands = np.repeat(records.commands[[i]], 1 if once else draws, axis=0)
        made = twin.simulate(commands, seed=twin_seed).observed.astype(np.float64)
        if once:
            made = np.repeat(made, 2, axis=0)  # scores compare draws with each other
        means.append(made.mean(axis=0))
        bands.append(quantiles(made))
        scores.append(crps(measured[i], made))
        densities.append(log_score(measured[i], made))
    arrays = map(np.stack, (means, bands, scores, densities))
    return Simulation(records.ids, measured, *arrays)


def record_means(values: NDArray) -> NDArray:
    """Mean of values (n, T, ...) over samples, then over records; NaN ones are left out."""
    seen = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        each = np.where(seen, values, 0.0).sum(axis=1) / seen.sum(axis=1)
    return each.mean(axis=0)


def simulation_scores(means: NDArray, records: Trajectories) -> dict[str, NDArray]:
    """Scores averaged over outputs.

    Parameters
    ----------
    means : NDArray
        Means (..., d, 5) of what `Simulation.per_sample` returns.
    records : Trajectories
        The measured records, for the standard deviation and the units of their outputs.

    Returns
    -------
    dict of str to NDArray
        `rmse` and `crps` (...), NaN where the outputs have different units; `nrmse`, the RMSE
        divided by each output's standard deviation; `coverage50` and `coverage90`; `nll` in nats
        per sample.

    """
    observed = records.measured
    deviation = np.nanstd(observed.astype(float), axis=(0, 1))
    comparable = 1.0 if records.outputs.comparable else np.nan
    square, score, half, wide, density = np.moveaxis(means, -1, 0)
    return {
        "rmse": comparable * np.sqrt(square.mean(axis=-1)),
        "nrmse": (np.sqrt(square) / deviation).mean(axis=-1),
        "crps": comparable * score.mean(axis=-1),
        "coverage50": half.mean(axis=-1),
        "coverage90": wide.mean(axis=-1),
        "nll": density.mean(axis=-1),
    }
