"""`read_log`: the signals of a log, which a process of its own reads within limits."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from retwin.catalog import LOGS, resolve
from retwin.checks import at_most, require
from retwin.data import tables
from retwin.data.logs.signals import MAX_SIGNALS, NANOSECOND, Clock, Log, Signal
from retwin.progress import Progress
from retwin.serialisation.files import refusing, sha256
from retwin.serialisation.sizes import Budget
from retwin.workers.isolation import FileReader
from retwin.workers.process import Frame

BAG = "metadata.yaml"
"""The file that every ROS 2 bag has."""
WHOLE = "a log that is whole"
DAMAGED = "get or make the file again, or repair it with the tools of its format"
SAFE = 2**24
"""Bytes of a table of text up to which it is read here: its reader is Python alone, and a process
takes half a second to start."""


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
    expected = f"a log, {names}, or the folder of a ROS 2 bag"
    got = "no such file" if not path.exists() else "another kind of file"
    remedy = "check the name, or convert the log to one of these"
    require(fine and regular, str(path), expected=expected, got=got, remedy=remedy)
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
    }
    signals: dict[str, Signal] = {}
    skipped: dict[str, str] = {}
    for count, (about, arrays) in enumerate(_frames(path, request, size, budget), 1):
        remedy = "name those that are wanted in the mapping"
        at_most(path.name, count, MAX_SIGNALS, "signals", remedy=remedy)
        if not arrays:
            skipped[str(about[0])] = str(about[1])
            continue
        times, values = arrays
        name, unit, unreadable = str(about[0]), str(about[1]), int(about[2])
        signals[name] = Signal(name, times, values, unit, unreadable)
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


def _files(path: Path) -> list[Path]:
    """The files of a log, each of which must be a regular file in its folder."""
    files = [each for each in path.iterdir() if not each.is_dir()] if path.is_dir() else [path]
    for each in files:
        fits = each.is_file() and (each == path or not each.is_symlink())
        expected = "a regular file"
        remedy = "keep nothing but the files of the bag in its folder"
        require(fits, str(each), expected=expected, got="a link, a pipe or a device", remedy=remedy)
    return files


def _frames(path: Path, request: dict[str, Any], size: int, budget: Budget) -> Iterator[Frame]:
    """What `send_signals` yields, in a process with limits."""
    reader = resolve(LOGS[request["format"]].reader)
    if size <= SAFE and reader is tables.read:
        with refusing(path.name, expected=WHOLE, remedy=DAMAGED):
            for about, arrays in send_signals(request):
                budget.take(sum(each.nbytes for each in arrays))
                yield about, arrays
        return
    task = f"{__name__}:send_signals"
    with FileReader(task, expected=WHOLE, remedy=DAMAGED) as process:
        yield from process.read(request, path.name, size, budget)


def send_signals(request: dict[str, Any]) -> Iterator[Frame]:
    """The task of the process that reads a log: signals with their arrays, or what it skipped."""
    read = resolve(LOGS[request["format"]].reader)
    wanted = None if request["wanted"] is None else frozenset(request["wanted"])
    for each in read(Path(request["path"]), wanted, Clock(**request["clock"])):
        if isinstance(each, Signal):
            arrays = [each.times.astype("<i8", copy=False), each.values.astype("<f8", copy=False)]
            yield (each.name, each.unit, each.unreadable), arrays
        else:
            yield (each.name, each.reason), []
