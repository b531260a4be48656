"""Files with errors in them, and the real command line on each; run as a script.

`python mutation.py SAMPLES WORK FIRST COUNT FORMAT...` mutates the samples of each format with the
seeds FIRST to FIRST + COUNT - 1 and prints a line for every requirement that was not met.
Everything is imported once; each case runs in a forked process of its own.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from retwin.cli import main
from retwin.deploy.bundle.seal import SUMS, seal

MODULE = """
import numpy as np


def reach(commands, length=1.0):
    turned = commands.cumsum(axis=-1)
    return length * np.stack([np.sin(turned).sum(axis=-1), np.cos(turned).sum(axis=-1)], axis=-1)
"""
CASE = """
name = "reach"
twin = "own_of_mutations:reach"
rate = 10
inputs = { first = { low = -1, high = 1 }, second = { unit = "m", low = -1, high = 1 } }
outputs = { far = { unit = "m" }, high = { unit = "m" } }
commands = { duration = 6, segments = 2, ramp_durations = [0.8, 1.0] }
network = { kind = "MLP", hidden = [8] }
training = { max_epochs = 2, batch_size = 64, learning_rate = 1e-2 }
density = { kind = "Mixture", training = { max_epochs = 2, decay = "step" } }
[faults]
stuck = { kind = "Stuck", actuator = "second", onset = 1.2 }
"""
HEADROOM = 2**30
"""Bytes of address space that a case may take beyond what is mapped when it starts."""
TIMEOUT = 60
"""Seconds that a case may take."""
HEAD = 512
"""Bytes at the beginning of a file; half of all mutations are there, where headers are."""
ODD: list[Any] = [None, True, -1, 0, 2**63, 1e308, float("nan"), "", "\0", "../..", [], {}, [[]]]
"""Values that replace one of a description."""


@dataclass(frozen=True)
class Format:
    """What is mutated, and the commands that read it, in turn.

    Attributes
    ----------
    target : str
        File or folder of the sample.
    commands : tuple of str
        The words after `retwin`.

    """

    target: str
    commands: tuple[str, ...]


LOGS = ("csv", "feather", "mcap", "mf4", "parquet", "tdms")
SEALED = ("bundle verify sealed", "diagnose predict sealed real.npz")
FORMATS = {
    "npz": Format(
        "a.npz",
        (
            "data info a.npz",
            "data convert a.npz made.npz",
            "data convert a.npz made.npz --split 0.6",
            "twin simulate case.toml --commands a.npz --out made.npz",
        ),
    ),
    "zarr": Format("a.zarr", ("data info a.zarr", "data convert a.zarr made.npz")),
    "mat": Format("a.mat", ("data info a.mat --rate 10", "data convert a.mat made.npz --rate 10")),
    "csv": Format("set", ("data info set --rate 10", "data convert set made.npz --case case.toml")),
    "case": Format(
        "case.toml", ("twin info case.toml", "twin simulate case.toml --n 2 --out made.npz")
    ),
    "model": Format(
        "model",
        (
            "generate model --case case.toml --per-class 1 --out made.npz",
            "twin info model",
            "twin simulate model --case case.toml --n 2 --out made.npz",
        ),
    ),
    "diagnoser": Format("cnn", ("diagnose predict cnn real.npz",)),
    "bundle": Format(
        "sealed",
        (*SEALED, "generate sealed --case case.toml --per-class 1 --out made.npz"),
    ),
    "onnx": Format("sealed", SEALED),
    "results": Format("study/results.json", ("report study",)),
    **{
        f"log-{kind}": Format(f"a.{kind}", (f"data map a.{kind} --out made.toml",)) for kind in LOGS
    },
}
EXTRAS = {"zarr": "zarr", "onnx": "onnxruntime"} | {f"log-{kind}": "rosbags" for kind in LOGS}
"""What the formats need that not every installation has."""
NAMES = [name for name in FORMATS if importlib.util.find_spec(EXTRAS.get(name, "numpy"))]


# --- mutations -----------------------------------------------------------------------------------


def place(data: bytes, rng: np.random.Generator) -> int:
    return int(rng.integers(min(len(data), HEAD) if rng.random() < 0.5 else len(data)))


def flip(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.integers(1, 9)):
        changed[place(data, rng)] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def truncate(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: place(data, rng)]


def zero(data: bytes, rng: np.random.Generator) -> bytes:
    begin = place(data, rng)
    width = min(int(rng.integers(1, 65)), len(data) - begin)
    return data[:begin] + bytes(width) + data[begin + width :]


def insert(data: bytes, rng: np.random.Generator) -> bytes:
    begin = place(data, rng)
    return data[:begin] + rng.bytes(int(rng.integers(1, 65))) + data[begin:]


def places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Every holder and key of a JSON document."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, inner in items:
        yield value, key
        if isinstance(inner, dict | list):
            yield from places(inner)


def swap_json(data: bytes, rng: np.random.Generator) -> bytes:
    """A value of a JSON document replaced by an odd one, or exchanged with another."""
    document = json.loads(data)
    every = list(places(document))
    holder, key = every[rng.integers(len(every))]
    other, name = every[rng.integers(len(every))]
    text = json.dumps(holder[key])
    if rng.random() < 0.5:
        holder[key] = ODD[rng.integers(len(ODD))]
    else:
        holder[key] = json.loads(json.dumps(other[name]))
        if rng.random() < 0.5:
            other[name] = json.loads(text)
    return json.dumps(document).encode()


def swap_words(data: bytes, rng: np.random.Generator) -> bytes:
    """Two words or numbers of a text, exchanged."""
    found = list(re.finditer(rb"[\w.+-]+", data))
    one, other = sorted(rng.integers(len(found), size=2))
    a, b = found[one], found[other]
    if one == other:
        return data[: a.start()] + data[a.end() :]
    between = data[a.end() : b.start()]
    return data[: a.start()] + b[0] + between + a[0] + data[b.end() :]


def inside(file: Path, rng: np.random.Generator) -> None:
    """Mutate a member of an archive, whose checksums are right again."""
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = list(members)[rng.integers(len(members))]
    members[name] = anyhow(members[name], rng)
    with zipfile.ZipFile(file, "w") as archive:
        for each, data in members.items():
            archive.writestr(each, data)


BYTES = (flip, truncate, zero, insert)


def anyhow(data: bytes, rng: np.random.Generator, *more: Callable) -> bytes:
    """One or two mutations of some bytes."""
    for _ in range(rng.integers(1, 3)):
        if data:
            data = (*BYTES, *more)[rng.integers(len(BYTES) + len(more))](data, rng)
            more = ()
    return data


def mutate(target: Path, rng: np.random.Generator) -> None:
    """Change one file; of a sealed folder, most are sealed again."""
    inner = sorted(file for file in target.rglob("*") if file.is_file())
    files = inner if target.is_dir() else [target]
    file = files[rng.integers(len(files))]
    if file.suffix == ".npz" and rng.random() < 0.5:
        inside(file, rng)
        return
    special = {".json": swap_json, ".toml": swap_words, ".csv": swap_words}.get(file.suffix)
    # What can only be done to a sound document has three times the probability of the others.
    file.write_bytes(anyhow(file.read_bytes(), rng, *[special] * 3 if special else []))
    if (target / SUMS).exists() and rng.random() < 0.8:
        seal(target)


# --- one case ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ended:
    """How a command ended: its wait status, its stderr, and the files that are there now."""

    status: int
    stderr: str
    files: frozenset[str]

    @property
    def code(self) -> int:
        return os.waitstatus_to_exitcode(self.status)


def mapped() -> int:
    """Bytes of address space of this process."""
    pages = Path("/proc/self/statm").read_text().split()[0]
    return int(pages) * resource.getpagesize()


def files_in(folder: Path) -> frozenset[str]:
    """Names of all files, but for the cache that torch keeps where temporary files are."""
    names = (str(each.relative_to(folder)) for each in folder.rglob("*"))
    return frozenset(name for name in names if not name.startswith("torchinductor_"))


def call(
    folder: Path, command: str | Sequence[str], output: Path, modules: Path | None = None
) -> Ended:
    """`retwin COMMAND` in a child that works in `folder`, under limits."""
    words = command.split() if isinstance(command, str) else command
    pid = os.fork()
    if not pid:
        code = 1
        try:
            os.setsid()
            signal.alarm(TIMEOUT)
            limit = mapped() + HEADROOM
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            os.chdir(folder)
            os.environ["TMPDIR"] = str(folder)
            tempfile.tempdir = None
            for number, name in ((0, os.devnull), (1, os.devnull), (2, str(output))):
                flags = os.O_RDONLY if not number else os.O_WRONLY | os.O_CREAT | os.O_TRUNC
                os.dup2(os.open(name, flags), number)
            sys.argv = ["retwin", *words]
            try:
                main()
            except SystemExit as ended:
                code = int(ended.code or 0)
            sys.stdout.flush()
            sys.stderr.flush()
            if modules is not None:
                modules.write_text("\n".join(sys.modules))
        except BaseException:
            sys.excepthook(*sys.exc_info())
            sys.stderr.flush()
        finally:
            os._exit(code)
    _, status = os.waitpid(pid, 0)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)
    return Ended(status, output.read_text(errors="replace"), files_in(folder))


def broken(ended: Ended, before: frozenset[str], made: frozenset[str]) -> str:
    """The first requirement that is not met, if there is one."""
    lines = ended.stderr.splitlines()
    errors = [line for line in lines if line.startswith("error: ")]
    last = f": {lines[-1][:300]}" if lines else ""
    if ended.code == -signal.SIGALRM:
        return f"took more than {TIMEOUT} s{last}"
    if ended.code not in (0, 2):
        return f"ended with {ended.code}{last}"
    if len(errors) != (ended.code == 2):
        return f"{len(errors)} errors in its output{last}"
    if any(not line.startswith(("error: ", "warning: ")) for line in lines):
        return f"more than errors and warnings in its output{last}"
    left = ended.files ^ before
    if left - (made if ended.code == 0 else frozenset()):
        return f"left {sorted(left)[:5]}"
    return ""


def import_all(modules: Path) -> None:
    """Import here what a child has imported, so that the next ones need not."""
    for module in modules.read_text().split():
        with contextlib.suppress(Exception):
            importlib.import_module(module)


def run(samples: Path, work: Path, first: int, count: int, name: str) -> Iterator[str]:
    """Every requirement that a mutated file of the format makes a command break."""
    form, sample, output = FORMATS[name], samples / name, work / f"{name}.stderr"
    made = []
    for command in form.commands:
        folder, modules = work / name, work / f"{name}.modules"
        shutil.copytree(sample, folder)
        ended = call(folder, command, output, modules)
        assert (ended.code, ended.stderr) == (0, ""), (name, command, ended)
        made.append(ended.files - files_in(sample))
        shutil.rmtree(folder)
        import_all(modules)
    for seed in range(first, first + count):
        command, allowed = form.commands[seed % len(made)], made[seed % len(made)]
        shutil.copytree(sample, folder)
        mutate(folder / form.target, np.random.default_rng([zlib.crc32(name.encode()), seed]))
        problem = broken(call(folder, command, output), files_in(sample), allowed)
        if problem:
            yield f"{name} {seed}: retwin {command}: {problem}"
        shutil.rmtree(folder)


def printed(script: str, *words: object) -> list[str]:
    """The lines that a script like this one prints."""
    done = subprocess.run(
        [sys.executable, script, *map(str, words)],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        # One thread, since a process that has several cannot be forked safely.
        env=os.environ
        | {"OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "1", "COLUMNS": "200", "RETWIN_QUIET": "1"}
        | {"PYTHONDONTWRITEBYTECODE": "1"},
    )
    return done.stdout.splitlines()


if __name__ == "__main__":
    samples, work, first, count, *names = sys.argv[1:]
    # The heaviest modules, which else the first command imports and then this process again.
    importlib.import_module("retwin.deploy.bundle.bundle")
    importlib.import_module("retwin.report.page")
    for name in names:
        for failure in run(Path(samples), Path(work), int(first), int(count), name):
            print(failure, flush=True)
