"""`read_log`: the signals of a log, which a process of its own reads within limits."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from retwin.catalog import LOGS, resolve
from retwin.checks import require
from retwin.data import tables
from retwin.data.logs.signals import MAX_SIGNALS, NANOSECOND, Clock, Log, Signal, Skipped
from retwin.data.logs.worker import FRAME
from retwin.errors import InputError, brief
from retwin.processes import scratch_folder
from retwin.progress import Progress
from retwin.serialisation.files import sha256
from retwin.serialisation.sizes import Budget

BAG = "metadata.yaml"
"""The file that every ROS 2 bag has."""
BYTES_PER_VALUE = 16
"""Bytes of a time and a value."""
MAX_TEXT = 2**16
"""Bytes of a frame's text at most."""
DAMAGED = "get or make the file again, or repair it with the tools of its format"
SAFE = 2**24
"""Bytes of a table of text up to which it is read here: its reader is Python alone, and a process
takes half a second to start."""
CODE = "import sys; sys.path[:] = {path!r}; from retwin.data.logs.worker import main; main()"


def is_log(path: Path) -> bool:
    """Whether what is at `path` is a log by its name, and no file of trajectories."""
    if path.is_dir():
        return (path / BAG).is_file()
    return bool(path.suffix) and path.suffix.lower() in LOGS


def log_format(path: Path) -> str:
    """The key of `catalog.LOGS` for what is at `path`.

    Raises
    ------
    InputError
        It is no log, or no regular file.

    """
    fine = is_log(path)
    regular = path.is_file() or path.is_dir()
    names = ", ".join(f"*{suffix}" for suffix in LOGS if suffix)
    require(
        fine and regular,
        str(path),
        expected=f"a log, {names}, or the folder of a ROS 2 bag",
        got="no such file" if not path.exists() else "another kind of file",
        remedy="check the name, or convert the log to one of these",
    )
    return "" if path.is_dir() else path.suffix.lower()


def read_log(
    path: str | os.PathLike[str],
    *,
    wanted: Collection[str] | None = None,
    clock: Clock | None = None,
    budget: Budget,
    progress: Progress | None = None,
) -> Log:
    """The signals of a log.

    Parameters
    ----------
    path : path
        A file of one of the formats in `catalog.LOGS`, or the folder of a ROS 2 bag.
    wanted : collection of str, optional
        The names of the signals to read; by default all that hold numbers.
    clock : Clock, optional
        Where the times are.
    budget : Budget
        The memory that the signals may take.
    progress : callable, optional
        Called with the share of the signals that were read, from 0 to 1.

    Raises
    ------
    InputError
        It is no log, damaged, too large, or lacks a signal that is wanted. The message names it.

    """
    path = Path(path)
    kind = log_format(path)
    files = _files(path)
    budget.take(0)
    size = sum(each.stat().st_size for each in files)
    request = {
        "path": str(path.resolve()),
        "format": kind,
        "wanted": None if wanted is None else sorted(wanted),
        "clock": asdict(clock or Clock()),
        "max_bytes": budget.left,
        "size": size,
    }
    signals: dict[str, Signal] = {}
    skipped: dict[str, str] = {}
    here = size <= SAFE and resolve(LOGS[kind].reader) is tables.read
    found = (_read_here if here else _frames)(path, request, budget)
    for count, each in enumerate(found, 1):
        if count > MAX_SIGNALS:
            raise _refused(path, "more signals than can be")
        if isinstance(each, Skipped):
            skipped[each.name] = each.reason
            continue
        signals[each.name] = each
        if progress is not None and wanted:
            progress(len(signals) / len(wanted))
    require(
        signals or wanted is not None,  # what is missing then is named with what is alike
        path.name,
        expected="signals that hold numbers",
        got=", ".join(f"{name} ({why})" for name, why in list(skipped.items())[:5]) or "none",
        remedy="check that it is the right file",
    )
    begin = min((int(s.times.min()) for s in signals.values() if len(s.times)), default=0)
    shifted = {
        name: replace(each, times=(each.times - begin) * NANOSECOND)
        for name, each in signals.items()
    }
    return Log(path.resolve().name, sha256(path), begin, shifted, skipped)


def _read_here(path: Path, request: dict[str, Any], budget: Budget) -> Iterator[Signal | Skipped]:
    """What the reader of a small table of text finds, with the limits of the other way."""
    wanted = None if request["wanted"] is None else frozenset(request["wanted"])
    try:
        for each in tables.read(path, wanted, Clock(**request["clock"])):
            budget.take(BYTES_PER_VALUE * len(each.times) if isinstance(each, Signal) else 0)
            yield each
    except InputError:
        raise
    except Exception as error:
        raise _refused(path, f"{type(error).__name__}: {brief(error)}") from None


def _files(path: Path) -> list[Path]:
    """The files of a log, each of which must be a regular file in its folder."""
    files = [each for each in path.iterdir() if not each.is_dir()] if path.is_dir() else [path]
    for each in files:
        require(
            each.is_file() and (each == path or not each.is_symlink()),
            str(each),
            expected="a regular file",
            got="a link, a pipe or a device",
            remedy="keep nothing but the files of the bag in its folder",
        )
    return files


def _frames(path: Path, request: dict[str, Any], budget: Budget) -> Iterator[Signal | Skipped]:
    """What the process that reads the log sends."""
    paths = [os.path.abspath(each) for each in sys.path if each]
    # Libraries unpack to temporary files, which they leave where they fail.
    with scratch_folder() as scratch:
        own = {"ARROW_DEFAULT_MEMORY_POOL": "system", "OMP_NUM_THREADS": "1"}
        places = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), scratch)
        process = subprocess.Popen(
            [sys.executable, "-I", "-c", CODE.format(path=paths)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **own, **places},
        )
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with suppress(BrokenPipeError):  # it ended at once, which the next lines notice
                process.stdin.write(json.dumps(request).encode())
                process.stdin.close()
            while True:
                about = _text(process.stdout)
                if about is None:
                    raise _ended(path, process)
                if "done" in about:
                    return
                yield _received(path, about, process, budget)
        finally:
            process.kill()
            process.stdout.close()
            process.wait()


def _received(
    path: Path, about: dict[str, Any], process: subprocess.Popen[bytes], budget: Budget
) -> Signal | Skipped:
    """The signal, or the error, of one frame."""
    assert process.stdout is not None
    if "error" in about:
        argument, expected, got, remedy = map(str, about["error"])
        raise InputError(argument, expected=expected, got=got, remedy=remedy)
    if "memory" in about:
        budget.take(budget.left + 1)
    if "damaged" in about:
        raise _refused(path, str(about["damaged"]))
    if "skipped" in about:
        return Skipped(str(about["skipped"]), str(about["reason"]))
    count = int(about["count"])
    budget.take(BYTES_PER_VALUE * count)
    times = _array(process.stdout, count, "<i8")
    values = _array(process.stdout, count, "<f8")
    if times is None or values is None:
        raise _ended(path, process)
    unit, bad = str(about["unit"]), int(about["unreadable"])
    return Signal(str(about["name"]), times, values, unit, bad)


def _text(stream: IO[bytes]) -> dict[str, Any] | None:
    """The JSON of a frame, None at the end of the stream."""
    head = stream.read(FRAME.size)
    if len(head) < FRAME.size or (size := FRAME.unpack(head)[0]) > MAX_TEXT:
        return None
    try:
        found = json.loads(stream.read(size))
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


def _array(stream: IO[bytes], count: int, dtype: str) -> NDArray | None:
    made = np.empty(count, dtype)
    done = stream.readinto(made.view(np.uint8).data)  # type: ignore[attr-defined]
    return made if done == made.nbytes else None


def _ended(path: Path, process: subprocess.Popen[bytes]) -> InputError:
    """The error about a process that ended before its last frame."""
    code = process.wait()
    if code == -getattr(signal, "SIGXCPU", 0):
        return _refused(path, "contents that take longer to read than a log of that size can")
    why = f"signal {-code}" if code < 0 else f"exit code {code}"
    return _refused(path, f"contents at which the format's library failed ({why})")


def _refused(path: Path, got: str) -> InputError:
    return InputError(path.name, expected="a log that is whole", got=got, remedy=DAMAGED)
