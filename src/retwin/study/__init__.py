"""Studies: sources compared over runs and folds, resumable, with one results.json.

Belongs here: the plan, the graph of jobs, what a source may see, and how answers are collected.
Not here: formulas of scores, and sources' names, which stand in `retwin.catalog`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from retwin.cases.case import Case
from retwin.catalog import SOURCES
from retwin.data.io import load, save
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.errors import InputError
from retwin.serialisation.files import sha256, write_atomically
from retwin.serialisation.identity import identity
from retwin.study.files import Files, Roles
from retwin.study.plan import StudyPlan
from retwin.study.pool import run_jobs
from retwin.study.results import write_results
from retwin.study.sources import lacking
from retwin.study.work import Work
from retwin.update.corrected import generate
from retwin.update.surrogate import MIN_TRAJECTORIES

__all__ = ["StudyData", "StudyPlan", "possible_sources", "run_study"]

Report = Callable[[str, float], None]
"""Called with what is going on and the share that is done."""

EMULATED_PER_CLASS = 10


@dataclass(frozen=True)
class StudyData:
    """Where a study's data are; see docs/theory.md, How a study scores.

    Parameters
    ----------
    twin: recorded or simulated trajectories; None simulates them with the case's twin.
    calibration, test: two real sets.
    real: one real set, split into folds; every trajectory is tested once. Without any real set the
        case's emulator makes one, which is labelled "emulated" everywhere.
    records: one file that the case itself splits into what calibrates and what tests.

    """

    twin: Path | None = None
    calibration: Path | None = None
    test: Path | None = None
    real: Path | None = None
    records: Path | None = None

    def __post_init__(self) -> None:
        given = {name for name, file in vars(self).items() if file is not None} - {"twin"}
        if given not in ({"calibration", "test"}, {"real"}, {"records"}, set()):
            raise InputError(
                "real data",
                expected="either calibration and test, or real alone, or records alone",
                got=", ".join(sorted(given)),
                remedy="give --calibration FILE --test FILE, or --real FILE --folds K, "
                "or --data FILE",
            )


def run_study(
    case: Case,
    plan: StudyPlan,
    data: StudyData,
    out: str | Path,
    *,
    processes: int | None = None,
    report: Report | None = None,
    command: str = "",
) -> dict[str, Any]:
    """Run or resume a study; writes `results.json` and `arrays.npz` in `out`, returns the former.

    Parameters
    ----------
    case: the system.
    plan: what is compared, and the seed.
    data: where the data are.
    out: folder; a second call with the same plan and data goes on where the first one stopped. It
        may ask for other sources, more runs, or a learning curve: what is there is kept.
    processes: jobs at a time, one thread each; by default one per core.
    report: told what is going on.
    command: how the study was called, for the record.

    Raises
    ------
    InputError: bad data; or `out` holds another study.

    """
    out = Path(out)
    tell = report or (lambda _text, _share: None)
    ours = _identity(case, plan, _digests(data))
    _check_free(out, ours)
    _check_possible(case, plan)
    work_folder = out / "work"
    if not (work_folder / "roles.json").exists():
        _prepare(case, plan, data, out, ours, tell)
    roles = Roles.of(json.loads((work_folder / "roles.json").read_text("utf-8")))
    _check_healthy(plan, Files(work_folder).real_data(), roles)
    work = Work(work_folder, case, plan, roles)
    run_jobs(work, processes or os.cpu_count() or 1, tell)
    tell("scores", 1.0)
    provenance = {"command": command, "seed": plan.seed}
    return write_results(
        work, out, about=_about(case, plan, data, ours["data"]), provenance=provenance
    )


def _digests(data: StudyData) -> dict[str, dict[str, str]]:
    """Name and SHA-256 of every file given."""
    return {
        role: {"name": path.name, "sha256": sha256(path)}
        for role, path in vars(data).items()
        if path is not None
    }


def _identity(case: Case, plan: StudyPlan, digests: Mapping[str, Any]) -> dict[str, Any]:
    """What decides the result of every job, as plain JSON values.

    Two studies are the same if it is. The case counts with all it holds, functions by their names.
    Which sources and how many runs there are decides none of
    them, so a study may grow.
    """
    grows = ("sources", "runs", "learning_curve")
    fixed = {key: value for key, value in asdict(plan).items() if key not in grows}
    known = {"name": case.name, "sha256": identity(case)}
    told = {"case": known, "plan": fixed, "data": digests}
    plain: dict[str, Any] = json.loads(json.dumps(told))
    return plain


def _check_free(out: Path, ours: Mapping[str, Any]) -> None:
    """Make sure that `out` is new or holds this very study."""
    file = out / "study.json"
    if file.exists():
        try:
            theirs = json.loads(file.read_text("utf-8"))
        except ValueError:
            theirs = None
        if theirs == ours:
            return
        got = f"{out}, which holds a study with another plan or other data"
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        got = f"{out}, which holds other files"
    else:
        return
    raise InputError(
        "out",
        expected="a new folder, or the folder of this very study",
        got=got,
        remedy="give another folder, or remove this one",
    )


def _check_possible(case: Case, plan: StudyPlan) -> None:
    """Find out before hours of work what cannot be done."""
    if plan.encoder_noise and case.encoder_noise is None:
        raise InputError(
            "encoder_noise",
            expected="0 for a case that cannot tell what a joint's reading does to its outputs",
            got=repr(plan.encoder_noise),
            remedy=f"leave it out for the case {case.name!r}",
        )
    for name in plan.sources:
        missing = lacking(name, case, plan)
        if missing:
            raise InputError(
                "sources",
                expected=f"for {name!r} {missing}",
                got=f"{name!r}",
                remedy="leave it out, or say 'all' for those that are possible",
            )


def possible_sources(case: Case, plan: StudyPlan) -> tuple[str, ...]:
    """Every source that a study of this case and with this classifier can have, in order."""
    return tuple(name for name in SOURCES if not lacking(name, case, plan))


def _prepare(
    case: Case, plan: StudyPlan, data: StudyData, out: Path, ours: Mapping[str, Any], tell: Report
) -> None:
    """Read all data, then put them, with commands, where the jobs find them; decide the roles.

    Nothing is written before everything is read and found good. The roles come last: where they
    are, all is.
    """
    real, roles = _real(case, plan, data, tell)
    _check_healthy(plan, real, roles)
    twin = _twin(case, plan, data, tell)
    if len(twin) < MIN_TRAJECTORIES:
        raise InputError(
            "twin-data",
            expected=f"at least {MIN_TRAJECTORIES} trajectories of the twin",
            got=f"{len(twin)}",
            remedy="give more of them, or a larger per_class",
        )
    with write_atomically(out / "study.json") as part:
        part.write_text(json.dumps(ours, indent=1), encoding="utf-8")
    save(real, out / "work" / "real.npz")
    # What may not fit into memory stays in the format that is read without.
    large = data.twin is not None and (data.twin / "zarr.json").exists()
    save(twin, out / "work" / ("twin.zarr" if large else "twin.npz"))
    with write_atomically(out / "work" / "roles.json") as part:
        part.write_text(json.dumps(roles.folds), encoding="utf-8")


def _about(
    case: Case, plan: StudyPlan, data: StudyData, digests: Mapping[str, dict[str, str]]
) -> dict[str, Any]:
    """The data in words, for the results."""
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
    """Every calibration part must have what the residual model is calibrated on."""
    needed = any(SOURCES[name].real_data in ("healthy", "labelled") for name in plan.sources)
    if not needed or plan.calibrate_on == "all":
        return
    for calibration, _ in roles.folds:
        if not (real.labels[list(calibration)] == HEALTHY).any():
            raise InputError(
                "calibration",
                expected=f"at least one trajectory labelled {HEALTHY!r} in every calibration part",
                got="none",
                remedy="label healthy trajectories, give more of them, or calibrate on 'all'",
            )


def _twin(case: Case, plan: StudyPlan, data: StudyData, tell: Report) -> Trajectories:
    def progress(share: float) -> None:
        tell("twin data", share)

    if data.twin is not None:
        return _labelled(load(data.twin, case=case, progress=progress), case, "twin-data")
    seed = plan.seed_of("twin", 0)
    return generate(case.twin, case, per_class=plan.generated(case), seed=seed, progress=progress)


def _real(case: Case, plan: StudyPlan, data: StudyData, tell: Report) -> tuple[Trajectories, Roles]:
    def read(path: Path) -> Trajectories:
        found = load(path, case=case, progress=lambda share: tell(path.name, share))
        return _labelled(found, case, path.name)

    if data.records is not None:
        calibration, test = _records(case, data.records)
        name = data.records.name
        return _in_two(_labelled(calibration, case, name), _labelled(test, case, name))
    if data.calibration is not None and data.test is not None:
        return _in_two(read(data.calibration), read(data.test))
    if data.real is not None:
        real = read(data.real)
    elif case.emulator is not None:
        seed = plan.seed_of("emulated", 0)
        real = generate(case.emulator, case, per_class=EMULATED_PER_CLASS, seed=seed)
    else:
        raise InputError(
            "real data",
            expected="measured trajectories",
            got=f"none, and the case {case.name!r} has no emulator",
            remedy="give --real FILE --folds K",
        )
    return real, Roles.of(real.folds(plan.folds, seed=plan.seed_of("folds", 0)))


def _records(case: Case, path: Path) -> tuple[Trajectories, Trajectories]:
    if case.records is None:
        raise InputError(
            "records",
            expected="a case that says how its file is split",
            got=f"the case {case.name!r}, which does not",
            remedy="give --calibration FILE --test FILE, or --real FILE --folds K",
        )
    return case.records(path)


def _in_two(calibration: Trajectories, test: Trajectories) -> tuple[Trajectories, Roles]:
    """Both as one set, with their roles."""
    both = Trajectories.concatenate([calibration, test])
    return both, Roles.of([(range(len(calibration)), range(len(calibration), len(both)))])


def _labelled(trajectories: Trajectories, case: Case, name: str) -> Trajectories:
    if not case.diagnosed:
        return trajectories.replace(labels=np.full(len(trajectories), case.classes[0]))
    unknown = set(trajectories.labels.tolist()) - set(case.classes)
    if unknown:
        raise InputError(
            name,
            expected=f"trajectories labelled with the classes {', '.join(case.classes)}",
            got=f"{sorted(unknown)}",
            remedy="label every trajectory; a study scores against labels",
        )
    return trajectories
