"""The answers of sources: diagnoses of test trajectories, or simulations of test records."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from retwin.catalog import SOURCES, metrics_with
from retwin.data.quality.finding import Finding
from retwin.data.trajectories import Trajectories
from retwin.diagnosis.labels import find_wrong_labels
from retwin.diagnosis.trained.pooled import pool_probabilities
from retwin.evaluation.fidelity.simulation import Simulation, record_means, simulation_scores
from retwin.scores.bootstrap import Draws, Resampling, bootstrap_means
from retwin.scores.classification import METRICS, confusion, score
from retwin.study.files import Job, read_estimates
from retwin.study.work import Work
from retwin.update.dynamics import DynamicsTwin, state_twin_of

LABEL_FREE = ("none", "timing", "healthy")
"""What sources learn of the real records that know no labels of faults."""
CURVES = 6
"""Curves of a discrepancy that the page has room for."""
RESAMPLINGS = 10_000
"""Bootstrap draws, as docs/theory.md states."""


@dataclass(frozen=True)
class Diagnoses:
    """Class probabilities of the test trajectories.

    In `arrays.npz` they are `probabilities/SOURCE` (runs, n, classes).

    Attributes
    ----------
    compared : tuple of str
        Scores by which sources are compared.
    family : tuple of str
        Scores whose p-values are adjusted together (Holm).
    curved : tuple of str
        Scores of a learning curve.
    records : int or None
        Test records of a case without classes.

    """

    work: Work
    family: ClassVar[tuple[str, ...]] = metrics_with("family", simulated=False)
    compared: ClassVar[tuple[str, ...]] = metrics_with("compared", simulated=False)
    curved: ClassVar[tuple[str, ...]] = metrics_with("selected", simulated=False)
    records: ClassVar[int | None] = None

    @cached_property
    def _tested(self) -> list[int]:
        return sorted(self.work.roles.tested)

    @cached_property
    def _truth(self) -> NDArray:
        labels = self.work.files.real_data()[self._tested].labels
        return np.array([self.work.case.classes.index(label) for label in labels])

    @cached_property
    def _resampling(self) -> Resampling:
        seed = self.work.plan.seed_of("bootstrap", 0)
        return Resampling(self._truth, self.work.case.classes, RESAMPLINGS, seed)

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
        """Each score of a source, with one value per run; `healthy` as in `Job`."""
        classes = self.work.case.classes
        runs = [score(self._truth, run, classes) for run in self._probabilities(source, healthy)]
        return {metric: [getattr(each, metric) for each in runs] for metric in METRICS}

    def drawn(self, source: str, healthy: int = 0) -> dict[str, Draws]:
        """Draws of each compared score's mean over runs; paired between sources."""
        runs = self._probabilities(source, healthy)
        return {metric: self._resampling.of(metric, runs) for metric in self.compared}

    def details(self, source: str) -> dict[str, Any]:
        """Other entries in `results.json`.

        Confusion counts, rows true, summed over runs; and the predicted class indices.
        """
        predicted = self._probabilities(source).argmax(axis=2)
        classes = len(self.work.case.classes)
        counts = np.sum([confusion(self._truth, run, classes) for run in predicted], axis=0)
        return {
            "confusion": counts.tolist(),
            "predictions": predicted.tolist(),
            "fault_protocol_known": True,
        }

    def findings(self) -> list[Finding]:
        """Labels that the best source contradicts of those that have learned no real labels."""
        free = [each for each in self.work.plan.sources if self.work.sees(each) in LABEL_FREE]
        means = [self._probabilities(each).mean(axis=0) for each in free]
        if not means:
            return []
        best = max(means, key=lambda each: np.mean(each.argmax(axis=1) == self._truth))
        ids = self.work.files.real_data().ids[self._tested].tolist()
        return list(find_wrong_labels(best, self._truth, self.work.case.classes, ids))

    def arrays(self) -> dict[str, NDArray]:
        """Arrays for `arrays.npz`."""
        names = self.work.plan.sources
        return {f"probabilities/{name}": self._probabilities(name) for name in names}


@dataclass(frozen=True)
class SimulatedRecords:
    """Test records simulated from their commands.

    `arrays.npz` holds, of the first run, `simulation/SOURCE/mean` (n, T, d) and `/bands`
    (n, 5, T, d), and of the records `simulation/commands`, `/nominal`, `/observed` (n, T, d), NaN
    where not measured, `/ids` (n,) and `/rate` in Hz. `simulation/range` (2, d_u + d) is the range
    of commands and outputs in calibration, the narrowest of the folds.

    With the source `dynamics` there are the curves of the first run and fold of what it learned,
    compared with the twin as given, at most `CURVES`: `delta/values`, `/discrepancy`, `/deviation`
    (c, K), `/range` (c, 2), and `/about` (c, 4), which are equation, variable and the units of
    `values` and `discrepancy`. `delta/parameters` (k, 3) are names and units of the estimated
    parameters, and what each is most correlated with; `delta/estimates` (k, 4) are their values as
    given, their estimates, errors and that correlation, NaN for none.
    """

    work: Work
    family: ClassVar[tuple[str, ...]] = metrics_with("family", simulated=True)
    compared: ClassVar[tuple[str, ...]] = metrics_with("compared", simulated=True)
    curved: ClassVar[tuple[str, ...]] = metrics_with("selected", simulated=True)

    @cached_property
    def _records(self) -> Trajectories:
        return self.work.files.real_data()[sorted(self.work.roles.tested)]

    @property
    def records(self) -> int | None:
        """See `Diagnoses`."""
        return len(self._records)

    def _runs(self, source: str, healthy: int = 0) -> list[Simulation]:
        """A simulation of all test records for each run."""
        jobs = self.work.answers(source, healthy)
        found = []
        for run in range(self.work.plan.number_of_runs):
            parts = [Simulation.load(self.work.files.path(job)) for job in jobs if job.run == run]
            found.append(Simulation.joined(parts, self._records.ids))
        return found

    def scores(self, source: str, healthy: int = 0) -> dict[str, list[float]]:
        """See `Diagnoses.scores`."""
        means = [record_means(each.per_sample()) for each in self._runs(source, healthy)]
        runs = [simulation_scores(each, self._records) for each in means]
        return {name: [float(run[name]) for run in runs] for name in runs[0]}

    def drawn(self, source: str, healthy: int = 0) -> dict[str, Draws]:
        """See `Diagnoses.drawn`."""
        seed = self.work.plan.seed_of("bootstrap", 0)
        runs = []
        for each in self._runs(source, healthy):
            values = each.per_sample()
            flat = values.reshape(*values.shape[:2], -1)
            means = bootstrap_means(flat, draws=RESAMPLINGS, seed=seed)
            means = means.reshape(RESAMPLINGS, *values.shape[2:])
            runs.append(simulation_scores(means, self._records))
        over_runs = {name: np.mean([run[name] for run in runs], axis=0) for name in runs[0]}
        return {name: Draws(each, each) for name, each in over_runs.items()}

    def details(self, source: str) -> dict[str, Any]:
        """Simulations have no other entries."""
        return {}

    def findings(self) -> list[Finding]:
        """Records without classes have no labels that could be wrong."""
        return []

    def arrays(self) -> dict[str, NDArray]:
        """See `Diagnoses.arrays`."""
        found = {
            "commands": self._records.commands,
            "nominal": self._records.nominal,
            "observed": self._records.measured,
        }
        for name in self.work.plan.sources:
            first = self._runs(name)[0]
            found |= {f"{name}/mean": first.mean}
            if first.random:
                found |= {f"{name}/bands": first.bands}
        made = {f"simulation/{name}": each.astype(np.float32) for name, each in found.items()}
        made["simulation/ids"] = self._records.ids
        made["simulation/rate"] = np.array(self._records.rate)
        made["simulation/range"] = self._range()
        return made | (self._curves() if "dynamics" in self.work.plan.sources else {})

    def _range(self) -> NDArray:
        """Least and greatest commands and measured outputs (2, d_u + d) of the calibration."""
        real, ends = self.work.files.real_data(), []
        for calibration, _ in self.work.roles.folds:
            own = real[list(calibration)]
            both = [own.commands, own.measured]
            flat = np.concatenate(both, axis=2).reshape(-1, sum(each.shape[2] for each in both))
            ends.append([np.fmin.reduce(flat), np.fmax.reduce(flat)])
        low, high = np.moveaxis(np.array(ends), 1, 0)
        return np.stack([low.max(axis=0), high.min(axis=0)]).astype(np.float32)

    def _curves(self) -> dict[str, NDArray]:
        """See `SimulatedRecords`; those that vary most, over the usual derivative of a state."""
        folder = self.work.files.path(Job("update", 0, 0, "dynamics"))
        twin = DynamicsTwin.load(folder)
        base, free, values = state_twin_of(self.work.case.twin)  # type: ignore[arg-type]  # checked
        given = {each.name: values[each.name] for each in base.parameters}
        states = [each.name for each in base.states]
        curves = [twin.curve(*axes, relative_to=given) for axes in twin.axes]
        sizes = [
            np.ptp(each.discrepancy[each.inside]) / twin.domain.speed[states.index(each.equation)]
            for each in curves
        ]
        shown = [curves[i] for i in np.argsort(-np.array(sizes), kind="stable")[:CURVES]]
        arrays = {
            name: np.array([getattr(each, name) for each in shown], dtype=np.float32)
            for name in ("values", "discrepancy", "deviation")
        }
        arrays["range"] = np.array([[each.low, each.high] for each in shown], dtype=np.float32)
        arrays["about"] = np.array([[c.equation, c.variable, *c.units] for c in shown])
        units = {each.name: each.unit for each in (*free, *base.parameters)}
        known = {each.name: float(each.start or 0.0) for each in free} | given
        arrays |= read_estimates(folder, known, units)
        return {f"delta/{name}": each for name, each in arrays.items()}


Answers: TypeAlias = Diagnoses | SimulatedRecords
"""Scores of every source, for each run and for each bootstrap draw of the test set."""


def answers(work: Work) -> Answers:
    """The answers of a study: diagnoses, or simulations where the case has no classes."""
    return Diagnoses(work) if work.case.diagnosed else SimulatedRecords(work)
