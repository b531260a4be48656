"""`simulate_to`: a plan into a folder, chunk by chunk; an interrupted job resumes.

The work is done in `NAME.zarr.part`, which holds

- `plan.json`: the identity of the plan,
- `data`: the Zarr folder in progress,
- `done/NUMBER.json`: for every chunk that is written, its SHA-256 and its failures,
- `commands.npy`: the commands, if the plan gives them.

When all chunks are done, `data` gets its header and becomes `NAME.zarr`.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from retwin._version import __version__
from retwin.checks import require
from retwin.data.io import check_target, save
from retwin.data.io.header import CHUNKED_NAMES, FAILED, chunked_header, restore_chunked
from retwin.data.io.zarr_folder import create_chunked, read_header, seal_chunked, write_chunk
from retwin.deploy.simulations.plan import Recorded, SimulatedChunk, SimulationPlan, simulate_chunk
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.files import write_atomically, write_json
from retwin.serialisation.identity import identity
from retwin.serialisation.places import in_use, real_path, room_for
from retwin.serialisation.sizes import Budget
from retwin.workers.jobs import alone, each

SCHEMA = 2
"""The version of the plan's identity. Digests of the first, which has no such key, differ."""
MAX_NPZ_BYTES = 2**29
"""Greatest size of an NPZ's arrays, which are held in memory."""


@dataclass(frozen=True)
class Simulated:
    """The result of `simulate_to`.

    Attributes
    ----------
    path : Path
        File or folder of the trajectories.
    count : int
        Trajectories of the plan, the failed ones included.
    failed : mapping of int to str
        Index and reason of every trajectory that could not be simulated.

    """

    path: Path
    count: int
    failed: Mapping[int, str]


def simulate_to(
    path: str | os.PathLike[str],
    plan: SimulationPlan,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Simulated:
    """Simulate a plan into `path`: a folder `*.zarr` of any size, or a small file `*.npz`.

    A Zarr folder is written chunk by chunk, with memory for one chunk per worker. The work lies in
    `path` + ".part" until it is done. After an interruption of any kind the same call resumes and
    repeats no finished chunk; for a folder that is finished it does nothing. After a bad input only
    the chunks of earlier calls remain. Trajectories that fail do not end the others: the result and
    the folder's header list them, and they are left out when the folder is loaded.

    Parameters
    ----------
    path : path
        Where to write. A file `*.npz` is replaced, as by `save`; a folder is not.
    plan : SimulationPlan
        What to simulate; it alone determines the bytes.
    workers : int, optional
        Processes; by default one per core. With 1, or for a single chunk, this process simulates.
        With more, a twin's own processes and threads are switched off.
    scheduler : str, optional
        Address of a Dask scheduler, instead of processes. Its workers need retwin, the twin's
        modules, and `path` under the same name.
    progress : callable, optional
        Called with the share that is done.

    Returns
    -------
    Simulated
        Path, number of trajectories, and failures.

    Raises
    ------
    InputError
        If the plan cannot be carried out; if the disk has no room for it, or the memory none for a
        chunk; if the folder holds another plan's work or anything else; if another process works
        on it; if an NPZ would exceed 512 MB or workers are given for it; or if both workers and a
        scheduler are given.
    SimulationError
        If all trajectories of the first chunk failed.
    RuntimeError
        If worker processes died repeatedly.

    """
    report = progress or (lambda share: None)
    target = real_path(path)
    if check_target(target) == ".npz":
        _check_small(plan, workers, scheduler)
        return _into_npz(target, plan, report)
    fits = workers is None or (workers >= 1 and scheduler is None)
    expected = "at least 1, or None with a scheduler, which has its own"
    got = f"{workers}, scheduler {scheduler}"
    require(fits, "workers", expected=expected, got=got, remedy="leave workers out")
    about = _about(plan)
    if target.exists():
        return _finished(target, plan, about)
    earlier = _part(target).exists()
    job = _Job.begun(target, plan, about)
    with room_for(job.part), in_use(job.part):
        try:
            job.finish(workers, scheduler, report)
        except BaseException as error:
            # A plan that cannot be carried out leaves only what an earlier call has finished.
            refused = isinstance(error, InputError)
            if not job.done() or (refused and not earlier):
                _remove(job.part)
            elif isinstance(error, InputError):
                stays = f"{error.remedy}; what was finished earlier stays in {job.part}"
                raise error.with_parts(remedy=stays) from error
            raise
        return job.moved(target)


@dataclass(frozen=True, eq=False)
class _Job:
    """The work on one plan, in its folder; workers get a copy each."""

    part: Path
    plan: SimulationPlan

    @classmethod
    def begun(cls, target: Path, plan: SimulationPlan, about: dict[str, Any]) -> _Job:
        """The job in the folder next to `target`, which is created or resumed."""
        part = _part(target)
        if not part.exists():
            Budget("n", disk=target.parent).take(plan.count * plan.trajectory_bytes)
            # Arrays of a chunk that are in memory together: simulated, stored and packed. Zarr
            # takes memory for a whole chunk, also where the last one is shorter.
            Budget("chunk").take(3 * plan.chunk * plan.trajectory_bytes)
            with write_atomically(part, replace=False) as new:
                (new / "done").mkdir(parents=True)
                if isinstance(plan.commands, Recorded):
                    np.save(new / "commands.npy", plan.commands.array)
                create_chunked(new / "data", _header(plan, {}, []), plan.dtype)
                write_json(new / "plan.json", about)
        expected = f"{part} to be free, or to hold an interrupted job"
        got = "something else there"
        remedy = "give another name, or remove it"
        require((part / "plan.json").exists(), "path", expected=expected, got=got, remedy=remedy)
        _check_same(part, json.loads((part / "plan.json").read_text("utf-8")), about)
        if isinstance(plan.commands, Recorded):
            plan = replace(plan, commands=Recorded(part / "commands.npy"))
        return cls(part, plan)

    def done(self) -> dict[int, Path]:
        """Number and marker file of every finished chunk."""
        marks = sorted((self.part / "done").glob("*.json"))
        # A marker that was being written when its process was killed begins with a dot.
        return {int(mark.stem): mark for mark in marks if mark.stem.isdecimal()}

    def finish(self, workers: int | None, scheduler: str | None, report: Progress) -> None:
        """Simulate and write every chunk that is missing."""
        finished = self.done()
        missing = [number for number in range(self.plan.chunks) if number not in finished]
        done = self.plan.count - sum(len(self.plan.rows(number)) for number in missing)
        count = min(workers or os.cpu_count() or 1, len(missing))
        job = self
        if count > 1 or scheduler is not None:
            job = replace(self, plan=replace(self.plan, twin=alone(self.plan.twin)))

        def inside(share: float) -> None:
            report((done + share * min(self.plan.chunk, self.plan.count - done)) / self.plan.count)

        inside(0.0)
        if not missing:
            return
        results = each(_write, job, missing, workers=count, scheduler=scheduler, progress=inside)
        with closing(results):  # type: ignore[type-var]
            for rows in results:
                done += rows
                inside(0.0)

    def moved(self, target: Path) -> Simulated:
        """Put the header on the data and move them to `target`."""
        marks = [json.loads(mark.read_text("utf-8")) for mark in self.done().values()]
        failed = {int(i): reason for mark in marks for i, reason in mark["failed"].items()}
        about = json.loads((self.part / "plan.json").read_text("utf-8"))
        digests = [mark["sha256"] for mark in marks]
        emulated = any(mark["emulated"] for mark in marks)
        header = _header(self.plan, failed, digests, emulated=emulated) | {"plan": about}
        seal_chunked(self.part / "data", header)
        os.replace(self.part / "data", target)
        _remove(self.part)
        return Simulated(target, self.plan.count, failed)


def _write(job: _Job, number: int, progress: Progress | None = None) -> int:
    """Simulate and write one chunk, then its marker; return its number of trajectories."""
    made = simulate_chunk(job.plan, number, progress)
    digest = write_chunk(job.part / "data", number * job.plan.chunk, made.arrays)
    mark = {"sha256": digest, "emulated": made.emulated, "failed": made.failed}
    write_json(job.part / "done" / f"{number:08d}.json", mark)
    return len(made.arrays["labels"])


def _into_npz(target: Path, plan: SimulationPlan, report: Progress) -> Simulated:
    """Simulate all chunks in memory, then write one file."""
    chunks: list[SimulatedChunk] = []

    def inside(share: float) -> None:
        report((len(chunks) + share) / plan.chunks)

    for number in range(plan.chunks):
        chunks.append(simulate_chunk(plan, number, inside))
    arrays = {name: np.concatenate([c.arrays[name] for c in chunks]) for name in CHUNKED_NAMES}
    failed = {i: reason for chunk in chunks for i, reason in chunk.failed.items()}
    header = _header(plan, failed, [], emulated=any(chunk.emulated for chunk in chunks))
    good = np.flatnonzero(arrays["labels"] != FAILED)
    sound = {name: array[good] for name, array in arrays.items()}
    save(restore_chunked(header, sound, good), target)
    return Simulated(target, plan.count, failed)


def _header(
    plan: SimulationPlan, failed: Mapping[int, str], digests: list[str], *, emulated: bool = False
) -> dict[str, Any]:
    return chunked_header(
        plan.empty(emulated=emulated),
        count=plan.count,
        classes=tuple(plan.faults),
        chunk=plan.chunk,
        digests=digests,
        failed=failed,
    )


def _about(plan: SimulationPlan) -> dict[str, Any]:
    """The identity of a plan as JSON values: everything that the bytes depend on."""
    recorded = plan.commands.array if isinstance(plan.commands, Recorded) else plan.commands
    return {
        "twin": {"kind": type(plan.twin).__name__, "sha256": identity(alone(plan.twin))},
        "commands": identity(recorded),
        "faults": identity(plan.faults),
        "n": plan.count,
        "seed": int(plan.seed),
        "clip": plan.clip,
        "chunk": int(plan.chunk),
        "dtype": plan.dtype,
        "retwin": __version__,
        "schema": SCHEMA,
    }


def _finished(target: Path, plan: SimulationPlan, about: dict[str, Any]) -> Simulated:
    """The result of a plan that an earlier call has finished."""
    remedy = "give another name, or remove what is there"
    free = "a name that is free, or this plan's own finished folder"
    try:
        header = read_header(target)
    except InputError:
        header = {}
    got = f"{target}, which is neither"
    require("plan" in header, "path", expected=free, got=got, remedy=remedy)
    _check_same(target, header["plan"], about)
    # A kill between the last two steps leaves the rest of the work behind.
    part = _part(target)
    if (part / "plan.json").exists() and not (part / "data").exists():
        _remove(part)
    failed = {int(i): reason for i, reason in header["failed"].items()}
    return Simulated(target, plan.count, failed)


def _check_same(where: Path, written: dict[str, Any], given: dict[str, Any]) -> None:
    """Require the same plan, by the same version, on whose names of classes the digests depend."""
    other = sorted(name for name in given if written.get(name) != given[name])
    versions = {"retwin", "schema"} & set(other)
    got = "one begun by another version of retwin" if versions else f"another {', '.join(other)}"
    remedy = "give the same plan again, another name, or remove that folder"
    if versions:
        remedy = "give another name, remove that folder, or finish it with that version"
    require(
        not other, "plan", expected=f"the plan that {where} was begun with", got=got, remedy=remedy
    )


def _check_small(plan: SimulationPlan, workers: int | None, scheduler: str | None) -> None:
    size = plan.count * plan.trajectory_bytes
    fits = size <= MAX_NPZ_BYTES and workers is None and scheduler is None
    expected = f"a folder *.zarr for more than {MAX_NPZ_BYTES >> 20} MB, or with workers"
    got = f"a file *.npz for {size / 2**20:.0f} MB"
    require(fits, "path", expected=expected, got=got, remedy="give a name that ends in .zarr")


def _part(target: Path) -> Path:
    return target.with_name(f"{target.name}.part")


def _remove(part: Path) -> None:
    """Remove the work on a plan, `plan.json` last, which identifies it until then."""
    for folder in (part / "data", part / "done", part):
        shutil.rmtree(folder, ignore_errors=True)
