"""The data of a study: its files, read or simulated, with the roles of real trajectories."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from retwin.cases.case import Case
from retwin.checks import given, nothing, require
from retwin.data.io import load
from retwin.data.quality.copies import distinct_records, find_copies
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.errors import InputError
from retwin.progress import Report
from retwin.study.files import Roles
from retwin.study.plan import StudyPlan
from retwin.update.corrected import generate


@dataclass(frozen=True)
class StudyData:
    """The files of a study; see docs/theory.md, How a study scores.

    Parameters
    ----------
    twin : Path, optional
        Recorded or simulated trajectories; by default the case's twin simulates them.
    calibration, test : Path, optional
        Two real sets.
    real : Path, optional
        One real set, which is split into folds; every trajectory is tested once. Without any real
        set the case's emulator makes one, which is labelled "emulated" everywhere.
    records : Path, optional
        One file that the case itself splits into calibration and test set.
    mapping : Path, optional
        The mapping.toml of real sets that are logs; see `rt.load`.

    Raises
    ------
    InputError
        If the real data are given in two ways, or a calibration set without a test set; or a
        mapping without a set that it is for.

    """

    twin: Path | None = None
    calibration: Path | None = None
    test: Path | None = None
    real: Path | None = None
    records: Path | None = None
    mapping: Path | None = None

    def __post_init__(self) -> None:
        stated = {name for name, file in vars(self).items() if file is not None} - {"twin"}
        mapped = stated & {"calibration", "test", "real"}
        usable = self.mapping is None or mapped
        got = ", ".join(sorted(stated - {"mapping"})) or "none"
        remedy = "give --real LOG, or --calibration LOG --test LOG; or leave the mapping out"
        require(usable, "mapping", expected="real sets that are logs", got=got, remedy=remedy)
        stated -= {"mapping"}
        fits = stated in ({"calibration", "test"}, {"real"}, {"records"}, set())
        expected = "either calibration and test, or real alone, or records alone"
        remedy = "give --calibration FILE --test FILE, or --real FILE --folds K, or --data FILE"
        require(fits, "real data", expected=expected, got=", ".join(sorted(stated)), remedy=remedy)


def twin_data(case: Case, plan: StudyPlan, data: StudyData, report: Report) -> Trajectories:
    """The trajectories of the twin, read or simulated."""

    def progress(share: float) -> None:
        report("twin data", share)

    if data.twin is not None:
        return _labelled(load(data.twin, case=case, progress=progress), case, "twin-data")
    seed = plan.seed_of("twin", 0)
    return generate(case.twin, case, per_class=plan.generated(case), seed=seed, progress=progress)


def real_data(
    case: Case, plan: StudyPlan, data: StudyData, report: Report
) -> tuple[Trajectories, Roles]:
    """The real trajectories and their roles."""

    def read(path: Path) -> Trajectories:
        found = load(
            path, case=case, progress=lambda share: report(path.name, share), mapping=data.mapping
        )
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
        real = _emulate(case, plan.emulated_healthy, seed)
    else:
        got = f"none, and the case {case.name!r} has no emulator"
        remedy = "give --real FILE --folds K"
        raise InputError("real data", expected="measured trajectories", got=got, remedy=remedy)
    # Copies have no role: a fold would be tested by what the others were calibrated on.
    first = distinct_records(real.measured)
    folds = real[first].folds(plan.folds, seed=plan.seed_of("folds", 0))
    return real, Roles.of((first[fit], first[test]) for fit, test in folds)


def _emulate(case: Case, healthy: int, seed: int, *, emulated_per_class: int = 10) -> Trajectories:
    """Few runs of each fault, and so many healthy ones.

    Parameters
    ----------
    emulated_per_class : int, default 10
        Emulated trajectories per class where there are no real ones: 90 for the arm, as measured.

    """
    first, second = np.random.SeedSequence(seed).spawn(2)
    seeds = [int(each.generate_state(1)[0]) for each in (first, second)]
    emulator: Any = case.emulator
    faulty = generate(emulator, case, per_class=emulated_per_class, seed=seeds[0])
    if not case.diagnosed:
        return faulty
    faulty = faulty[faulty.labels != HEALTHY]
    only = replace(case, faults={HEALTHY: case.faults[HEALTHY]})
    return Trajectories.concatenate(
        [generate(emulator, only, per_class=healthy, seed=seeds[1]), faulty]
    )


def _records(case: Case, path: Path) -> tuple[Trajectories, Trajectories]:
    """Calibration and test set of a file that the case splits."""
    expected = "a case that declares how its file is split"
    got = f"the case {case.name!r}, which does not"
    remedy = "give --calibration FILE --test FILE, or --real FILE --folds K"
    return given("records", case.records, expected, got=got, remedy=remedy)(path)


def _in_two(calibration: Trajectories, test: Trajectories) -> tuple[Trajectories, Roles]:
    """Both sets as one, with their roles; InputError if a trajectory is in both."""
    both, count = Trajectories.concatenate([calibration, test]), len(calibration)
    ids = [*calibration.ids.tolist(), *test.ids.tolist()]
    shared = [
        f"{ids[i]}, which is {ids[j]} of the calibration"
        for i, j, _ in find_copies(both.measured)
        if j < count <= i
    ]
    expected = "measurements that are in no calibration trajectory"
    got = "; ".join(shared[:3]) + (f"; {len(shared)} in all" if len(shared) > 3 else "")
    remedy = "leave them out of one of both sets"
    require(not shared, "test", expected=expected, got=got, remedy=remedy)
    first = distinct_records(both.measured)
    return both, Roles.of([(first[first < count], first[first >= count])])


def _labelled(trajectories: Trajectories, case: Case, name: str) -> Trajectories:
    """The trajectories with labels of the case, where it has classes."""
    if not case.diagnosed:
        return trajectories.replace(labels=np.full(len(trajectories), case.classes[0]))
    unknown = set(trajectories.labels.tolist()) - set(case.classes)
    expected = f"trajectories labelled with the classes {', '.join(case.classes)}"
    remedy = "label every trajectory: labels are needed to score a study"
    nothing(name, sorted(unknown), expected, remedy=remedy)
    return trajectories
