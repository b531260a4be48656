"""Is everything here that retwin needs? What is installed, the machine, and the data it finds."""

from __future__ import annotations

import importlib
import os
import platform
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from retwin._version import __version__
from retwin.cases.animation.scene import offscreen_backend
from retwin.catalog import DOWNLOADS
from retwin.data.download import cache_folder
from retwin.errors import InputError
from retwin.serialisation.files import sha256

__all__ = ["EXTRAS", "FOR_DEVELOPERS", "Check", "State", "examine"]

State = Literal["ok", "warning", "missing", "broken"]
"""As it should be; works, but; not there and not needed by all; without it nothing works."""

EXTRAS = {
    "bayes": "Bayesian updating, the source pi_bayes",
    "flows": "normalising flows as the law of the gap",
    "fmu": "twins that are FMUs",
    "onnx": "bundles that need no torch",
    "render": "films drawn by MuJoCo, and MP4",
    "rocket": "the classifier rocket",
    "scale": "Zarr folders, and Dask",
}
"""What can be installed besides, and what for."""
FOR_DEVELOPERS = ("dev", "docs")
COMPILED = ("numpy", "scipy", "torch", "mujoco")
"""Modules that can be installed and still not load."""
DATA = (".mat", ".npz", ".csv", ".zarr")
PER_PROCESS = 2**30
"""Bytes that a study takes for each job, roughly."""
CONTROL = Path("/sys/fs/cgroup")
"""Where Linux says what a container may take."""


@dataclass(frozen=True)
class Check:
    """One thing that was looked at.

    Attributes
    ----------
    group: "installation", "extras", "machine" or "data".
    name: what it is.
    state: how it is.
    found: what was found, in words.
    remedy: what to do; "" where nothing need be done.

    """

    group: str
    name: str
    state: State
    found: str
    remedy: str = ""


def examine(progress: Callable[[str, float], None] | None = None) -> list[Check]:
    """Look at everything; takes some seconds, loads torch, and starts processes that try to draw.

    `progress` is called with what is looked at and the share that is done. Nothing is changed.
    """
    tell = progress or (lambda what, share: None)
    found: list[Check] = []
    steps = (_installation, _extras, _machine, _rendering, _data)
    for i, step in enumerate(steps):
        tell(step.__name__.strip("_"), i / len(steps))
        found += step()
    return found


# What is installed.


def _installation() -> Iterator[Check]:
    group = "installation"
    yield Check(group, "retwin", "ok", f"{__version__} in {Path(__file__).parent}")
    needed = SpecifierSet(metadata.metadata("retwin")["Requires-Python"])
    python = f"{platform.python_version()}, {sys.executable}"
    if needed.contains(platform.python_version(), prereleases=True):
        yield Check(group, "Python", "ok", python)
    else:
        yield Check(group, "Python", "broken", python, f"take Python {needed}")
    required = _requirements()
    wrong = [each for each in required if not _satisfied(each)]
    for each in wrong:
        yield Check(group, each.name, "broken", _told(each), f'pip install "{each}"')
    if not wrong:
        yield Check(group, "packages", "ok", f"all {len(required)} that are required")
    for name in COMPILED:
        yield _loaded(name)


def _loaded(name: str) -> Check:
    """Whether a module loads: compiled ones may lack a library of the system."""
    try:
        version = importlib.import_module(name).__version__
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        return Check("installation", name, "broken", reason, f"install {name} again")
    return Check("installation", name, "ok", version)


def _extras() -> Iterator[Check]:
    for extra, what_for in EXTRAS.items():
        required = _requirements(extra)
        absent = [each for each in required if not _version(each)]
        wrong = [each for each in required if not _satisfied(each)]
        state: State = "missing" if absent else "warning" if wrong else "ok"
        found = what_for if not wrong else f"{what_for}: {', '.join(map(_told, wrong))}"
        remedy = f'pip install "retwin[{extra}]"' if wrong else ""
        yield Check("extras", extra, state, found, remedy)


def _requirements(extra: str = "") -> list[Requirement]:
    """What retwin requires here, or what an extra requires besides."""
    told = map(Requirement, metadata.requires("retwin") or ())
    conditional = [(each, each.marker) for each in told]
    return [
        each
        for each, marker in conditional
        if (marker is None and not extra)
        or (
            marker is not None
            and marker.evaluate({"extra": extra})
            and (not extra or not marker.evaluate({"extra": ""}))
        )
    ]


def _satisfied(required: Requirement) -> bool:
    version = _version(required)
    return bool(version) and required.specifier.contains(version, prereleases=True)


def _version(required: Requirement) -> str:
    """The version that is installed, "" for none."""
    try:
        return metadata.version(required.name)
    except metadata.PackageNotFoundError:
        return ""


def _told(required: Requirement) -> str:
    version = _version(required)
    if not version:
        return f"{required.name} is not installed"
    return f"{required.name} is {version}, and must be {required.specifier}"


# The machine.


def _machine() -> Iterator[Check]:
    group = "machine"
    yield Check(group, "system", "ok", f"{platform.system()} {platform.release()}")
    cores = _cores()
    yield _threads(cores)
    total, free = _memory()
    if total:
        told = f"{free / 2**30:.1f} GB free of {total / 2**30:.1f}"
        if free >= PER_PROCESS * cores:
            yield Check(group, "memory", "ok", told)
        else:
            fits = max(1, free // PER_PROCESS)
            remedy = f"a study takes about 1 GB per process: give it --processes {fits}"
            yield Check(group, "memory", "warning", told, remedy)
    yield _gpu()
    room = shutil.disk_usage(Path.cwd()).free / 2**30
    if not os.access(Path.cwd(), os.W_OK):
        remedy = "go to another folder, or give --out elsewhere"
        yield Check(group, "this folder", "warning", "cannot be written", remedy)
    elif room < 1:
        remedy = "make room: a study takes some 100 MB, a large data set more"
        yield Check(group, "this folder", "warning", f"{room:.1f} GB free", remedy)
    else:
        yield Check(group, "this folder", "ok", f"{room:.0f} GB free")


def _cores() -> int:
    """Cores that this process may use, in a container too."""
    seen = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    quota, _, period = _allowed("cpu.max").partition(" ")
    cores = seen or 1
    return min(cores, max(1, int(quota) // int(period))) if quota.isdecimal() else cores


def _threads(cores: int) -> Check:
    given, machine = os.environ.get("OMP_NUM_THREADS", ""), os.cpu_count() or cores
    told = f"{cores} for this process" + (f", of {machine}" if machine != cores else "")
    if given.isdecimal() and int(given) > cores:
        remedy = f"OMP_NUM_THREADS={cores}: more threads than cores cost several times the time"
        return Check("machine", "cores", "warning", f"{told}; {given} threads", remedy)
    if machine > cores:
        remedy = f"give studies and simulations --processes {cores} or --workers {cores}"
        return Check("machine", "cores", "warning", told, remedy)
    return Check("machine", "cores", "ok", told)


def _memory() -> tuple[int, int]:
    """Bytes in all and free, in a container too; 0 where the system does not say."""
    try:
        page = os.sysconf("SC_PAGE_SIZE")
        total, free = (page * os.sysconf(f"SC_{name}_PAGES") for name in ("PHYS", "AVPHYS"))
        told = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        free = 1024 * int(told["MemAvailable"].split()[0])
    except (AttributeError, OSError, ValueError, KeyError):
        return 0, 0
    limit, used = _allowed("memory.max"), _allowed("memory.current")
    if limit.isdecimal() and used.isdecimal():
        total, free = min(total, int(limit)), min(free, int(limit) - int(used))
    return total, free


def _allowed(name: str) -> str:
    try:
        return (CONTROL / name).read_text().strip()
    except OSError:
        return ""


def _gpu() -> Check:
    try:
        import torch
    except Exception:
        return Check("machine", "GPU", "missing", "torch does not load, so it cannot be asked")
    if not torch.accelerator.is_available():
        return Check("machine", "GPU", "ok", "none that torch can use, and none is needed")
    device = torch.accelerator.current_accelerator()
    cuda = torch.cuda.is_available()
    return Check("machine", "GPU", "ok", torch.cuda.get_device_name() if cuda else str(device))


def _rendering() -> Iterator[Check]:
    try:
        found = f"MuJoCo draws without a screen by {offscreen_backend().upper()}"
    except InputError as error:
        lacking = f"films are stick figures: {error.got}"
        yield Check("machine", "rendering", "missing", lacking, error.remedy)
    else:
        yield Check("machine", "rendering", "ok", found)


# The data.


def _data() -> Iterator[Check]:
    yield _own_data(os.environ.get("RETWIN_DATA", ""))
    cache = cache_folder()
    for name, known in DOWNLOADS.items():
        file, get = cache / known.file, f"retwin data fetch {name}"
        if not file.is_file():
            yield Check("data", f"public {name}", "missing", f"not in {cache}", get)
        elif sha256(file) != known.sha256:
            yield Check("data", f"public {name}", "warning", f"{file} is another file", get)
        else:
            yield Check("data", f"public {name}", "ok", str(file))
    there = next(folder for folder in (cache, *cache.parents) if folder.exists())
    if there.is_dir() and os.access(there, os.W_OK):
        yield Check("data", "cache", "ok", str(cache))
    else:
        remedy = "set RETWIN_CACHE to a folder that can be written"
        yield Check("data", "cache", "warning", f"{cache} cannot be written", remedy)


def _own_data(named: str) -> Check:
    """What lies in the folder that RETWIN_DATA names."""
    if not named:
        found = "not set: demo and tests take an emulated robot"
        return Check("data", "RETWIN_DATA", "missing", found, "set it to a folder of real data")
    files = sorted(file for file in Path(named).glob("*/*") if file.suffix in DATA)
    if not files:
        found = f"{named}, with no data" if Path(named).is_dir() else f"{named}, no such folder"
        remedy = "set it to the folder of the data, or unset it"
        return Check("data", "RETWIN_DATA", "warning", found, remedy)
    told = ", ".join(str(file.relative_to(named)) for file in files[:4])
    more = f" and {len(files) - 4} more" if len(files) > 4 else ""
    return Check("data", "RETWIN_DATA", "ok", f"{named}: {told}{more}")
