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
from importlib import metadata
from pathlib import Path
from typing import Annotated, TypeAlias

import typer
from packaging.requirements import Requirement

from retwin._version import __version__
from retwin.catalog import DOWNLOADS, EXTRAS
from retwin.checks import install_command
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

Found: TypeAlias = tuple[str, str, str, str]
"""A check: what is checked; its state where something has to be done, which is "warning", "missing"
for what is optional or "broken"; what was found; and what has to be done, "" for nothing."""


def doctor(
    deep: Annotated[
        bool, option("", "Also load torch and others, which takes seconds.", "--deep")
    ] = False,
    as_json: Json = False,
) -> None:
    """Check installation, machine and data, and name what is missing."""
    checks = [
        {"name": name, "state": state if remedy else "ok", "found": found, "remedy": remedy}
        for name, state, found, remedy in (*_installation(deep), *_machine(deep), *_data())
    ]
    broken = ", ".join(each["name"] for each in checks if each["state"] == "broken")
    rows = [
        (each["state"], each["name"], "\n→ ".join(filter(None, (each["found"], each["remedy"]))))
        for each in checks
    ]
    shown = f"broken: {broken}; retwin cannot work like this."
    verdict = shown if broken else "retwin works on this machine."
    screen = (table(("state", "what", "found"), rows), "", verdict)
    answer({"ok": not broken, "checks": checks}, *screen, as_json=as_json)
    if broken:
        raise typer.Exit(FAILED)


def _installation(deep: bool) -> Iterator[Found]:
    """Versions of what is needed, and the extras."""
    yield "retwin", "ok", f"{__version__} in {Path(__file__).parents[1]}", ""
    system = f"{platform.system()} {platform.release()}"
    yield "Python", "ok", f"{platform.python_version()}, {sys.executable}, on {system}", ""
    wrong = _wrong("")
    for package, reason in wrong.items():
        yield package, "broken", reason, f'pip install "{package}"'
    for module, package in COMPILED.items():
        if package not in wrong:
            version = f"{metadata.version(package)}{'' if deep else ', not loaded'}"
            reason = _run(f"import {module}")[1] if deep else ""
            yield module, "broken", reason or version, reason and f"install {package} again"
    for extra, entry in EXTRAS.items():
        wrong = _wrong(extra)
        remedy = install_command(extra) if wrong else ""
        yield extra, "missing", "; ".join([entry.purpose, *wrong.values()]), remedy


def _wrong(extra: str) -> dict[str, str]:
    """The packages that retwin, or an extra of it, lacks or has in a wrong version, and why."""
    wrong = {}
    for each in map(Requirement, metadata.requires("retwin") or ()):
        needed = [each.marker is None or each.marker.evaluate({"extra": x}) for x in ("", extra)]
        if needed != [not extra, True]:
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
    words = [sys.executable, "-c", code]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=IMPORT_TIMEOUT)
    except subprocess.TimeoutExpired:
        return "", f"no end after {IMPORT_TIMEOUT:g} s"
    # Of a traceback only the message, which may take several lines, is not indented.
    lines = [x for x in done.stderr.splitlines() if x and not x.startswith((" ", "Traceback"))]
    reason = " ".join(lines) or f"exit code {done.returncode}"
    return done.stdout.strip(), reason if done.returncode else ""


def _machine(deep: bool) -> Iterator[Found]:
    """Cores, memory and graphics."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    threads = os.environ.get("OMP_NUM_THREADS", "")
    many = threads.isdecimal() and int(threads) > (cores or 1)
    remedy = f"OMP_NUM_THREADS={cores}: more threads than cores cost several times the time"
    yield "cores", "warning", f"{cores} for this process", remedy if many else ""
    total, free = memory()
    fits = max(1, free // BYTES_PER_PROCESS)
    found = f"{free / 2**30:.1f} GB free of {total / 2**30:.1f}" if total else "not stated"
    remedy = f"a study takes about 1 GB per process: give it --processes {fits}"
    yield "memory", "warning", found, remedy if total and fits < (cores or 1) else ""
    found, reason = _run(GPU) if deep else ("not checked, and none is needed; --deep does", "")
    yield "GPU", "missing", found or reason, reason and "install torch again"


def _data() -> Iterator[Found]:
    """The real and the public data."""
    named = os.environ.get("RETWIN_DATA", "")
    there = bool(named) and Path(named).is_dir()
    found = named if there else f"{named or 'not set'}: demo and tests use an emulated robot"
    yield "RETWIN_DATA", "missing", found, "" if there else "set it to a folder of real data"
    try:
        cache = cache_folder()
    except InputError as error:
        yield "cache", "missing", error.got, error.remedy
        return
    for name, known in DOWNLOADS.items():
        there = (cache / known.file).is_file()
        found = str(cache / known.file) if there else f"not in {cache}"
        remedy = "" if there else f"retwin data convert --public {name} {name}.npz"
        yield f"public {name}", "missing", found, remedy
