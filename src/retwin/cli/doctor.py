"""`retwin doctor`: which packages, resources and data of this machine retwin finds.

By default nothing heavy is imported: versions come from the packages' metadata. With `--deep` each
compiled package is imported in a process of its own, where a missing library of the system cannot
end this one.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Literal

import typer
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from retwin._version import __version__
from retwin.catalog import DOWNLOADS, EXTRAS
from retwin.cli.options import Json
from retwin.cli.terminal import FAILED, answer, bar, plain
from retwin.data.download import cache_folder
from retwin.errors import InputError
from retwin.serialisation.files import sha256
from retwin.serialisation.sizes import container, memory

State = Literal["ok", "warning", "missing", "broken"]
"""As it should be; works with a drawback; absent and optional; absent and required."""
COLOURS = {"ok": "green", "warning": "yellow", "missing": "cyan", "broken": "bold red"}

FOR_DEVELOPERS = ("dev", "docs")
"""Extras that users do not need."""
COMPILED = {"numpy": "numpy", "scipy": "scipy", "torch": "torch", "mujoco": "mujoco-core"}
"""Module and package of compiled libraries, which can be installed and still fail to load."""
IMPORT_TIMEOUT = 120.0
"""Seconds after which the import of a package is taken to hang; torch takes 4 on two cores."""
DATA = (".mat", ".npz", ".csv", ".zarr")
"""Suffixes of data files."""
BYTES_PER_PROCESS = 2**30
"""Memory that one process of a study takes, as measured for the arm."""


@dataclass(frozen=True)
class Check:
    """The result of one check.

    Attributes
    ----------
    group : {"installation", "extras", "machine", "data"}
        Section of the output.
    name : str
        What was checked.
    state : {"ok", "warning", "missing", "broken"}
        Its state, see `State`.
    found : str
        What was found, in words.
    remedy : str
        What to do; "" if nothing is needed.

    """

    group: str
    name: str
    state: State
    found: str
    remedy: str = ""


def doctor(
    deep: Annotated[
        bool,
        typer.Option("--deep", help="Also load torch and others, which takes seconds."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Check installation, machine and data, and name what is missing."""
    with bar("doctor") as show:
        checks = examine(show, deep=deep)
    broken = any(check.state == "broken" for check in checks)
    answer({"ok": not broken, "checks": checks}, _shown(checks), as_json=as_json)
    if broken:
        raise typer.Exit(FAILED)


def examine(
    progress: Callable[[str, float], None] | None = None, *, deep: bool = False
) -> list[Check]:
    """Run all checks; nothing is changed.

    Parameters
    ----------
    progress : callable, optional
        Called with the name of a group of checks and the share that is done.
    deep : bool
        Whether compiled packages are imported, each in a process of its own.

    Returns
    -------
    list of Check
        Results in the order of the output.

    """
    show = progress or (lambda what, share: None)
    found: list[Check] = []
    steps: dict[str, Callable[[], Iterator[Check]]] = {
        "installation": lambda: _installation(deep),
        "extras": _extras,
        "machine": lambda: _machine(deep),
        "rendering": _rendering,
        "data": _data,
    }
    for i, (name, step) in enumerate(steps.items()):
        show(name, i / len(steps))
        found += step()
    return found


def _shown(checks: list[Check]) -> RenderableType:
    parts: list[RenderableType] = []
    for group, members in groupby(checks, attrgetter("group")):
        grid = Table.grid(padding=(0, 2))
        grid.add_column(min_width=7)
        grid.add_column(min_width=12)
        grid.add_column(overflow="fold")
        for each in members:
            found = plain(each.found)
            if each.remedy:
                found = Text.assemble(found, "\n", ("→", "dim"), " ", plain(each.remedy))
            grid.add_row(Text(each.state, COLOURS[each.state]), plain(each.name), found)
        parts += [f"[bold]{group}[/]", grid, ""]
    return Group(*parts, _summary(checks))


def _summary(checks: list[Check]) -> str:
    counts = Counter(check.state for check in checks)
    if counts["broken"]:
        return f"[bold red]{counts['broken']} broken[/]: retwin cannot work like this."
    text = "[green]retwin works on this machine.[/]"
    absent = [each.name for each in checks if each.state == "missing"]
    if absent:
        text += f" Not found, and optional: {', '.join(absent)}."
    if counts["warning"]:
        text += f" [yellow]{counts['warning']} warning{'s' * (counts['warning'] > 1)}[/] above."
    return text


def _installation(deep: bool) -> Iterator[Check]:
    group = "installation"
    yield Check(group, "retwin", "ok", f"{__version__} in {Path(__file__).parents[1]}")
    needed = SpecifierSet(metadata.metadata("retwin")["Requires-Python"])
    python = f"{platform.python_version()}, {sys.executable}"
    if needed.contains(platform.python_version(), prereleases=True):
        yield Check(group, "Python", "ok", python)
    else:
        yield Check(group, "Python", "broken", python, f"take Python {needed}")
    required = _requirements()
    wrong = [each for each in required if not _satisfied(each)]
    for each in wrong:
        yield Check(group, each.name, "broken", _mismatch(each), f'pip install "{each}"')
    if not wrong:
        yield Check(group, "packages", "ok", f"all {len(required)} that are required")
    for module, package in COMPILED.items():
        version = _version(package)
        if version:  # else it is among the wrong ones
            yield _loaded(module) if deep else Check(group, module, "ok", f"{version}, not loaded")


def _loaded(module: str) -> Check:
    """Whether a module loads: compiled ones may lack a library of the system."""
    done = _run(
        "import sys\n"
        f"try: import {module}\n"
        "except Exception as error: sys.exit(f'{type(error).__name__}: {error}')\n"
        f"print({module}.__version__)"
    )
    if done.returncode:
        # Without a message the process was killed, by a signal that the code names.
        reason = " ".join(done.stderr.split())[:200] or f"exit code {done.returncode}"
        remedy = f"install {COMPILED[module]} again"
        return Check("installation", module, "broken", reason, remedy)
    return Check("installation", module, "ok", done.stdout.strip())


def _run(code: str) -> subprocess.CompletedProcess[str]:
    """Run code in a Python process of its own; one that hangs has failed."""
    command = [sys.executable, "-c", code]
    try:
        return subprocess.run(
            command, capture_output=True, text=True, timeout=IMPORT_TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        reason = f"no end after {IMPORT_TIMEOUT:g} s"
        return subprocess.CompletedProcess(command, 1, "", reason)


def _extras() -> Iterator[Check]:
    for extra, purpose in ((name, each.purpose) for name, each in EXTRAS.items()):
        required = _requirements(extra)
        absent = [each for each in required if not _version(each.name)]
        wrong = [each for each in required if not _satisfied(each)]
        state: State = "missing" if absent else "warning" if wrong else "ok"
        found = purpose if not wrong else f"{purpose}: {', '.join(map(_mismatch, wrong))}"
        remedy = f'pip install "retwin[{extra}]"' if wrong else ""
        yield Check("extras", extra, state, found, remedy)


def _requirements(extra: str = "") -> list[Requirement]:
    """The requirements of retwin here, or those that an extra adds."""
    listed = map(Requirement, metadata.requires("retwin") or ())
    conditional = [(each, each.marker) for each in listed]
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
    version = _version(required.name)
    return bool(version) and required.specifier.contains(version, prereleases=True)


def _version(package: str) -> str:
    """The installed version, "" for none."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def _mismatch(required: Requirement) -> str:
    version = _version(required.name)
    if not version:
        return f"{required.name} is not installed"
    return f"{required.name} is {version}, and must be {required.specifier}"


def _machine(deep: bool) -> Iterator[Check]:
    group = "machine"
    yield Check(group, "system", "ok", f"{platform.system()} {platform.release()}")
    cores = _cores()
    yield _threads(cores)
    total, free = memory()
    if total:
        found = f"{free / 2**30:.1f} GB free of {total / 2**30:.1f}"
        if free >= BYTES_PER_PROCESS * cores:
            yield Check(group, "memory", "ok", found)
        else:
            fits = max(1, free // BYTES_PER_PROCESS)
            remedy = f"a study takes about 1 GB per process: give it --processes {fits}"
            yield Check(group, "memory", "warning", found, remedy)
    yield _gpu(deep)
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
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    quota, _, period = container("cpu.max").partition(" ")
    cores = allowed or 1
    return min(cores, max(1, int(quota) // int(period))) if quota.isdecimal() else cores


def _threads(cores: int) -> Check:
    given, machine = os.environ.get("OMP_NUM_THREADS", ""), os.cpu_count() or cores
    found = f"{cores} for this process" + (f", of {machine}" if machine != cores else "")
    if given.isdecimal() and int(given) > cores:
        remedy = f"OMP_NUM_THREADS={cores}: more threads than cores cost several times the time"
        return Check("machine", "cores", "warning", f"{found}; {given} threads", remedy)
    if machine > cores:
        remedy = f"give studies and simulations --processes {cores} or --workers {cores}"
        return Check("machine", "cores", "warning", found, remedy)
    return Check("machine", "cores", "ok", found)


def _gpu(deep: bool) -> Check:
    if not deep:
        return Check("machine", "GPU", "ok", "not checked, and none is needed; --deep checks it")
    done = _run(
        "import torch\n"
        "if torch.cuda.is_available(): print(torch.cuda.get_device_name())\n"
        "elif torch.accelerator.is_available(): print(torch.accelerator.current_accelerator())"
    )
    if done.returncode:
        return Check("machine", "GPU", "missing", "torch does not load, which finds it")
    found = done.stdout.strip() or "none that torch can use, and none is needed"
    return Check("machine", "GPU", "ok", found)


def _rendering() -> Iterator[Check]:
    from retwin.cases.animation.offscreen import offscreen_backend

    try:
        found = f"MuJoCo draws without a screen by {offscreen_backend().upper()}"
    except InputError as error:
        lacking = f"films are stick figures: {error.got}"
        yield Check("machine", "rendering", "missing", lacking, error.remedy)
    else:
        yield Check("machine", "rendering", "ok", found)


def _data() -> Iterator[Check]:
    yield _own_data(os.environ.get("RETWIN_DATA", ""))
    try:
        cache = cache_folder()
    except InputError as error:
        yield Check("data", "cache", "missing", error.got, error.remedy)
        return
    for name, known in DOWNLOADS.items():
        file, get = cache / known.file, f"retwin data fetch {name}"
        if not file.is_file():
            yield Check("data", f"public {name}", "missing", f"not in {cache}", get)
        elif sha256(file) != known.sha256:
            yield Check("data", f"public {name}", "warning", f"{file} has another SHA-256", get)
        else:
            yield Check("data", f"public {name}", "ok", str(file))
    existing = next(folder for folder in (cache, *cache.parents) if folder.exists())
    if existing.is_dir() and os.access(existing, os.W_OK):
        yield Check("data", "cache", "ok", str(cache))
    else:
        remedy = "set RETWIN_CACHE to a folder that can be written"
        yield Check("data", "cache", "warning", f"{cache} cannot be written", remedy)


def _own_data(named: str) -> Check:
    """The data files in the folder that RETWIN_DATA names."""
    if not named:
        found = "not set: demo and tests use an emulated robot"
        return Check("data", "RETWIN_DATA", "missing", found, "set it to a folder of real data")
    files = sorted(file for file in Path(named).glob("*/*") if file.suffix in DATA)
    if not files:
        found = f"{named}, with no data" if Path(named).is_dir() else f"{named}, no such folder"
        remedy = "set it to the folder of the data, or unset it"
        return Check("data", "RETWIN_DATA", "warning", found, remedy)
    listed = ", ".join(str(file.relative_to(named)) for file in files[:4])
    more = f" and {len(files) - 4} more" if len(files) > 4 else ""
    return Check("data", "RETWIN_DATA", "ok", f"{named}: {listed}{more}")
