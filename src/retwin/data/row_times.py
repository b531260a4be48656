"""When the rows of a table were recorded: the column of the times, its unit, its cells in ns."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import datetime
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.logs.signals import NANOSECONDS, Clock, nanoseconds, to_nanoseconds
from retwin.errors import InputError

TIME_NAMES = ("time", "timestamp", "timestamps", "t", "datetime", "date", "zeit", "stamp", "clock")
"""Names by which a column of times is found, the most certain first."""
DATES = ("%d.%m.%Y", "%m/%d/%Y", "%d/%m/%Y", "%Y/%m/%d", "%Y-%m-%d")
HOURS = ("%H:%M:%S", "%H:%M:%S.%f", "%H:%M", "%I:%M:%S %p", "%I:%M:%S.%f %p", "%I:%M %p")
"""Formats of dates and of what follows them, of which one is taken that alone fits to all."""
EPOCHS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""The least times since 1970 in these units; smaller ones are in s."""
DAY, DAYS = 86400.0, (20000.0, 80000.0)
"""Seconds of a day, and serial days of the years 1954 to 2119 in spreadsheets."""
SHORT, WHOLE = 1e-3, 1e-2
"""Interval from which on such numbers are seconds, and how far one of days is from whole seconds,
relative to it: times in s have other intervals."""
MISREAD = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "minutes": 60.0, "hours": 3600.0, "days": DAY}
"""Seconds of the units that times without a unit may have, besides seconds."""
SPELT = {"sec": "s", "seconds": "s", "µs": "us", "μs": "us"}
"""Other spellings of units."""


def time_column(names: Iterable[str]) -> str:
    """The name of the column that holds the times, "" if none has such a name.

    A name counts without its unit and without what is before its last separator: `Time [s]`.
    """
    found: list[tuple[int, int, str]] = []
    for place, name in enumerate(names):
        plain = name.lower().strip().strip('"')
        last = plain.replace("/", " ").replace(".", " ").split("[")[0].split("(")[0].split()
        parts = [part.strip("_ ") for part in (plain, *last[-1:])]
        parts += [word for part in parts for word in part.split("_")[:1]]
        rank = min((TIME_NAMES.index(p) for p in parts if p in TIME_NAMES), default=None)
        if rank is not None:
            found.append((rank, place, name))
    return min(found)[2] if found else ""


def unit_in(name: str) -> str:
    """The unit with which a name such as `time_ms` ends, "" if there is none."""
    last = name.lower().rpartition("_")[2] if "_" in name else ""
    return last if last in NANOSECONDS else ""


def misread_unit(interval: float, period: float, *, similar: float = 1.3) -> str:
    """The unit that makes an interval a sample period, which was read as so many s; "" if none.

    Parameters
    ----------
    similar : float, default 1.3
        Ratio of two intervals up to which one may stand for the other in another unit.

    """
    for unit, seconds in MISREAD.items():
        if 1 / similar < interval * seconds / period < similar:
            return unit
    return ""


def row_times(values: NDArray, unit: str, clock: Clock, where: str) -> NDArray:
    """Times (n,) in ns of the cells of a column; numbers that are text exactly.

    Parameters
    ----------
    values : (n,) array
        datetime64, numbers or text.
    unit : str
        The unit that the file states, "" if it states none.
    clock : Clock
        What the user states, which comes first.
    where : str
        File and column, for messages.

    Raises
    ------
    InputError
        A cell is no time.

    """
    if values.dtype.kind == "M":
        missing = np.isnat(values)
        got = f"none in row {int(np.argmax(missing)) if len(missing) else 0}"
        remedy = "remove that row, or name another column in [time] of the mapping"
        require(not missing.any(), where, expected="a time in every row", got=got, remedy=remedy)
        return values.astype("datetime64[ns]").astype(np.int64)
    if clock.format or clock.unit == "iso":
        return _parse(values, clock.format, where)
    if values.dtype.kind in "OUS":
        found = [_number(str(cell)) for cell in values]
        if None in found:
            row = found.index(None)
            if clock.unit or row:  # the others are numbers
                raise _no_time(values[row], f"{where}, row {row}")
            return _parse(values, "", where)
        values = np.array(found, dtype=object)
    stated = clock.unit or SPELT.get(unit, unit)
    if stated not in NANOSECONDS:
        _check_days(values.astype(float), where)
        size = float(np.nanmax(np.abs(values.astype(float)), initial=0.0))
        stated = next((name for least, name in EPOCHS if size > least), "s")
    return to_nanoseconds(values, stated, where)


def _check_days(values: NDArray, where: str) -> None:
    """Refuse numbers without a unit that are serial days of a spreadsheet."""
    step = float(np.median(np.diff(values))) if len(values) > 1 else 0.0
    seconds = step * DAY
    days = len(values) > 1 and DAYS[0] < values.min() and values.max() < DAYS[1]
    require(
        not (days and 0 < step < SHORT and abs(seconds - round(seconds)) < WHOLE * seconds),
        where,
        expected="times in s, or another unit that is stated",
        got=f"{values[0]:.10g}, … {step:.3g} apart, as days since 1900 of a spreadsheet "
        f"{seconds:.3g} s apart"
        if days
        else "",
        remedy="write dates as text (2026-01-31 12:00:00), or give the unit s if it is s",
    )


def times_that_are(
    values: NDArray, unit: str, clock: Clock, where: str
) -> tuple[NDArray, list[int], list[str]]:
    """Times (m,) in ns of the cells that are times, their rows, and why the others are none."""
    try:
        return row_times(values, unit, clock, where), list(range(len(values))), []
    except InputError:  # of a row or more
        parts, kept, bad = [np.empty(0, np.int64)], [], []
    for row, cell in enumerate(values):
        try:
            parts.append(row_times(values[row : row + 1], unit, clock, where))
            kept.append(row)
        except InputError as error:
            bad.append(f"time {str(cell)[:80]!r} in {where} ({error.expected})")
    return np.concatenate(parts), kept, bad


def increases(cells: NDArray) -> bool:
    """Whether cells may be times by their order alone: a guess, for what a user then checks."""
    try:
        times = row_times(cells, "", Clock(), "")
    except InputError:
        return False
    return len(times) > 1 and bool((np.diff(times) > 0).all())


def _number(cell: str) -> Decimal | None:
    text = cell.strip().replace(",", ".")
    try:
        float(text)  # which takes no signalling NaN
        return Decimal(text)
    except (ValueError, ArithmeticError):
        return None


def _parse(cells: NDArray, form: str, where: str) -> NDArray:
    """Times in ns of ISO 8601 text, or of text in a format of `strptime`; UTC without a zone.

    Without a format, other dates are read too if one of `DATES` fits to all.
    """
    texts = [str(each).strip() for each in cells]
    if not form and texts and _time(texts[0], "") is None:
        plain = [re.sub(r",(?=\d+$)", ".", each.replace(", ", " ")) for each in texts]
        forms = [f"{date} {hour}" for date in DATES for hour in HOURS]
        fitting = [own for own in forms if None not in (_time(text, own) for text in plain)]
        if len(fitting) > 1:
            raise _no_time(cells[0], f"{where}, where the day or the month may come first")
        if fitting:
            texts, form = plain, fitting[0]
    made = np.empty(len(texts), np.int64)
    for row, text in enumerate(texts):
        time = _time(text, form)
        if time is None:
            raise _no_time(text, f"{where}, row {row}", form)
        made[row] = nanoseconds(time)
    return made


def _time(text: str, form: str) -> datetime | None:
    """The time of a text in a format of `strptime`, or, for none, in that of ISO 8601."""
    try:
        return datetime.strptime(text, form) if form else datetime.fromisoformat(text)
    except ValueError:
        return None


def _no_time(cell: object, where: str, form: str = "") -> InputError:
    return InputError(
        where,
        expected=f"times in the format {form!r}"
        if form
        else "times: numbers, ISO 8601, or text in the format that a mapping states",
        got=repr(str(cell))[:60],
        remedy="repair or remove that row, name column and unit, or give "
        'format = "%d.%m.%Y %H:%M:%S,%f", or another, in [time] of a mapping',
    )
