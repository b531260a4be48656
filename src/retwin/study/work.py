"""The work of a study as jobs; each leaves one result on disk, and is done when that is there.

Killed at any moment and called again, a study goes on with the jobs that are missing. Results are
moved into place whole, and every job draws from a seed of its own, so the order does not matter.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.cases.case import Case
from retwin.catalog import SOURCES, resolve
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.diagnosis import FittedDiagnoser
from retwin.evaluation.fidelity import (
    measure_fidelity,
    measure_widening,
    predictive_overlay,
    simulate_records,
)
from retwin.progress import Progress
from retwin.serialisation.files import write_atomically
from retwin.serialisation.models import write_model
from retwin.study.files import Files, Job, Roles
from retwin.study.plan import StudyPlan
from retwin.study.sources import NEEDS
from retwin.study.trial import Trial
from retwin.twins.faults import Fault
from retwin.twins.twin import Twin
from retwin.update.corrected import CorrectedTwin, generate
from retwin.update.identification import NPE, Posterior, Updated, identify, identify_bayes
from retwin.update.residual import Density, Mixture, Residual, SequenceMixture, fit_residual
from retwin.update.surrogate import Surrogate, fit_surrogate

__all__ = ["Work"]

ENOUGH = 5
"""Healthy calibration trajectories from which some can be kept back to widen bands."""
CURVE = (1, 2, 4, 6, 8, 12, 16, 24, 32)
"""Healthy calibration trajectories of a learning curve, as far as there are more."""

PORTRAYED = ("ibg_rg_command", "ibg_rg")
"""Sources whose twin stands beside every test trajectory; the first that is there."""
DRAWS = 500
"""Simulations of a test record."""

Costs = dict[str, Any]


@dataclass(frozen=True)
class Work:
    """A study's folder of intermediate results, and how each is made."""

    folder: Path
    case: Case
    plan: StudyPlan
    roles: Roles

    @property
    def files(self) -> Files:
        """Where results lie."""
        return Files(self.folder)

    # Which jobs there are.

    def graph(self) -> dict[Job, tuple[Job, ...]]:
        """Every job, and those that must be done before it."""
        found: dict[Job, tuple[Job, ...]] = {}
        waiting = [
            job for source in self.plan.sources for count in (0, *self.counts(source))
            for job in (*self.answers(source, count), *self.judgements(source, count))
        ]  # fmt: skip
        waiting += self.portraits()
        while waiting:
            job = waiting.pop()
            if job not in found:
                found[job] = self.needed(job)
                waiting += found[job]
        return found

    def answers(self, source: str, healthy: int = 0) -> list[Job]:
        """The jobs whose answers are a source's; a pooled source has those of its members.

        Diagnoses of test trajectories; where there are no classes, simulations of them.
        """
        made = SOURCES[source]
        if made.pool:
            return [job for member in made.pool for job in self.answers(member, healthy)]
        folds = range(len(self.roles.folds)) if made.per_fold else (0,)
        kind = "diagnosis" if self.case.diagnosed else "simulation"
        return [
            Job(kind, run, fold, source, healthy)
            for run in range(self.plan.number_of_runs)
            for fold in folds
        ]

    def judgements(self, source: str, healthy: int = 0) -> list[Job]:
        """The jobs that tell how real a source's trajectories are, if there are some to compare.

        Of the first run: the chance in training is seen in the scores, at less cost.
        """
        if not SOURCES[source].fidelity or (self._labels[self.roles.tested] == HEALTHY).sum() < 2:
            return []
        folds = range(len(self.roles.folds))
        return [Job("fidelity", 0, fold, source, healthy) for fold in folds]

    def portraits(self) -> list[Job]:
        """Jobs that draw every test trajectory over the predictions of the most corrected twin."""
        corrected = [name for name in PORTRAYED if name in self.plan.sources]
        if not corrected or not self.case.diagnosed:
            return []
        return [Job("portrait", 0, fold, corrected[0]) for fold in range(len(self.roles.folds))]

    def needed(self, job: Job) -> tuple[Job, ...]:
        """What must be done before a job."""
        own = job.kind in ("diagnosis", "simulation", "fidelity", "portrait")
        needs = SOURCES[job.name].needs if own else NEEDS.get((job.kind, job.name), ())
        return tuple(job.before(*need) for need in needs)

    def counts(self, source: str) -> tuple[int, ...]:
        """Numbers of healthy calibration trajectories of a source's learning curve, but all."""
        if not self.plan.learning_curve or SOURCES[source].real_data != "healthy":
            return ()
        return tuple(count for count in CURVE if count < self.healthy)

    @property
    def healthy(self) -> int:
        """Healthy calibration trajectories in the fold that has the fewest."""
        return min(int((self._labels[list(part)] == HEALTHY).sum()) for part, _ in self.roles.folds)

    @cached_property
    def _labels(self) -> NDArray:
        """Of all real trajectories."""
        return self.files.real_data().labels

    # How each is done.

    def do(self, job: Job, progress: Progress | None = None) -> None:
        """Make a job's result, unless it is there."""
        path = self.files.path(job)
        if path.exists():
            return
        make = {
            "surrogate": self._surrogate,
            "residual": self._residual,
            "update": self._update,
            "diagnosis": self._diagnosis,
            "simulation": self._simulation,
            "fidelity": self._fidelity,
            "portrait": self._portrait,
        }[job.kind]
        started = time.perf_counter()
        costs = make(self._trial(job, progress), path)
        self.files.keep_costs(job, {"seconds": time.perf_counter() - started, **costs})

    def sees(self, source: str) -> str:
        """Which real data a source may see, in this study."""
        declared = SOURCES[source].real_data
        return "labelled" if declared == "healthy" and self._labels_serve else declared

    @property
    def _labels_serve(self) -> bool:
        return self.plan.calibrate_on == "all"

    def _trial(self, job: Job, progress: Progress | None) -> Trial:
        fold = self.roles.folds[job.fold]
        if job.kind in ("residual", "update"):
            sees = "labelled" if self._labels_serve else "healthy"
        elif job.kind == "surrogate":
            sees = "none"
        else:
            sees = self.sees(job.name)
        if sees == "none":
            fold = ((), tuple(self.roles.tested))
        return Trial(self.files, self.case, self.plan, fold, job, sees, progress)

    def _surrogate(self, trial: Trial, path: Path) -> Costs:
        """The IBG of the twin as it is, or of the one whose parameters were updated."""
        data = self.files.twin_data()
        if trial.job.name:
            twin, seed = trial.updated(trial.job.name), trial.seed("updated twin")
            size = self.plan.generated(self.case)
            data = generate(twin, self.case, per_class=size, seed=seed)
        fit_surrogate(
            data,
            self.case.network,
            seed=trial.seed("surrogate"),
            training=self.case.training,
            progress=trial.progress,
        ).save(path)
        return {"twin_runs": len(data)}

    def _residual(self, trial: Trial, path: Path) -> Costs:
        density = self.case.density
        self._fitted(trial, self._calibration(trial), trial.job.name, density).save(path)
        return {}

    def _update(self, trial: Trial, path: Path) -> Costs:
        """Eq. 2 or Eq. 3; what they warn of is kept with the costs."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            least = trial.job.name == "pi_ls"
            found = _least_squares(trial, path) if least else _bayes(trial, path)
        return {"twin_runs": found.twin_runs, "notes": found.reason}

    def _diagnosis(self, trial: Trial, path: Path) -> Costs:
        source, costs = SOURCES[trial.job.name], {}
        started = time.perf_counter()
        if source.twin:
            made = trial.generate(resolve(source.twin)(trial))
            costs = {"generate": time.perf_counter() - started, "trajectories": len(made)}
            if not source.needs or source.parametric:
                costs["twin_runs"] = len(made)
            diagnoser: FittedDiagnoser = trial.train(made)
        else:
            diagnoser = resolve(source.diagnoser)(trial)
            if not source.needs:
                costs["twin_runs"] = len(trial.twin_data)
        trained = time.perf_counter()
        test = trial.tested()
        probabilities = diagnoser.predict_proba(test)
        costs["predict"] = (time.perf_counter() - trained) / len(test)
        diagnoser.save(self.files.diagnoser(trial.job))
        with write_atomically(path) as part:
            np.savez(part, tested=np.array(trial.fold[1]), probabilities=probabilities)
        return {"train": trained - started - costs.get("generate", 0.0), **costs}

    def _simulation(self, trial: Trial, path: Path) -> Costs:
        """Simulate the test records from their commands alone, and score that sample by sample."""
        make = resolve(SOURCES[trial.job.name].twin)
        twin, records = make(trial), self.files.real_data()[list(trial.fold[1])]
        started = time.perf_counter()
        seed = trial.seed("simulate")
        simulate_records(twin, records, draws=DRAWS, seed=seed, progress=trial.progress).save(path)
        seconds = time.perf_counter() - started
        return {"generate": seconds, "trajectories": DRAWS * len(records)}

    def _fidelity(self, trial: Trial, path: Path) -> Costs:
        """Hold a source's twin against the fold's healthy test trajectories."""
        held_out = self.files.real_data()[list(trial.fold[1])].with_label(HEALTHY)
        if len(held_out) == 0:
            with write_atomically(path) as part:
                np.savez(part)  # done, and nothing found
            return {}
        make = resolve(SOURCES[trial.job.name].twin)
        twin = make(trial)
        rivals: dict[str, Twin] = {}
        widening = None
        if isinstance(twin, CorrectedTwin) and twin.random:
            rivals, widening = self._rivals(trial, twin), self._widening(trial)
        found = measure_fidelity(
            twin,
            held_out,
            seed=trial.seed("fidelity"),
            rate=self.case.sensor_rate,
            against=rivals,
            widening=widening,
            progress=trial.progress,
        )
        found.save(path)
        return {}

    def _portrait(self, trial: Trial, path: Path) -> Costs:
        """For the eye, and for no score: the fold's test trajectories beside a healthy twin."""
        make = resolve(SOURCES[trial.job.name].twin)
        twin, test = make(trial), self.files.real_data()[list(trial.fold[1])]
        assert isinstance(twin, CorrectedTwin), "as all in PORTRAYED"
        seed, rate = trial.seed("portrait"), self.case.sensor_rate
        predictive_overlay(twin, test, seed=seed, rate=rate, progress=trial.progress).save(path)
        return {}

    def _rivals(self, trial: Trial, twin: CorrectedTwin) -> dict[str, Twin]:
        """What the residual model's shape is worth: its mean alone, and a single Gaussian."""
        one: Density | SequenceMixture = Mixture(components=1)
        if isinstance(self.case.density, SequenceMixture):
            one = replace(self.case.density, components=1)
        single = self._refitted(trial, self._calibration(trial), one)
        return {"mean_only": replace(twin, random=False), "single_gaussian": single}

    def _widening(self, trial: Trial) -> float | None:
        """By how much to widen bands, from healthy calibration trajectories kept back from the RG.

        The RG is fitted to the others for this; test trajectories play no part.
        """
        healthy = trial.healthy
        if len(healthy) < ENOUGH:
            return None
        seed = trial.seed("widening")
        fitted, kept = healthy.split(0.6, seed=seed)
        twin = self._refitted(trial, fitted, self.case.density)
        return measure_widening(twin, kept, seed=seed, rate=self.case.sensor_rate)

    def _refitted(
        self, trial: Trial, calibration: Trajectories, density: Density | SequenceMixture
    ) -> CorrectedTwin:
        """The corrected twin of a source, its RG fitted to other data or another shape."""
        (name,) = (name for kind, name in SOURCES[trial.job.name].needs if kind == "residual")
        residual = self._fitted(trial, calibration, name, density)
        return CorrectedTwin(self._base(trial, name), residual)

    def _base(self, trial: Trial, residual: str) -> Surrogate:
        """The surrogate that the residual model of that name corrects."""
        ((_, name),) = NEEDS["residual", residual]
        return trial.surrogate(name)

    def _fitted(
        self,
        trial: Trial,
        calibration: Trajectories,
        name: str,
        density: Density | SequenceMixture,
    ) -> Residual:
        faults: Mapping[str, Fault | None] = self.case.faults
        return fit_residual(
            self._base(trial, name),
            calibration,
            trial.correction(name),
            density,
            seed=trial.seed("residual"),
            calibrate_on=faults if self._labels_serve else "healthy",
            progress=trial.progress,
        )

    def _calibration(self, trial: Trial) -> Trajectories:
        return trial.labelled if self._labels_serve else trial.healthy


def _least_squares(trial: Trial, path: Path) -> Updated:
    found = identify(trial.parametric, trial.healthy, **trial.updating)
    with write_model(path, "parameters", {"values": found.values}, {}):
        pass
    return found


def _bayes(trial: Trial, path: Path) -> Posterior:
    found = identify_bayes(trial.parametric, trial.healthy, method=NPE(), **trial.updating)
    found.twin.save(path)
    return found
