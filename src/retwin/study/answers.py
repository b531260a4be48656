"""What sources answered: diagnoses of test trajectories, or simulations of test records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from retwin.catalog import SOURCES
from retwin.data.trajectories import Trajectories
from retwin.diagnosis.pooled import pool_probabilities
from retwin.evaluation.fidelity import Simulation
from retwin.scores.bootstrap import bootstrap, bootstrap_means, bootstrap_weights
from retwin.scores.classification import METRICS, confusion, score
from retwin.study.work import Work

__all__ = ["Answers", "Diagnoses", "Simulations", "answers"]

DRAWS = 10_000


class Answers(Protocol):
    """Scores of every source, over runs and over test trajectories drawn again.

    Attributes
    ----------
    compared: scores by which sources are compared, those of Holm's family first.
    family: scores of which one claim is corrected for the others.
    curved: scores that a learning curve shows.

    """

    compared: ClassVar[tuple[str, ...]]
    family: ClassVar[tuple[str, ...]]
    curved: ClassVar[tuple[str, ...]]

    def scores(self, source: str, healthy: int = 0) -> dict[str, list[float]]:
        """One value per run; see `Job.healthy`."""
        ...

    def drawn(self, source: str, healthy: int = 0) -> dict[str, NDArray]:
        """What is compared, averaged over runs, of every draw; draws of all sources are paired."""
        ...

    def told(self, source: str) -> dict[str, Any]:
        """What else the results hold of a source."""
        ...

    def arrays(self) -> dict[str, NDArray]:
        """What is too large for `results.json`."""
        ...


def answers(work: Work) -> Answers:
    """Those of a study, of the kind that its case has."""
    return Diagnoses(work) if work.case.diagnosed else Simulations(work)


@dataclass(frozen=True)
class Diagnoses:
    """Class probabilities of test trajectories. `probabilities/SOURCE` (runs, n, classes)."""

    work: Work
    family: ClassVar[tuple[str, ...]] = ("macro_f1", "balanced_accuracy", "auroc")
    compared: ClassVar[tuple[str, ...]] = (*family, "accuracy", "healthy_recall")
    curved: ClassVar[tuple[str, ...]] = ("macro_f1", "healthy_recall")

    @cached_property
    def _tested(self) -> list[int]:
        return sorted(self.work.roles.tested)

    @cached_property
    def _truth(self) -> NDArray:
        labels = self.work.files.real_data()[self._tested].labels
        return np.array([self.work.case.classes.index(label) for label in labels])

    @cached_property
    def _weights(self) -> NDArray:
        seed = self.work.plan.seed_of("bootstrap", 0)
        return bootstrap_weights(self._truth, draws=DRAWS, seed=seed)

    def _probabilities(self, source: str, healthy: int = 0) -> NDArray:
        members = SOURCES[source].pool
        if members:
            return pool_probabilities([self._probabilities(member, healthy) for member in members])
        place = {index: i for i, index in enumerate(self._tested)}
        runs = self.work.plan.number_of_runs
        out = np.full((runs, len(self._tested), len(self.work.case.classes)), np.nan)
        for job in self.work.answers(source, healthy):
            with np.load(self.work.files.path(job)) as made:
                out[job.run, [place[i] for i in made["tested"].tolist()]] = made["probabilities"]
        return out

    def scores(self, source: str, healthy: int = 0) -> dict[str, list[float]]:
        """See `Answers.scores`."""
        classes = self.work.case.classes
        runs = [score(self._truth, run, classes) for run in self._probabilities(source, healthy)]
        return {metric: [getattr(each, metric) for each in runs] for metric in METRICS}

    def drawn(self, source: str, healthy: int = 0) -> dict[str, NDArray]:
        """See `Answers.drawn`."""
        told, classes = self._probabilities(source, healthy), self.work.case.classes
        return {m: bootstrap(m, self._truth, told, self._weights, classes) for m in self.compared}

    def told(self, source: str) -> dict[str, Any]:
        """Confusions, rows true, summed over runs; and every prediction."""
        predicted = self._probabilities(source).argmax(axis=2)
        classes = len(self.work.case.classes)
        counts = np.sum([confusion(self._truth, run, classes) for run in predicted], axis=0)
        return {
            "confusion": counts.tolist(),
            "predictions": predicted.tolist(),
            "fault_protocol_known": True,
        }

    def arrays(self) -> dict[str, NDArray]:
        """See `Answers.arrays`."""
        names = self.work.plan.sources
        return {f"probabilities/{name}": self._probabilities(name) for name in names}


@dataclass(frozen=True)
class Simulations:
    """Test records simulated from their commands.

    `simulation/SOURCE/mean` (n, T, d) and `/bands` (n, 5, T, d), of the first run; the same of what
    was measured: `simulation/commands`, `/nominal`, `/observed` (n, T, d), NaN where not measured,
    `/ids` (n,) and `/rate` in Hz.
    """

    work: Work
    family: ClassVar[tuple[str, ...]] = ("rmse", "crps")
    compared: ClassVar[tuple[str, ...]] = (*family, "nrmse")
    curved: ClassVar[tuple[str, ...]] = ("rmse", "coverage90")

    @cached_property
    def _records(self) -> Trajectories:
        return self.work.files.real_data()[sorted(self.work.roles.tested)]

    def _runs(self, source: str, healthy: int = 0) -> list[Simulation]:
        """One of all test records for each run."""
        jobs = self.work.answers(source, healthy)
        found = []
        for run in range(self.work.plan.number_of_runs):
            paths = [self.work.files.path(job) for job in jobs if job.run == run]
            found.append(_joined([Simulation.load(path) for path in paths], self._records.ids))
        return found

    def scores(self, source: str, healthy: int = 0) -> dict[str, list[float]]:
        """See `Answers.scores`."""
        runs = [self._figures(_means(_per_sample(each))) for each in self._runs(source, healthy)]
        return {name: [float(run[name]) for run in runs] for name in runs[0]}

    def drawn(self, source: str, healthy: int = 0) -> dict[str, NDArray]:
        """See `Answers.drawn`."""
        seed = self.work.plan.seed_of("bootstrap", 0)
        runs = []
        for each in self._runs(source, healthy):
            values = _per_sample(each)
            flat = values.reshape(*values.shape[:2], -1)
            drawn = bootstrap_means(flat, draws=DRAWS, seed=seed)
            runs.append(self._figures(drawn.reshape(DRAWS, *values.shape[2:])))
        return {name: np.mean([run[name] for run in runs], axis=0) for name in runs[0]}

    def _figures(self, means: NDArray) -> dict[str, NDArray]:
        """Scores of mean (..., d, 4) squared error, CRPS, and shares inside of both bands.

        Outputs are averaged, RMSE and CRPS only where they have one unit; NRMSE is over each
        output's standard deviation.
        """
        observed = np.where(self._records.mask, self._records.observed, np.nan)
        spread = np.nanstd(observed.astype(float), axis=(0, 1))
        alike = 1.0 if self._records.outputs.comparable else np.nan
        square, crps, half, most = np.moveaxis(means, -1, 0)
        return {
            "rmse": alike * np.sqrt(square.mean(axis=-1)),
            "nrmse": (np.sqrt(square) / spread).mean(axis=-1),
            "crps": alike * crps.mean(axis=-1),
            "coverage50": half.mean(axis=-1),
            "coverage90": most.mean(axis=-1),
        }

    def told(self, source: str) -> dict[str, Any]:
        """Nothing."""
        return {}

    def arrays(self) -> dict[str, NDArray]:
        """See `Answers.arrays`."""
        found = {
            "commands": self._records.commands,
            "nominal": self._records.nominal,
            "observed": np.where(self._records.mask, self._records.observed, np.nan),
        }
        for name in self.work.plan.sources:
            first = self._runs(name)[0]
            found |= {f"{name}/mean": first.mean}
            if first.random:
                found |= {f"{name}/bands": first.bands}
        made: Mapping[str, NDArray] = {key: each.astype(np.float32) for key, each in found.items()}
        about = {"ids": self._records.ids, "rate": np.array(self._records.rate)}
        return {f"simulation/{name}": each for name, each in {**made, **about}.items()}


def _joined(parts: list[Simulation], ids: NDArray) -> Simulation:
    """Simulations of several folds as one, in the order of `ids`."""
    names = np.concatenate([part.ids for part in parts]).tolist()
    order = [names.index(name) for name in ids.tolist()]
    arrays = {
        name: np.concatenate([getattr(part, name) for part in parts])[order]
        for name in vars(parts[0])
    }
    return Simulation(**arrays)


def _per_sample(simulation: Simulation) -> NDArray:
    """Squared error, CRPS, and whether inside of both bands, (n, T, d, 4); no bands, no share."""
    error = np.square(simulation.mean - simulation.observed)
    inside = [simulation.inside(level) for level in (50, 90)]
    if not simulation.random:
        inside = [np.full_like(error, np.nan)] * 2
    return np.stack([error, simulation.crps, *inside], axis=-1)


def _means(values: NDArray) -> NDArray:
    """Of (n, T, ...) over samples, then over records; NaN where there is nothing."""
    seen = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        each = np.where(seen, values, 0.0).sum(axis=1) / seen.sum(axis=1)
    mean: NDArray = each.mean(axis=0)
    return mean
