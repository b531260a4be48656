"""The folder of a study: which file each job writes, the roles of the real data, estimates."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.data.io import load
from retwin.data.trajectories import Trajectories
from retwin.serialisation.files import read_json, write_json
from retwin.update.dynamics import FittedDynamics

ESTIMATES = "estimates.json"
"""In the folder of an update, per parameter: name, estimate, error, what it is most correlated
with, and how much. It is null for what is not determined."""


@dataclass(frozen=True)
class Roles:
    """Which real trajectories calibrate and which test, by index into the study's real set.

    Attributes
    ----------
    folds : tuple of (tuple of int, tuple of int)
        Indices of the calibration and of the test trajectories of each fold.

    """

    folds: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]

    @classmethod
    def of(cls, folds: Iterable[tuple[Iterable[int], Iterable[int]]]) -> Roles:
        """From any pairs (calibration, test) of indices."""
        return cls(tuple((_indices(calibration), _indices(test)) for calibration, test in folds))

    def first_of_each(self, labels: NDArray, count: int | None) -> Roles:
        """The roles with so many calibration trajectories of each class and fold; None: all."""

        def first(part: NDArray) -> list[int]:
            found = labels[part]
            return sorted(i for label in np.unique(found) for i in part[found == label][:count])

        return Roles.of((first(np.array(part, dtype=int)), test) for part, test in self.folds)

    @property
    def tested(self) -> list[int]:
        """Indices of all test trajectories, in the order of the folds."""
        return [i for _, test in self.folds for i in test]


def _indices(values: Iterable[int]) -> tuple[int, ...]:
    return tuple(int(value) for value in values)


@dataclass(frozen=True)
class Job:
    """One unit of work of a study.

    Attributes
    ----------
    kind : str
        "surrogate", "residual", "update", "diagnosis", "simulation", "fidelity" or "portrait" (a
        predictive overlay).
    run, fold : int
        Counted from 0.
    name : str
        Of a residual model, its correction; of a surrogate, the update of its twin ("" for the
        twin as it is); else the source.
    healthy : int
        Calibration trajectories of each class that are used; 0 for all.

    """

    kind: str
    run: int
    fold: int = 0
    name: str = ""
    healthy: int = 0

    def __str__(self) -> str:
        count = f"from {self.healthy}" if self.healthy else ""
        parts = [f"run {self.run + 1}", self.kind, self.name, count]
        return " ".join(part for part in parts if part)

    def before(self, kind: str, name: str) -> Job:
        """The job of that kind and name whose result this one needs."""
        if kind == "surrogate" and not name:
            return Job(kind, self.run)
        return replace(self, kind=kind, name=name)


@dataclass(frozen=True)
class Files:
    """The paths of all intermediate results below one folder."""

    folder: Path

    def path(self, job: Job) -> Path:
        """The result of a job: a model's folder, or an NPZ file."""
        if job.kind in ("diagnosis", "simulation"):
            return self._of(job, ".npz")
        arrays = ".npz" if job.kind in ("fidelity", "portrait") else ""
        return self._of(job, f".{job.kind}{arrays}")

    def diagnoser(self, job: Job) -> Path:
        """The folder of the diagnoser that a job trains."""
        return self._of(job, ".diagnoser")

    def _of(self, job: Job, suffix: str) -> Path:
        run = self.folder / f"run-{job.run}"
        if job.kind == "surrogate" and not job.name:
            return run / job.kind
        fold = run / f"fold-{job.fold}"
        return (fold / f"healthy-{job.healthy}" if job.healthy else fold) / f"{job.name}{suffix}"

    def costs(self, job: Job) -> dict[str, Any]:
        """What a job cost, see `Work.do`; empty if it was interrupted before it was recorded."""
        file = self._costs(job)
        return json.loads(file.read_text("utf-8")) if file.exists() else {}

    def keep_costs(self, job: Job, costs: Mapping[str, Any]) -> None:
        """Write the costs of a job beside its result."""
        write_json(self._costs(job), costs)

    def _costs(self, job: Job) -> Path:
        path = self.path(job)
        return path.with_name(f"{path.name}.costs.json")

    def twin_data(self) -> Trajectories:
        """The trajectories of the twin with commands, from a Zarr folder or an NPZ file."""
        (file,) = self.folder.glob("twin.*")
        return load(file)

    def real_data(self) -> Trajectories:
        """All real trajectories with commands."""
        return load(self.folder / "real.npz")


def write_estimates(folder: Path, made: FittedDynamics) -> None:
    """Write the estimates of the parameters of corrected dynamics beside the twin."""
    rows = []
    for name, value in made.parameters.items():
        other, correlation = made.strongest(name) or ("", None)
        error = made.errors[name]
        rows.append([name, value, error if np.isfinite(error) else None, other, correlation])
    write_json(folder / ESTIMATES, rows)


def read_estimates(
    folder: Path, given: Mapping[str, float], units: Mapping[str, str]
) -> dict[str, NDArray]:
    """The estimates as arrays; none of an update without parameters, or of an earlier version.

    Parameters
    ----------
    folder : Path
        That of the update.
    given, units : mapping
        The parameters' values before the update, and their units.

    Returns
    -------
    dict of str to ndarray
        `parameters` (k, 3), which are name, unit and what it is most correlated with, and
        `estimates` (k, 4): the value as given, the estimate, its error and that correlation, NaN
        for none.

    """
    rows = read_json(folder / ESTIMATES) if (folder / ESTIMATES).exists() else []
    if not rows:
        return {}
    names = [[name, units.get(name, ""), other] for name, _, _, other, _ in rows]
    values = [[given.get(name), value, error, r] for name, value, error, _, r in rows]
    return {"parameters": np.array(names), "estimates": np.array(values, dtype=np.float64)}
