"""Studies: sources compared over runs and folds, resumable, with one results.json.

Belongs here: the plan, the graph of jobs, access of sources to real data, and the collection of
answers. Not here: formulas of scores, and the names of sources, which `retwin.catalog` declares.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from retwin._version import __version__
from retwin.cases.case import Case
from retwin.catalog import CLASSIFIERS, SOURCES
from retwin.checks import at_least, finite, require, whole
from retwin.data.io import save
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.errors import InputError
from retwin.progress import Report
from retwin.results import Results
from retwin.serialisation.files import sha256, write_json
from retwin.serialisation.identity import identity
from retwin.serialisation.places import in_use
from retwin.study.data import StudyData, real_data, twin_data
from retwin.study.files import Files, Roles
from retwin.study.plan import StudyPlan
from retwin.study.pool import run_jobs
from retwin.study.progress import Stages, expected_seconds
from retwin.study.results import write_results
from retwin.study.sources import lacking, not_installed
from retwin.study.work import Work
from retwin.update.surrogate import MIN_TRAJECTORIES

__all__ = ["StudyData", "StudyPlan", "possible_sources", "run_study"]


def run_study(
    case: Case,
    plan: StudyPlan,
    data: StudyData,
    out: str | Path,
    *,
    processes: int | None = None,
    scheduler: str | None = None,
    report: Report | None = None,
    command: str = "",
) -> Results:
    """Run or resume a study; write `results.json` and `arrays.npz` in `out`.

    Parameters
    ----------
    case : Case
        The system.
    plan : StudyPlan
        What is compared, and the seed.
    data : StudyData
        The files.
    out : str or Path
        A folder. A second call with the same plan and data continues where the first one stopped.
        Its plan may name other sources, more runs, or a learning curve; finished results are kept.
    processes : int, optional
        Jobs at a time, one thread each, at least 1; by default one per core.
    scheduler : str, optional
        The address of a Dask scheduler, whose workers do the jobs in place of processes. `out` is
        a folder that all of them see at the same path.
    report : callable, optional
        Called with the name of the present stage and the share of the whole that is done, which
        never falls; and with a `retwin.progress.FinishedStage` when a stage is done.
    command : str
        The call of the study, for the provenance.

    Returns
    -------
    Results
        The contents of `results.json`.

    Raises
    ------
    InputError
        If data or plan do not suit the case, if `out` holds another study or another process
        works on it, if `processes` is below 1 or given beside `scheduler`, if there is no such
        scheduler, or if one of its workers does not see `out`.

    """
    cores = os.cpu_count() or 1
    workers = whole("processes", cores if processes is None else processes, at_least=1)
    fits = processes is None or scheduler is None
    expected = "none with a scheduler, which has its own"
    require(fits, "processes", expected=expected, got=processes, remedy="leave one of the two out")
    out = Path(out)
    report = report or (lambda _stage, _share: None)
    with in_use(out):
        digests = _digests(data)
        found = _identity(case, plan, digests)
        _check_free(out, found)
        _check_possible(case, plan)
        work_folder = out / "work"
        stages = Stages(report, expected_seconds(plan, workers), workers)
        if not (work_folder / "roles.json").exists():
            real, roles = real_data(case, plan, data, stages.prepare)
            roles = roles.first_of_each(real.labels, plan.calibrated)
            _check_healthy(plan, real, roles)
            twin = twin_data(case, plan, data, stages.prepare)
            remedy = "give more of them, or a larger per_class"
            at_least("twin-data", twin, MIN_TRAJECTORIES, "trajectories of the twin", remedy=remedy)
            _check_classes(case, plan, twin)
            # Nothing is written before everything is checked. A set that may not fit into memory
            # stays in Zarr, which is read in chunks. The roles mark the folder as complete.
            write_json(out / "study.json", {"retwin": __version__, **found})
            save(real, work_folder / "real.npz")
            large = data.twin is not None and (data.twin / "zarr.json").exists()
            save(twin, work_folder / ("twin.zarr" if large else "twin.npz"))
            write_json(work_folder / "roles.json", roles.folds)
        roles = Roles.of(json.loads((work_folder / "roles.json").read_text("utf-8")))
        _check_healthy(plan, Files(work_folder).real_data(), roles)
        work = Work(work_folder.resolve(), case, plan, roles)
        run_jobs(work, workers, stages, scheduler)
        stages.prepare("scores", 0.0)
        about = _about(case, plan, data, digests)
        provenance: dict[str, Any] = {"command": command, "seed": plan.seed}
        results = write_results(work, out, about=about, provenance=provenance)
        stages.finish("scores")
        return results


def _digests(data: StudyData) -> dict[str, dict[str, str]]:
    """Name and SHA-256 of every file given."""
    return {
        role: {"name": path.name, "sha256": sha256(path)}
        for role, path in vars(data).items()
        if path is not None
    }


def _identity(case: Case, plan: StudyPlan, digests: Mapping[str, Any]) -> dict[str, Any]:
    """All that determines the result of every job, as plain JSON values.

    Two studies are the same if these are equal. The case contributes all its fields, functions by
    their names. Sources, runs and learning curve add jobs but change none, so a study may grow.
    """
    additive = ("sources", "runs", "learning_curve")
    fixed = {key: value for key, value in asdict(plan).items() if key not in additive}
    system = {"name": case.name, "sha256": identity(case)}
    values = {"case": system, "plan": fixed, "data": digests}
    return json.loads(json.dumps(values))


def _check_free(out: Path, expected: Mapping[str, Any]) -> None:
    """Require that `out` is new or holds the study of this identity.

    The identity has the names of classes and functions, which differ between versions of retwin.
    """
    file = out / "study.json"
    remedy = "give another folder, or remove this one"
    if file.exists():
        try:
            present = json.loads(file.read_text("utf-8"))
        except ValueError:
            present = None
        version = present.pop("retwin", "") if isinstance(present, dict) else __version__
        if present == expected:
            return
        got = f"{out}, which holds a study with another plan or other data"
        if version != __version__:
            got = f"{out}, which holds a study begun by another version of retwin {version}".strip()
            remedy = "give a new folder, or finish the study with that version"
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        got = f"{out}, which holds other files"
    else:
        return
    raise InputError(
        "out", expected="a new folder, or the folder of the same study", got=got, remedy=remedy
    )


def _check_possible(case: Case, plan: StudyPlan) -> None:
    """Refuse, before hours of work, what the case or the classifier does not permit."""
    if plan.rate is not None:
        least, remedy = 2 * case.rate / case.sampler.steps, "give one between two samples per "
        remedy += "trajectory and the rate of the data"
        finite("rate", plan.rate, at_least=least, at_most=case.rate, unit="Hz", remedy=remedy)
    stated = plan.encoder_noise == 0 or case.encoder_noise is not None
    expected = "0 for a case that does not state how encoder noise changes its outputs"
    remedy = f"leave it out for the case {case.name!r}"
    require(stated, "encoder_noise", expected=expected, got=plan.encoder_noise, remedy=remedy)
    package = not_installed(CLASSIFIERS[plan.classifier_name].extra) if case.diagnosed else ""
    expected = f"for {plan.classifier_name!r} {package}"
    remedy = "install it, or take another classifier"
    require(not package, "classifier", expected=expected, got="no such package", remedy=remedy)
    for name in plan.sources:
        missing = lacking(name, case, plan)
        expected = f"for {name!r} {missing}"
        remedy = "leave it out, or give 'all' for those that are possible"
        require(not missing, "sources", expected=expected, got=repr(name), remedy=remedy)


def possible_sources(case: Case, plan: StudyPlan) -> tuple[str, ...]:
    """The sources that a study of a case can have.

    Parameters
    ----------
    case : Case
        The system.
    plan : StudyPlan
        Its classifier must suit the sources.

    Returns
    -------
    tuple of str
        Keys of `retwin.catalog.SOURCES` in its order.

    """
    return tuple(name for name in SOURCES if not lacking(name, case, plan))


def _about(
    case: Case, plan: StudyPlan, data: StudyData, digests: Mapping[str, dict[str, str]]
) -> dict[str, Any]:
    """Names and digests of the data, and how they are split, for the results."""
    simulated = {"name": f"simulated by {type(case.twin).__name__}", "sha256": ""}
    emulated = {"name": f"emulated by {type(case.emulator).__name__}", "sha256": ""}
    one = digests.get("records", digests.get("real", emulated))
    return {
        "twin": digests.get("twin", simulated),
        "calibration": digests.get("calibration", one),
        "test": digests.get("test", one),
        "protocol": (
            "one calibration set, one test set"
            if data.test or data.records
            else f"{plan.folds} folds: every trajectory is tested once, by models that never saw it"
        ),
    }


def _check_healthy(plan: StudyPlan, real: Trajectories, roles: Roles) -> None:
    """Require healthy trajectories in every calibration part, if a source learns from these."""
    needed = any(SOURCES[name].real_data in ("healthy", "labelled") for name in plan.sources)
    if not needed or plan.calibrate_on == "all":
        return
    for calibration, _ in roles.folds:
        fits = (real.labels[list(calibration)] == HEALTHY).any()
        expected = f"at least one trajectory labelled {HEALTHY!r} in every calibration part"
        remedy = "label healthy trajectories, give more of them, or calibrate on 'all'"
        require(fits, "calibration", expected=expected, got="none", remedy=remedy)


def _check_classes(case: Case, plan: StudyPlan, twin: Trajectories) -> None:
    """Require trajectories of the twin of every class, if a source learns the classes from them."""
    learning = [name for name in plan.sources if SOURCES[name].recorded]
    absent = [label for label in case.classes if label not in twin.known_labels]
    expected = f"trajectories of every class, from which {', '.join(learning)} would learn them"
    got = f"none of {', '.join(absent)}"
    remedy = "add them, or leave these sources out: the others need healthy trajectories only"
    require(not (learning and absent), "twin-data", expected=expected, got=got, remedy=remedy)
