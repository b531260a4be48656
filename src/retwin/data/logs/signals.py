"""`Signal` and `Log`: series with times of their own, as readers of logs give them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from retwin.errors import InputError

NANOSECOND = 1e-9
"""A nanosecond in s."""
MAX_SIGNALS = 10_000
"""Signals that one log may hold: names that are different in every message would fill memory."""
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
LATEST = 2**63 - 1
"""The latest time in ns, in the year 2262."""
UNWANTED = "not named in the mapping"
"""What is noted of signals that are there but not read."""
NO_STAMP = "without header stamps: the time of recording"
"""What is noted of topics whose messages have no stamps, where those are wanted."""
TimeUnit = Literal["", "s", "ms", "us", "ns", "iso"]
"""Units of times: numbers, or ISO 8601 text; "" for what is found."""
NANOSECONDS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Units of times that are numbers, in ns."""


@dataclass(frozen=True)
class Clock:
    """Where a log has its times; formats with times of their own need nothing of it.

    Parameters
    ----------
    column : str
        The column, or the channel of a group, that holds the times; "" for the one that is found.
    unit : {"", "s", "ms", "us", "ns", "iso"}
        Its unit, or ISO 8601 text; "" for what is found.
    format : str
        The format of times that are other text, as `datetime.strptime` reads it.
    rate : float or None
        Rows per s, where there is no column of times.
    otherwise : float or None
        Rows per s, where no column of times is found by its name; none is then guessed by its
        values.
    stamps : {"log", "header"}
        Whether messages have the time of their recording or the stamp of their header. Topics
        without stamps have the time of their recording in any case.

    """

    column: str = ""
    unit: TimeUnit = ""
    format: str = ""
    rate: float | None = None
    stamps: Literal["log", "header"] = "log"
    otherwise: float | None = None


@dataclass(frozen=True, eq=False)
class Signal:
    """One series of numbers.

    Parameters
    ----------
    name : str
        Its name in the log: a column, `group/channel`, or `/topic.field`.
    times : (n,) array
        Times: in ns from a reader (int64), in s since the begin of the log in a `Log`.
    values : (n,) array of float
        Its values, NaN where one is missing.
    unit : str
        Its unit as the log has it, "" if it has none.
    unreadable : int
        Values that are no numbers, and count as missing.
    note : str
        How its numbers were read where they may mean something else, "" elsewhere.

    """

    name: str
    times: NDArray
    values: NDArray
    unit: str = ""
    unreadable: int = 0
    note: str = ""


@dataclass(frozen=True)
class Skipped:
    """A series of which no signal is made, and the reason."""

    name: str
    reason: str


Reader = Callable[[Path, "frozenset[str] | None", Clock], Iterator[Signal | Skipped]]
"""A function that reads a log: of a path, the names of the signals that are wanted (None for all),
and the clock. It yields each signal as a whole."""


@dataclass(frozen=True, eq=False)
class Log:
    """What was read of a log.

    Attributes
    ----------
    name : str
        The name of the file or folder.
    sha256 : str
        Its SHA-256.
    begin : int
        The time of its first value in ns, since 1970 where the log knows the date.
    signals : dict of str to Signal
        The signals by their names, with times in s since `begin`.
    skipped : dict of str to str
        What is in the log besides, and why no signal is made of it.

    """

    name: str
    sha256: str
    begin: int
    signals: dict[str, Signal]
    skipped: dict[str, str] = field(default_factory=dict)

    @property
    def end(self) -> float:
        """The latest time of a value, in s since the earliest one."""
        return max((float(s.times.max(initial=0.0)) for s in self.signals.values()), default=0.0)


def named_unit(name: str) -> tuple[str, str]:
    """Name and unit of a title such as "T1 [°C]" or "speed (m/s)"; the unit is "" if it has none.

    What is in brackets is an index, and part of the name, if it is a number or follows at once.
    """
    found = re.fullmatch(r"\s*(.*?\S)(?:\s+\(([^()]*)\)|\s*\[([^\[\]]*)\])\s*", name)
    if found is None or re.fullmatch(r"\d+|", unit := (found[2] or found[3] or "").strip()):
        return name.strip(), ""
    return found[1], unit


def inside(name: str, outer: str) -> bool:
    """Whether a signal is a topic or a column, or a field or an element of it."""
    return name == outer or name.startswith((f"{outer}.", f"{outer}["))


def named_units(titles: Sequence[str]) -> list[tuple[str, str]]:
    """Name and unit of each title; titles that are alike but for the unit are names as a whole."""
    pairs = [named_unit(each) for each in titles]
    several = Counter(name for name, _ in pairs)
    return [
        (title.strip() if several[name] > 1 else name, unit)
        for title, (name, unit) in zip(titles, pairs, strict=True)
    ]


def nanoseconds(time: datetime) -> int:
    """A time in ns since 1970; UTC if it has no time zone."""
    since = (time if time.tzinfo else time.replace(tzinfo=UTC)) - EPOCH
    return (since.days * 86400 + since.seconds) * 10**9 + since.microseconds * 1000


def even_times(count: int, rate: float, where: str) -> NDArray:
    """The times in ns of `count` samples at a rate in Hz; raises as `to_nanoseconds` does."""
    return to_nanoseconds(np.arange(count) / rate, "s", where)


def to_nanoseconds(times: NDArray, unit: str, where: str) -> NDArray:
    """Times (n,) in a unit of `NANOSECONDS` as whole ns; those that are `Decimal` exactly.

    Raises
    ------
    InputError
        One is not finite, or out of range.

    """
    times = np.asarray(times)
    if times.dtype.kind in "iu" and unit == "ns":
        return times.astype(np.int64)
    scaled = np.round(times.astype(np.longdouble) * NANOSECONDS[unit])
    fine = np.abs(scaled) < LATEST  # NaN is not
    if not fine.all():
        row = int(np.argmin(fine))
        expected = "a time in every row, before the year 2262"
        got = f"{times[row]} {unit} in row {row}"
        remedy = "remove that row, or check column and unit of [time] in the mapping"
        raise InputError(where, expected=expected, got=got, remedy=remedy)
    if times.dtype.kind == "O":
        return np.array([round(each * NANOSECONDS[unit]) for each in times], np.int64)
    return scaled.astype(np.int64)
