"""`simulate_to`: a plan into a folder, in chunks; a job that can be killed and goes on later.

The work is done in `NAME.zarr.part`, which holds

- `plan.json`: whose work this is,
- `data`: the Zarr folder to be,
- `done/NUMBER.json`: one for every chunk that is written, with its SHA-256 and its failures,
- `commands.npy`: the commands, where the plan brings its own.

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
from retwin.data.io import check_target, save
from retwin.data.io.header import CHUNKED_NAMES, FAILED, chunked_header, restore_chunked
from retwin.data.io.zarr_folder import create_chunked, read_header, seal_chunked, write_chunk
from retwin.deploy.simulations.plan import Made, Recorded, SimulationPlan, make_chunk
from retwin.errors import InputError
from retwin.jobs import alone, each
from retwin.progress import Progress
from retwin.serialisation.files import write_atomically
from retwin.serialisation.identity import identity

__all__ = ["Simulated", "simulate_to"]

LARGEST_NPZ = 2**29
"""Bytes of numbers that an NPZ may take, which is made in memory."""


@dataclass(frozen=True)
class Simulated:
    """What `simulate_to` did.

    Attributes
    ----------
    path: where the trajectories are.
    count: how many were asked for.
    failed: index of every trajectory that could not be simulated, and the reason.

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

    A Zarr folder is made chunk by chunk, with memory for one chunk per worker. The work lies in
    `path` + ".part" until it is done. After an interruption of any kind the same call goes on there
    and repeats no chunk that was finished; of a folder that is finished already it does nothing.
    A bad input leaves nothing but what an earlier call has finished.
    The bytes depend on the plan alone. Trajectories that fail do not end the others: they are told
    in the result and in the folder's header, and left out when the folder is loaded.

    Parameters
    ----------
    path: where to write. A file `*.npz` is replaced, as by `save`; a folder is not.
    plan: what to simulate.
    workers: processes; by default one per core. With 1, or where there is one chunk, it is done in
        this process. A twin's own processes and threads are switched off where there are more.
    scheduler: address of a Dask scheduler, in place of processes here. Its workers must have
        retwin, the twin's modules, and `path` under the same name.
    progress: called with the share that is done.

    Raises
    ------
    InputError: a plan that cannot be carried out; a folder that holds another plan's work, or
        anything else; an NPZ of more than 512 MB or with workers; workers and a scheduler.
    SimulationError: all trajectories of the first chunk failed.
    RuntimeError: worker processes died again and again.

    """
    tell = progress or (lambda share: None)
    target = Path(os.path.realpath(path))
    if check_target(target) == ".npz":
        _check_small(plan, workers, scheduler)
        return _into_npz(target, plan, tell)
    if workers is not None and (workers < 1 or scheduler is not None):
        raise InputError(
            "workers",
            expected="at least 1, or none said with a scheduler, which has its own",
            got=f"{workers}, scheduler {scheduler}",
            remedy="leave workers out",
        )
    about = _about(plan)
    if target.exists():
        return _already(target, plan, about)
    earlier = _part(target).exists()
    job = _Job.begun(target, plan, about)
    try:
        job.finish(workers, scheduler, tell)
    except InputError as error:
        # The plan cannot be carried out, whatever is finished of it.
        if job.done() and earlier:
            remedy = f"{error.remedy}; what was finished earlier stays in {job.part}"
            raise InputError(
                error.argument, expected=error.expected, got=error.got, remedy=remedy
            ) from error
        _remove(job.part)
        raise
    except BaseException:
        if not job.done():
            _remove(job.part)
        raise
    return job.moved(target)


@dataclass(frozen=True, eq=False)
class _Job:
    """The work on one plan, in its folder; workers get a copy each."""

    part: Path
    plan: SimulationPlan

    @classmethod
    def begun(cls, target: Path, plan: SimulationPlan, about: dict[str, Any]) -> _Job:
        """The job in the folder next to `target`, begun now or earlier."""
        part = _part(target)
        if not part.exists():
            with write_atomically(part) as new:
                (new / "done").mkdir(parents=True)
                if isinstance(plan.commands, Recorded):
                    np.save(new / "commands.npy", plan.commands.array)
                create_chunked(new / "data", _header(plan, {}, []), plan.dtype)
                _write_json(new / "plan.json", about)
        if not (part / "plan.json").exists():
            raise InputError(
                "path",
                expected=f"{part} to be free, or to hold work that was begun",
                got="something else there",
                remedy="give another name, or remove it",
            )
        _check_same(part, json.loads((part / "plan.json").read_text("utf-8")), about)
        if isinstance(plan.commands, Recorded):
            plan = replace(plan, commands=Recorded(part / "commands.npy"))
        return cls(part, plan)

    def done(self) -> dict[int, Path]:
        """The finished chunks: number to the file that says so."""
        marks = sorted((self.part / "done").glob("*.json"))
        # A mark that was being written when its process was killed begins with a dot.
        return {int(mark.stem): mark for mark in marks if mark.stem.isdecimal()}

    def finish(self, workers: int | None, scheduler: str | None, tell: Progress) -> None:
        """Make every chunk that is missing."""
        finished = self.done()
        missing = [number for number in range(self.plan.chunks) if number not in finished]
        made = self.plan.count - sum(len(self.plan.rows(number)) for number in missing)
        count = min(workers or os.cpu_count() or 1, len(missing))
        job = self
        if count > 1 or scheduler is not None:
            job = replace(self, plan=replace(self.plan, twin=alone(self.plan.twin)))

        def inside(share: float) -> None:
            tell((made + share * min(self.plan.chunk, self.plan.count - made)) / self.plan.count)

        inside(0.0)
        if not missing:
            return
        results = each(_write, job, missing, workers=count, scheduler=scheduler, progress=inside)
        with closing(results):  # type: ignore[type-var]
            for rows in results:
                made += rows
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
    """Make one chunk and write it, then the mark that it is done; how many trajectories it has."""
    made = make_chunk(job.plan, number, progress)
    digest = write_chunk(job.part / "data", number * job.plan.chunk, made.arrays)
    mark = {"sha256": digest, "emulated": made.emulated, "failed": made.failed}
    _write_json(job.part / "done" / f"{number:08d}.json", mark)
    return len(made.arrays["labels"])


def _into_npz(target: Path, plan: SimulationPlan, tell: Progress) -> Simulated:
    """All chunks in memory, then one file."""
    chunks: list[Made] = []

    def inside(share: float) -> None:
        tell((len(chunks) + share) / plan.chunks)

    for number in range(plan.chunks):
        chunks.append(make_chunk(plan, number, inside))
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
    """Which plan it is, as JSON: what decides the bytes."""
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
    }


def _already(target: Path, plan: SimulationPlan, about: dict[str, Any]) -> Simulated:
    """The result of a plan that was finished before."""
    remedy = "give another name, or remove what is there"
    free = "a name that is free, or this plan's own finished folder"
    try:
        header = read_header(target)
    except InputError:
        header = {}
    if "plan" not in header:
        raise InputError("path", expected=free, got=f"{target}, which is neither", remedy=remedy)
    _check_same(target, header["plan"], about)
    # A kill between the last two steps leaves the rest of the work behind.
    part = _part(target)
    if (part / "plan.json").exists() and not (part / "data").exists():
        _remove(part)
    failed = {int(i): reason for i, reason in header["failed"].items()}
    return Simulated(target, plan.count, failed)


def _check_same(where: Path, theirs: dict[str, Any], mine: dict[str, Any]) -> None:
    other = sorted(name for name in mine if theirs.get(name) != mine[name])
    if other:
        raise InputError(
            "plan",
            expected=f"the plan that {where} was begun with",
            got=f"another {', '.join(other)}",
            remedy="give the same plan again, another name, or remove that folder",
        )


def _check_small(plan: SimulationPlan, workers: int | None, scheduler: str | None) -> None:
    width = len(plan.twin.inputs) + 2 * len(plan.twin.outputs)
    size = plan.count * plan.steps * width * np.dtype(plan.dtype).itemsize
    if size > LARGEST_NPZ or workers is not None or scheduler is not None:
        raise InputError(
            "path",
            expected=f"a folder *.zarr for more than {LARGEST_NPZ >> 20} MB, or with workers",
            got=f"a file *.npz for {size / 2**20:.0f} MB",
            remedy="give a name that ends in .zarr",
        )


def _part(target: Path) -> Path:
    return target.with_name(f"{target.name}.part")


def _remove(part: Path) -> None:
    """Remove the work on a plan, `plan.json` last: until then it can be seen what it is."""
    for folder in (part / "data", part / "done", part):
        shutil.rmtree(folder, ignore_errors=True)


def _write_json(path: Path, value: dict[str, Any]) -> None:
    with write_atomically(path) as part:
        part.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
