"""`Work`: the jobs of a study, their dependencies, and how each result is made.

Each job writes one result, and is done when that exists. A study that was killed continues with
the jobs whose results are missing. Results are moved into place when they are complete, and each
job has a seed of its own, so the order of the jobs has no effect.
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
from retwin.catalog import CANDIDATES, NEEDS, SOURCES, resolve
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.diagnosis import FittedDiagnoser
from retwin.evaluation.choice import Choice, fit
from retwin.evaluation.choice.surrogates import SurrogateSettings, stand_in
from retwin.evaluation.diagnosers import finite_probabilities
from retwin.evaluation.fidelity.measure import measure_fidelity, measure_widening
from retwin.evaluation.fidelity.overlay import predictive_overlay
from retwin.evaluation.fidelity.simulation import simulate_records
from retwin.progress import Progress
from retwin.serialisation.files import write_atomically
from retwin.serialisation.models import save_model
from retwin.study.files import Files, Job, Roles, write_estimates
from retwin.study.plan import StudyPlan
from retwin.study.trial import Trial
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.twin import Twin
from retwin.update.blackbox import BLACK_BOXES, fit_black_box
from retwin.update.corrected import CorrectedTwin, generate
from retwin.update.dynamics import fit_dynamics
from retwin.update.identification import NPE, Posterior, Updated, identify
from retwin.update.residual import Density, Mixture, SequenceMixture, fit_residual
from retwin.update.surrogate import Surrogate, fit_surrogate

CURVE = (1, 2, 4, 6, 8, 12, 16, 24, 32)
"""Healthy calibration trajectories of the points of a learning curve, if there are more."""
DRAWS = 500
"""Simulations of a test record: quantiles of 5 and 95 % vary by 0.01 in their level."""

Costs = dict[str, Any]
"""What a job cost: `seconds` in all, and parts of it by name."""


@dataclass(frozen=True)
class Work:
    """The jobs of a study.

    Attributes
    ----------
    folder : Path
        Where intermediate results are written.
    case : Case
        The system.
    plan : StudyPlan
        What is compared.
    roles : Roles
        Calibration and test trajectories of each fold.

    """

    folder: Path
    case: Case
    plan: StudyPlan
    roles: Roles

    @property
    def files(self) -> Files:
        """Paths of intermediate results."""
        return Files(self.folder)

    # The graph of jobs.

    def graph(self) -> dict[Job, tuple[Job, ...]]:
        """Every job, and those whose results it needs."""
        found: dict[Job, tuple[Job, ...]] = {}
        waiting = [
            job for source in self.plan.sources for count in (0, *self.counts(source))
            for job in (*self.answers(source, count), *self.fidelity_jobs(source, count))
        ]  # fmt: skip
        waiting += self.overlay_jobs()
        while waiting:
            job = waiting.pop()
            if job not in found:
                found[job] = self.needed(job)
                waiting += found[job]
        return found

    def answers(self, source: str, healthy: int = 0) -> list[Job]:
        """The jobs that give the answers of a source; those of its members for a pooled source.

        Their kind is "diagnosis", or "simulation" where the case has no classes.

        Parameters
        ----------
        source : str
            A key of `retwin.catalog.SOURCES`.
        healthy : int
            See `Job`.

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

    def fidelity_jobs(self, source: str, healthy: int = 0) -> list[Job]:
        """The jobs that compare a source's twin with healthy test trajectories, if there are two.

        They belong to the first run: the scores show the variance between runs at less cost.
        """
        if not SOURCES[source].fidelity or (self._labels[self.roles.tested] == HEALTHY).sum() < 2:
            return []
        folds = range(len(self.roles.folds))
        return [Job("fidelity", 0, fold, source, healthy) for fold in folds]

    def overlay_jobs(self) -> list[Job]:
        """The jobs of the predictive overlay of the test trajectories, for a corrected twin.

        It is that of the last updated twin of the catalog that the plan holds.
        """
        updated = [name for name, source in SOURCES.items() if source.role == "updated"]
        corrected = [name for name in updated if name in self.plan.sources]
        if not corrected or not self.case.diagnosed:
            return []
        return [Job("portrait", 0, fold, corrected[-1]) for fold in range(len(self.roles.folds))]

    def needed(self, job: Job) -> tuple[Job, ...]:
        """The jobs whose results a job needs."""
        own = job.kind in ("diagnosis", "simulation", "fidelity", "portrait")
        needs = SOURCES[job.name].needs if own else NEEDS.get((job.kind, job.name), ())
        return tuple(job.before(*need) for need in needs)

    def counts(self, source: str) -> tuple[int, ...]:
        """Numbers of healthy trajectories at which a learning curve is evaluated, but for all."""
        if not self.plan.learning_curve or SOURCES[source].real_data != "healthy":
            return ()
        return tuple(count for count in CURVE if count < self.healthy)

    @property
    def healthy(self) -> int:
        """Least number of healthy calibration trajectories of a fold."""
        return min(int((self._labels[list(part)] == HEALTHY).sum()) for part, _ in self.roles.folds)

    @cached_property
    def _labels(self) -> NDArray:
        """Labels of all real trajectories."""
        return self.files.real_data().labels

    # The work of each job, by a method for each kind of job.

    def do(self, job: Job, progress: Progress | None = None) -> None:
        """Make the result of a job, unless it exists; record its costs, its warnings among them."""
        path = self.files.path(job)
        if path.exists():
            return
        make = getattr(self, f"_{job.kind}")
        started = time.perf_counter()
        with warnings.catch_warnings(record=True) as given:
            warnings.simplefilter("always", UserWarning)
            costs = make(self._trial(job, progress), path)
        costs["seconds"] = time.perf_counter() - started
        notes = [costs.get("notes", ""), *dict.fromkeys(str(each.message) for each in given)]
        costs["notes"] = "; ".join(filter(None, notes))
        self.files.keep_costs(job, costs)

    def sees(self, source: str) -> str:
        """The real data that a source may use in this study, a key of `SEES`."""
        declared = SOURCES[source].real_data
        return "labelled" if declared == "healthy" and self._uses_labels else declared

    @property
    def _uses_labels(self) -> bool:
        return self.plan.calibrate_on == "all"

    def _trial(self, job: Job, progress: Progress | None) -> Trial:
        fold = self.roles.folds[job.fold]
        if job.kind in ("residual", "update"):
            sees = "labelled" if self._uses_labels else "healthy"
        elif job.kind == "surrogate":
            sees = "none"
        else:
            sees = self.sees(job.name)
        if sees == "none":
            fold = ((), tuple(self.roles.tested))
        return Trial(self.files, self.case, self.plan, fold, job, sees, progress)

    def _surrogate(self, trial: Trial, path: Path) -> Costs:
        """The IBG of the twin as it is, or after the update that the job names."""
        data = self.files.twin_data()
        if trial.job.name:
            twin, seed = trial.updated(trial.job.name), trial.seed("updated twin")
            count = self.plan.generated(self.case)
            data = generate(twin, self.case, per_class=count, seed=seed)
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
        self._fitted(trial, self._calibration(trial), trial.job.name, density).residual.save(path)
        return {}

    def _update(self, trial: Trial, path: Path) -> Costs:
        """The update by Eq. 2 or Eq. 3, of the state equations, or by a model without a twin."""
        case, seed, progress = self.case, trial.seed("update"), trial.progress
        if trial.job.name in BLACK_BOXES:
            fitted = fit_black_box(trial.healthy, trial.job.name, seed=seed, progress=progress)
            fitted.twin.save(path)
            return {}
        if trial.job.name in ("dynamics", "fit"):
            equations = case.state_surrogate if trial.job.name == "dynamics" else None
            simulated = case.sampler, case.per_class, case.network, case.training
            how = SurrogateSettings("auto", *simulated, equations=equations)
            twin = case.parametric or case.twin
            # For "dynamics" it has state equations.
            base: Any = stand_in(twin, trial.healthy, how, seed=seed, progress=progress).twin
            if trial.job.name == "fit":
                settings, original = Choice.of(case), twin if isinstance(base, Surrogate) else None
                taken = fit(base, trial.healthy, settings, seed=seed, original=original)
                taken.twin.save(path)
                return {"notes": f"chosen: {CANDIDATES[taken.chosen]}"}
            made = fit_dynamics(base, trial.healthy, case.dynamics, progress=progress)
            made.twin.save(path)
            write_estimates(path, made)
            return {"notes": made.reason}
        found: Updated | Posterior
        if trial.job.name == "pi_bayes":
            found = identify(trial.parametric, trial.healthy, NPE(), **trial.updating)
            found.twin.save(path)
        else:
            found = updated = identify(trial.parametric, trial.healthy, **trial.updating)
            save_model(path, "parameters", {"values": updated.values}, {})
        # A search that was cut off is noted; one that converged is no failure.
        cut_off = [each for each in found.reason.split("; ") if "exceeded" in each]
        return {"twin_runs": found.twin_runs, "notes": "; ".join(cut_off)}

    def _diagnosis(self, trial: Trial, path: Path) -> Costs:
        """Train or make the diagnoser of a source, and predict the test trajectories."""
        source, costs = SOURCES[trial.job.name], {}
        started = time.perf_counter()
        if source.twin:
            made = trial.generate(_source_twin(trial))
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
        probabilities = finite_probabilities(diagnoser, test)
        costs["predict"] = (time.perf_counter() - trained) / len(test)
        diagnoser.save(self.files.diagnoser(trial.job))
        with write_atomically(path) as part:
            np.savez(part, tested=np.array(trial.fold[1]), probabilities=probabilities)
        return {"train": trained - started - costs.get("generate", 0.0), **costs}

    def _simulation(self, trial: Trial, path: Path) -> Costs:
        """Simulate the test records from their commands alone, with scores of each sample."""
        twin, records = _source_twin(trial), self.files.real_data()[list(trial.fold[1])]
        started = time.perf_counter()
        seed = trial.seed("simulate")
        simulate_records(twin, records, draws=DRAWS, seed=seed, progress=trial.progress).save(path)
        seconds = time.perf_counter() - started
        draws = 1 if getattr(twin, "deterministic", False) else DRAWS
        return {"generate": seconds, "trajectories": draws * len(records)}

    def _fidelity(self, trial: Trial, path: Path) -> Costs:
        """Compare the twin of a source with the healthy test trajectories of the fold."""
        healthy = self.files.real_data()[self._simulated(trial, HEALTHY)]
        if len(healthy) == 0:
            with write_atomically(path) as part:
                np.savez(part)  # an empty file marks the job as done
            return {}
        twin = _source_twin(trial)
        rivals: dict[str, Twin] = {}
        widening = None
        corrected = any(kind == "residual" for kind, _ in SOURCES[trial.job.name].needs)
        if self.plan.ablations and corrected and isinstance(twin, CorrectedTwin) and twin.random:
            rivals, widening = self._rivals(trial, twin), self._widening(trial)
        seed, rate = trial.seed("fidelity"), self.case.sensor_rate
        compared: Any = {"against": rivals, "widening": widening, "progress": trial.progress}
        measure_fidelity(twin, healthy, seed=seed, rate=rate, **compared).save(path)
        return {}

    def _portrait(self, trial: Trial, path: Path) -> Costs:
        """The predictive overlay of the fold's test trajectories, for display and no score."""
        labels = np.unique(self._labels[list(trial.fold[1])])
        shown = {i for label in labels for i in self._simulated(trial, label)}
        twin, test = _source_twin(trial), self.files.real_data()[sorted(shown)]
        assert isinstance(twin, CorrectedTwin), 'as all whose role is "updated"'
        seed, rate = trial.seed("portrait"), self.case.sensor_rate
        predictive_overlay(twin, test, seed=seed, rate=rate, progress=trial.progress).save(path)
        return {}

    def _simulated(self, trial: Trial, label: str) -> list[int]:
        """The first test trajectories of a class, as many as the plan simulates."""
        count = self.plan.simulated if label == HEALTHY else self.plan.overlaid
        return [i for i in sorted(trial.fold[1]) if self._labels[i] == label][:count]

    def _rivals(self, trial: Trial, twin: CorrectedTwin) -> dict[str, Twin]:
        """Ablations of the residual model: its mean alone, and a single Gaussian."""
        density: Density | SequenceMixture = Mixture(components=1)
        if isinstance(self.case.density, SequenceMixture):
            density = replace(self.case.density, components=1)
        single = self._refitted(trial, self._calibration(trial), density)
        return {"mean_only": replace(twin, random=False), "single_gaussian": single}

    def _widening(self, trial: Trial, *, min_healthy: int = 5) -> float | None:
        """Factor by which bands are widened, from healthy calibration trajectories held out.

        The RG is fitted to the rest of what it is fitted to for this, faulty trajectories included
        where it uses these; no test trajectory is used.

        Parameters
        ----------
        min_healthy : int, default 5
            Least number of healthy calibration trajectories of which two can be held out to widen
            bands.

        """
        if len(trial.healthy) < min_healthy:
            return None
        seed = trial.seed("widening")
        fitted_on, held_out = self._calibration(trial).split(0.6, seed=seed)
        twin = self._refitted(trial, fitted_on, self.case.density)
        healthy = held_out.with_label(HEALTHY)
        return measure_widening(twin, healthy, seed=seed, rate=self.case.sensor_rate)

    def _refitted(
        self, trial: Trial, calibration: Trajectories, density: Density | SequenceMixture
    ) -> CorrectedTwin:
        """The corrected twin of a source, its RG fitted to other data or with another density."""
        (name,) = (name for kind, name in SOURCES[trial.job.name].needs if kind == "residual")
        return self._fitted(trial, calibration, name, density)

    def _fitted(
        self, trial: Trial, calibration: Trajectories, name: str, density: Density | SequenceMixture
    ) -> CorrectedTwin:
        """A surrogate with the RG of that name, of the twin as it is or after an update."""
        faults: Mapping[str, Fault | None] = self.case.faults
        ((_, updated),) = NEEDS["residual", name]
        surrogate = trial.surrogate(updated)
        residual = fit_residual(
            surrogate,
            calibration,
            trial.correction(name),
            density,
            seed=trial.seed("residual"),
            calibrate_on=faults if self._uses_labels else "healthy",
            twin=trial.updated(updated) if updated else self.case.twin,
            progress=trial.progress,
        )
        return CorrectedTwin(surrogate, residual)

    def _calibration(self, trial: Trial) -> Trajectories:
        return trial.labelled if self._uses_labels else trial.healthy


def _source_twin(trial: Trial) -> Any:
    """The twin of the job's source."""
    return resolve(SOURCES[trial.job.name].twin)(trial)
