"""The work of a study as jobs; each leaves one result on disk, and is done when that is there.

Killed at any moment and called again, a study goes on with the jobs that are missing. Results are
moved into place whole, and every job draws from a seed of its own, so the order does not matter.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.case import Case
from retwin.corrected import CorrectedTwin, generate
from retwin.corrections import Correction
from retwin.diagnosis import fit_diagnoser
from retwin.faults import Fault
from retwin.fidelity import Fidelity, measure_fidelity, measure_widening
from retwin.models import read_about
from retwin.residual import Mixture, ResidualModel, fit_residual
from retwin.segments import Segments
from retwin.storage import load, write_atomically
from retwin.study.plan import SOURCES, StudyPlan
from retwin.surrogate import Surrogate, fit_surrogate
from retwin.trajectories import Trajectories
from retwin.twins.protocol import HEALTHY, Progress

__all__ = ["Job", "Roles", "Work"]

ENOUGH = 5
"""Healthy calibration trajectories from which some can be kept back to widen bands."""


@dataclass(frozen=True)
class Roles:
    """Which real trajectories calibrate and which test, by index into the study's real set."""

    folds: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]

    @classmethod
    def of(cls, folds: Iterable[tuple[Iterable[int], Iterable[int]]]) -> Roles:
        """From any pairs (calibration, test) of indices."""
        return cls(tuple((_indices(calibration), _indices(test)) for calibration, test in folds))

    @property
    def tested(self) -> list[int]:
        """Every tested trajectory, in the order of the folds."""
        return [i for _, test in self.folds for i in test]


def _indices(values: Iterable[int]) -> tuple[int, ...]:
    return tuple(int(value) for value in values)


@dataclass(frozen=True)
class Job:
    """One piece of work: kind (see `Work.do`), run, fold and source."""

    kind: str
    run: int
    fold: int = 0
    source: str = ""

    @property
    def name(self) -> str:
        """For people."""
        parts = [f"run {self.run + 1}", self.kind, self.source]
        return " ".join(part for part in parts if part)


@dataclass(frozen=True)
class Work:
    """A study's folder of intermediate results, and how each is made."""

    folder: Path
    case: Case
    plan: StudyPlan
    roles: Roles

    def jobs(self) -> list[list[Job]]:
        """All jobs, in stages: those of one stage need only what earlier stages made."""
        runs = range(self.plan.number_of_runs)
        chosen = {name: SOURCES[name] for name in self.plan.sources}
        folds = range(len(self.roles.folds))
        surrogates = any(source.surrogate for source in chosen.values())
        corrected = [name for name, source in chosen.items() if source.residual]
        return [
            [Job("surrogate", run) for run in runs if surrogates],
            [
                Job("residual", run, fold, name)
                for run in runs
                for fold in folds
                for name in corrected
            ],
            [
                Job("diagnosis", run, fold, name)
                for run in runs
                for name, source in chosen.items()
                for fold in (folds if source.per_fold else (0,))
            ]
            # Of the first run: the chance in training is seen in the scores, at less cost.
            + [Job("fidelity", 0, fold, name) for name in corrected for fold in folds],
        ]

    def path(self, job: Job) -> Path:
        """Where a job's result lies."""
        if job.kind == "surrogate":
            return self.folder / f"run-{job.run}" / "surrogate"
        base = self.folder / f"run-{job.run}" / f"fold-{job.fold}"
        if job.kind == "residual":
            return base / f"{job.source}.residual"
        return base / f"{job.source}{'.fidelity' if job.kind == 'fidelity' else ''}.npz"

    def do(self, job: Job, progress: Progress | None = None) -> None:
        """Make a job's result, unless it is there."""
        if self.path(job).exists():
            return
        started = time.perf_counter()
        made = {
            "surrogate": self._surrogate,
            "residual": self._residual,
            "diagnosis": self._diagnosis,
            "fidelity": self._fidelity,
        }[job.kind](job, progress)
        timing = {"seconds": time.perf_counter() - started, **made}
        with write_atomically(self._timing(job)) as part:
            part.write_text(json.dumps(timing), encoding="utf-8")

    def timing(self, job: Job) -> dict[str, float]:
        """Seconds a job took, whole and in parts; empty if it was cut off before it could say."""
        file = self._timing(job)
        found: dict[str, float] = json.loads(file.read_text("utf-8")) if file.exists() else {}
        return found

    def _timing(self, job: Job) -> Path:
        path = self.path(job)
        return path.with_name(f"{path.stem}.timing.json")

    def twin_data(self) -> Trajectories:
        """What the twin says, with commands."""
        return load(self.folder / "twin.npz")

    def real_data(self) -> Trajectories:
        """All real trajectories, with commands."""
        return load(self.folder / "real.npz")

    def _surrogate(self, job: Job, progress: Progress | None) -> dict[str, float]:
        seed = self.plan.seed_of("surrogate", job.run)
        fit_surrogate(self.twin_data(), seed=seed, progress=progress).save(self.path(job))
        return {}

    def _residual(self, job: Job, progress: Progress | None) -> dict[str, float]:
        residual = fit_residual(
            self._fitted_surrogate(job.run),
            self.real_data()[list(self.roles.folds[job.fold][0])],
            self._correction(job.source),
            seed=self.plan.seed_of("residual", job.run, job.fold),
            calibrate_on=self._calibrate_on,
            progress=progress,
        )
        residual.save(self.path(job))
        return {}

    def _diagnosis(self, job: Job, progress: Progress | None) -> dict[str, float]:
        started = time.perf_counter()
        made = self._training_set(job)
        generated = time.perf_counter() - started
        noise = self.plan.seed_of("encoder noise in training", job.run, job.fold)
        made = self._with_encoder_noise(made, noise)
        diagnoser = fit_diagnoser(
            made,
            self.plan.network,
            seed=self.plan.seed_of("diagnoser", job.run, job.fold),
            classes=self.case.classes,
            rate=self.plan.rate or self.case.sensor_rate,
            training=self.plan.training,
            progress=progress,
        )
        per_fold = SOURCES[job.source].per_fold
        test = list(self.roles.folds[job.fold][1]) if per_fold else self.roles.tested
        # The test set's noise is the same in every run and for every source.
        real = self._with_encoder_noise(
            self.real_data(), self.plan.seed_of("encoder noise in test", 0)
        )
        probabilities = diagnoser.predict_proba(real[test])
        with write_atomically(self.path(job)) as part:
            np.savez(part, tested=np.array(test), probabilities=probabilities)
        return {"generate": generated, "trajectories": float(len(made))}

    def _fidelity(self, job: Job, progress: Progress | None) -> dict[str, float]:
        """Hold the corrected twin against the fold's healthy test trajectories."""
        calibration, test = (self.real_data()[list(part)] for part in self.roles.folds[job.fold])
        held_out = test.with_label(HEALTHY)
        if len(held_out) == 0:
            with write_atomically(self.path(job)) as part:
                np.savez(part)  # done, and nothing found
            return {}
        updated = self._updated(job)
        gaussian = self._refitted(job, calibration, components=1)
        found = measure_fidelity(
            updated,
            held_out,
            seed=self.plan.seed_of("fidelity", job.run, job.fold),
            rate=self.case.sensor_rate,
            against={"mean_only": replace(updated, random=False), "single_gaussian": gaussian},
            widening=self._widening(job, calibration),
            progress=progress,
        )
        found.save(self.path(job))
        return {}

    def _widening(self, job: Job, calibration: Trajectories) -> float | None:
        """By how much to widen bands, from healthy calibration trajectories kept back from the RG.

        The RG is fitted to the others for this; test trajectories play no part.
        """
        healthy = calibration.with_label(HEALTHY)
        if len(healthy) < ENOUGH:
            return None
        fitted, kept = healthy.split(0.6, seed=self.plan.seed_of("widening", job.run, job.fold))
        return measure_widening(
            self._refitted(job, fitted),
            kept,
            seed=self.plan.seed_of("widening", job.run, job.fold),
            rate=self.case.sensor_rate,
        )

    def _refitted(
        self, job: Job, calibration: Trajectories, *, components: int | None = None
    ) -> CorrectedTwin:
        """The corrected twin of a run and fold, its RG fitted to other data or a smaller one."""
        surrogate = self._fitted_surrogate(job.run)
        residual = fit_residual(
            surrogate,
            calibration,
            self._correction(job.source),
            Mixture() if components is None else Mixture(components=components),
            seed=self.plan.seed_of("residual", job.run, job.fold),
            calibrate_on=self._calibrate_on,
        )
        return CorrectedTwin(surrogate, residual)

    @property
    def _calibrate_on(self) -> str | Mapping[str, Fault | None]:
        """The healthy ones; or all, and what is broken in each."""
        return self.case.faults if self.plan.calibrate_on == "all" else "healthy"

    def _with_encoder_noise(self, trajectories: Trajectories, seed: int) -> Trajectories:
        if self.plan.encoder_noise == 0 or self.case.encoder_noise is None:
            return trajectories
        return self.case.encoder_noise(trajectories, self.plan.encoder_noise, seed)

    def _training_set(self, job: Job) -> Trajectories:
        """The labelled set that this source trains the diagnoser on."""
        if job.source == "dt":
            return self.twin_data()
        surrogate = self._fitted_surrogate(job.run)
        twin: Surrogate | CorrectedTwin = surrogate
        if SOURCES[job.source].residual:
            twin = self._updated(job)
        # One seed for all sources of a run: the same commands and the same faults.
        return generate(
            twin,
            self.case,
            per_class=self.plan.per_class,
            seed=self.plan.seed_of("generate", job.run, job.fold),
            timing=self._timing_of_commands(job.fold),
        )

    def _timing_of_commands(self, fold: int) -> NDArray:
        """Onsets (k, M) in the calibration set, NaN where there is none."""
        commands = self.real_data()[list(self.roles.folds[fold][0])].commands
        segments = Segments.from_commands(commands)
        return np.where(segments.valid, segments.start, np.nan)

    def _fitted_surrogate(self, run: int) -> Surrogate:
        return Surrogate.load(self.path(Job("surrogate", run)))

    def _updated(self, job: Job) -> CorrectedTwin:
        """The corrected twin of a job's source, run and fold."""
        residual = ResidualModel.load(self.path(replace(job, kind="residual")))
        return CorrectedTwin(self._fitted_surrogate(job.run), residual)

    def _correction(self, source: str) -> Correction:
        make = SOURCES[source].correction
        assert make is not None
        return make(self.case)

    def fidelity(self, source: str) -> Fidelity | None:
        """How real the source's twin is, over all folds; None when no healthy one was held out."""
        healthy = self.real_data().labels == HEALTHY
        parts = [
            Fidelity.load(self.path(Job("fidelity", 0, fold, source)))
            for fold, (_, test) in enumerate(self.roles.folds)
            if healthy[list(test)].any()
        ]
        return Fidelity.concatenate(parts) if parts else None

    def surrogate_figures(self) -> list[dict[str, float]]:
        """Errors of the surrogate on held-out twin trajectories, one entry per run."""
        figures: list[dict[str, float]] = []
        for run in range(self.plan.number_of_runs):
            path = self.path(Job("surrogate", run))
            if path.exists():
                figures.append(read_about(path, "surrogate")["fitted"]["figures"])
        return figures
