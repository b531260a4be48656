"""`retwin doctor`: which packages, resources and data of this machine retwin finds.

By default nothing heavy is imported: versions come from the packages' metadata. With `--deep` each
compiled package is imported in a process of its own, where a missing library of the system cannot
end this one.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Annotated, Literal

import typer
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from retwin._version import __version__
from retwin.catalog import DOWNLOADS, EXTRAS
from retwin.cli.options import Json, option
from retwin.cli.terminal import FAILED, answer, table
from retwin.data.download import cache_folder
from retwin.errors import InputError
from retwin.serialisation.sizes import memory

COMPILED = {"numpy": "numpy", "scipy": "scipy", "torch": "torch", "mujoco": "mujoco-core"}
"""Module and package of compiled libraries, which can be installed and still fail to load."""
IMPORT_TIMEOUT = 120.0
"""Seconds after which the import of a package is taken to hang; torch takes 4 on two cores."""
BYTES_PER_PROCESS = 2**30
"""Memory that one process of a study takes, as measured for the arm."""
GPU = """import torch
if torch.cuda.is_available(): print(torch.cuda.get_device_name())
elif torch.accelerator.is_available(): print(torch.accelerator.current_accelerator())
else: print("none that torch can use, and none is needed")"""


@dataclass(frozen=True)
class Check:
    """The result of one check.

    Attributes
    ----------
    name : str
        What was checked.
    state : {"ok", "warning", "missing", "broken"}
        As it should be; works with a drawback; absent and optional; absent and required.
    found : str
        What was found, in words.
    remedy : str
        What to do; "" if nothing is needed.

    """

    name: str
    state: Literal["ok", "warning", "missing", "broken"]
    found: str
    remedy: str = ""


def doctor(
    deep: Annotated[
        bool, option("", "Also load torch and others, which takes seconds.", "--deep")
    ] = False,
    as_json: Json = False,
) -> None:
    """Check installation, machine and data, and name what is missing."""
    checks = examine(deep=deep)
    broken = [each.name for each in checks if each.state == "broken"]
    rows = [
        (each.state, each.name, f"{each.found}\n→ {each.remedy}" if each.remedy else each.found)
        for each in checks
    ]
    verdict = f"broken: {', '.join(broken)}; retwin cannot work like this."
    shown = verdict if broken else "retwin works on this machine."
    answer(
        {"ok": not broken, "checks": checks},
        *(table(("state", "what", "found"), rows), "", shown),
        as_json=as_json,
    )
    if broken:
        raise typer.Exit(FAILED)


def examine(*, deep: bool = False) -> list[Check]:
    """Run all checks; nothing is changed.

    Parameters
    ----------
    deep : bool
        Whether compiled packages are imported, each in a process of its own.

    Returns
    -------
    list of Check
        Results in the order of the output.

    """
    return [*_installation(deep), *_extras(), *_machine(deep), *_data()]


def _installation(deep: bool) -> Iterator[Check]:
    yield Check("retwin", "ok", f"{__version__} in {Path(__file__).parents[1]}")
    needed = SpecifierSet(metadata.metadata("retwin")["Requires-Python"])
    fits = needed.contains(platform.python_version(), prereleases=True)
    python = f"{platform.python_version()}, {sys.executable}"
    remedy = "" if fits else f"take Python {needed}"
    yield Check("Python", "ok" if fits else "broken", python, remedy)
    wrong = _wrong("")
    for package, reason in wrong.items():
        yield Check(package, "broken", reason, f'pip install "{package}"')
    for module, package in COMPILED.items():
        if package in wrong:
            continue
        found, reason = _run(f"import {module}") if deep else ("", "")
        version = f"{metadata.version(package)}{'' if deep else ', not loaded'}"
        remedy = f"install {package} again" if reason else ""
        yield Check(module, "broken" if reason else "ok", reason or found or version, remedy)


def _extras() -> Iterator[Check]:
    for extra, entry in EXTRAS.items():
        wrong = _wrong(extra)
        found = "; ".join([entry.purpose, *wrong.values()])
        remedy = f'pip install "retwin[{extra}]"' if wrong else ""
        yield Check(extra, "missing" if wrong else "ok", found, remedy)


def _wrong(extra: str) -> dict[str, str]:
    """The packages that retwin, or an extra of it, lacks or has in a wrong version, and why."""
    wrong = {}
    for each in map(Requirement, metadata.requires("retwin") or ()):
        marker = each.marker
        always = marker is None or marker.evaluate({"extra": ""})
        if always == bool(extra) or not (always or marker.evaluate({"extra": extra})):  # type: ignore[union-attr]
            continue
        try:
            version = metadata.version(each.name)
        except metadata.PackageNotFoundError:
            wrong[each.name] = f"{each.name} is not installed"
            continue
        if not each.specifier.contains(version, prereleases=True):
            wrong[each.name] = f"{each.name} is {version}, and must be {each.specifier}"
    return wrong


def _run(code: str) -> tuple[str, str]:
    """What code prints in a Python process of its own, and why it failed; "" if it did not."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=IMPORT_TIMEOUT
        )
    except subprocess.TimeoutExpired:
        return "", f"no end after {IMPORT_TIMEOUT:g} s"
    # Without a message the process was killed, by a signal that the code names.
    lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
    # The message, which may take several lines, follows the traceback, whose lines are indented.
    frames = [place for place, line in enumerate(lines) if line.startswith(" ")]
    reason = " ".join(lines[frames[-1] + 1 if frames else 0 :])
    return done.stdout.strip(), reason if done.returncode else ""


def _machine(deep: bool) -> Iterator[Check]:
    yield Check("system", "ok", f"{platform.system()} {platform.release()}")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    given = os.environ.get("OMP_NUM_THREADS", "")
    if given.isdecimal() and int(given) > (cores or 1):
        remedy = f"OMP_NUM_THREADS={cores}: more threads than cores cost several times the time"
        yield Check("cores", "warning", f"{cores}; {given} threads", remedy)
    else:
        yield Check("cores", "ok", f"{cores} for this process")
    total, free = memory()
    if total:
        fits = max(1, free // BYTES_PER_PROCESS)
        scarce = fits < (cores or 1)
        remedy = f"a study takes about 1 GB per process: give it --processes {fits}"
        found = f"{free / 2**30:.1f} GB free of {total / 2**30:.1f}"
        yield Check("memory", "warning" if scarce else "ok", found, remedy if scarce else "")
    found, reason = _run(GPU) if deep else ("not checked, and none is needed; --deep does", "")
    lacking = "install torch again" if reason else ""
    yield Check("GPU", "missing" if reason else "ok", found or reason, lacking)


def _data() -> Iterator[Check]:
    named = os.environ.get("RETWIN_DATA", "")
    if Path(named).is_dir() and named:
        yield Check("RETWIN_DATA", "ok", named)
    else:
        found = f"{named or 'not set'}: demo and tests use an emulated robot"
        yield Check("RETWIN_DATA", "missing", found, "set it to a folder of real data")
    try:
        cache = cache_folder()
    except InputError as error:
        yield Check("cache", "missing", error.got, error.remedy)
        return
    for name, known in DOWNLOADS.items():
        file = cache / known.file
        if file.is_file():
            yield Check(f"public {name}", "ok", str(file))
        else:
            get = f"retwin data fetch {name}"
            yield Check(f"public {name}", "missing", f"not in {cache}", get)
