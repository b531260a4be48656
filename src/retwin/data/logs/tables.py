"""Tables whose rows have a time: the column of the times, and the signals of the others."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from retwin.data.logs.signals import (
    UNIT_SECONDS,
    UNWANTED,
    Clock,
    Signal,
    Skipped,
    even_times,
    nanoseconds,
    to_nanoseconds,
)
from retwin.errors import InputError

TIME_NAMES = ("time", "timestamp", "timestamps", "t", "datetime", "date", "zeit", "stamp", "clock")
"""Names by which a column of times is found, the most certain first."""
TIMES = "times"
"""Why a column of times is no signal."""
EVEN = "no times: rows at a given rate"
"""What is noted of a table without a column of times."""
MISSING = frozenset({"", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "?"})
"""Cells that stand for a missing value, in small letters."""
TRUTH = {"true": "1", "false": "0", "on": "1", "off": "0"}
"""Cells that stand for 1 and 0."""
DATES = ("%d.%m.%Y", "%m/%d/%Y", "%d/%m/%Y", "%Y/%m/%d", "%Y-%m-%d")
HOURS = ("%H:%M:%S", "%H:%M:%S.%f", "%H:%M", "%I:%M:%S %p", "%I:%M:%S.%f %p", "%I:%M %p")
"""Formats of dates and of what follows them, of which one is taken that alone fits to all."""
EPOCHS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""The least times since 1970 in these units; smaller ones are in s."""


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
    return last if last in UNIT_SECONDS else ""


def row_times(values: NDArray, unit: str, clock: Clock, where: str) -> NDArray:
    """Times (n,) in ns of the cells of a column.

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
        return _known(values.astype("datetime64[ns]").astype(np.int64), np.isnat(values), where)
    if values.dtype.kind in "OUS":
        if clock.format or clock.unit == "iso":
            return _parsed(values, clock.format, where)
        found = np.array([_number(cell) for cell in values.tolist()], dtype=object)
        text = np.array([each is None for each in found], dtype=bool)
        if text.any():
            row = int(np.argmax(text))
            if clock.unit or row:  # the others are numbers
                raise _no_time(values[row : row + 1], f"{where}, row {row}")
            return _parsed(values, "", where)
        values = found.astype(float)
    stated = clock.unit or {"sec": "s", "seconds": "s", "µs": "us", "μs": "us"}.get(unit, unit)
    if stated not in UNIT_SECONDS:
        size = float(np.nanmax(np.abs(values), initial=0.0)) if len(values) else 0.0
        stated = next((name for least, name in EPOCHS if size > least), "s")
    return to_nanoseconds(values, stated, where)


def _number(cell: object) -> float | None:
    try:
        return float(str(cell).replace(",", "."))
    except ValueError:
        return None


def _increases(cells: NDArray) -> bool:
    """Whether cells may be times by their order alone: a guess, for what a user then checks."""
    try:
        times = row_times(cells, "", Clock(), "")
    except InputError:
        return False
    return len(times) > 1 and bool((np.diff(times) > 0).all())


def _known(times: NDArray, missing: NDArray, where: str) -> NDArray:
    if missing.any():
        raise InputError(
            where,
            expected="a time in every row",
            got=f"none in row {int(np.argmax(missing))}",
            remedy="remove that row, or name another column in [time] of the mapping",
        )
    return times


def _parsed(cells: NDArray, form: str, where: str) -> NDArray:
    """Times in ns of ISO 8601 text, or of text in a format of `strptime`; UTC without a zone.

    Without a format, other dates are read too if one of `DATES` fits to all.
    """
    made = np.empty(len(cells), np.int64)
    if not form and len(cells) and not _fits(str(cells[0]).strip(), ""):
        texts = [str(each).strip().replace(", ", " ") for each in cells]
        forms = [f"{date} {hour}" for date in DATES for hour in HOURS]
        fitting = [each for each in forms if all(_fits(text, each) for text in texts)]
        if len(fitting) > 1:
            raise _no_time(cells[:1], f"{where}, where the day or the month may come first")
        if fitting:
            cells, form = np.array(texts), fitting[0]
    for row, cell in enumerate(cells):
        text = str(cell).strip()
        try:
            time = datetime.strptime(text, form) if form else datetime.fromisoformat(text)
        except ValueError:
            raise _no_time(cells[row : row + 1], f"{where}, row {row}") from None
        made[row] = nanoseconds(time)
    return made


def _fits(text: str, form: str) -> bool:
    """Whether a text is a time in a format of `strptime`, or, for none, in that of ISO 8601."""
    try:
        datetime.strptime(text, form) if form else datetime.fromisoformat(text)
    except ValueError:
        return False
    return True


def _no_time(cells: NDArray, where: str) -> InputError:
    return InputError(
        where,
        expected="times: numbers, ISO 8601, or text in the format of [time] in the mapping",
        got=repr(str(cells[0]))[:60] if len(cells) else "none",
        remedy="repair or remove that row, name column and unit, or give "
        'format = "%d.%m.%Y %H:%M:%S", in [time]',
    )


def numbers(cells: NDArray, *, comma: bool = False) -> tuple[NDArray, int]:
    """Cells (n,) of text as numbers, NaN where one is missing, and how many are no numbers.

    `comma` states that decimals are after a comma.
    """
    try:
        return cells.astype(float), 0
    except ValueError:
        pass
    made = np.full(len(cells), np.nan)
    bad = 0
    for row, cell in enumerate(cells.tolist()):
        text = str(cell).strip()
        small = text.lower()
        text = TRUTH.get(small, text.replace(",", ".") if comma else text)
        try:
            made[row] = float(text)
        except ValueError:
            bad += small not in MISSING
    return made, bad


def table_signals(
    place: str,
    titles: Mapping[str, str],
    column: Callable[[str], tuple[NDArray, int] | str],
    stamps: Callable[[str], NDArray],
    rows: int,
    clock: Clock,
    wanted: frozenset[str] | None,
) -> Iterator[Signal | Skipped]:
    """The signals of one table.

    Parameters
    ----------
    place : str
        The table, for messages.
    titles : mapping of str to str
        The unit of each column.
    column : callable
        Gives a column's numbers (n,) and how many cells are none, or why it has no numbers.
    stamps : callable
        Gives the cells of a column that may hold times.
    rows : int
        The number of rows.
    clock : Clock
        Where the times are.
    wanted : frozenset of str or None
        The names of the columns to give.

    Raises
    ------
    InputError
        There is no column of times, or it holds something else.

    """
    name = clock.column or ("" if clock.rate else time_column(titles))
    rate = clock.rate or (None if name else clock.otherwise)
    if not name and not rate and wanted is None:
        dated = (each for each in titles if stamps(each).dtype.kind == "M")
        name = next(
            dated, next((each for each in list(titles)[:1] if _increases(stamps(each))), "")
        )
    if (not name and not rate) or (name and name not in titles):
        raise InputError(
            place,
            expected=f"a column of times{f' {clock.column!r}' * bool(clock.column)}",
            got=f"the columns {', '.join(list(titles)[:12])}{', …' * (len(titles) > 12)}",
            remedy="name it in the mapping: [time] column = …, or give the rows per s: rate = …",
        )
    if name:
        unit = titles[name] or unit_in(name)
        times = row_times(stamps(name), unit, clock, f"{place}, column {name!r}")
        yield Skipped(name, TIMES)
    else:
        times = even_times(rows, rate or 1.0, place)
        yield Skipped("", EVEN)
    for title, unit in titles.items():
        if title == name:
            continue
        if wanted is not None and title not in wanted:
            yield Skipped(title, UNWANTED)
            continue
        found = column(title)
        if isinstance(found, str):
            yield Skipped(title, found)
        else:
            yield Signal(title, times, found[0], unit, found[1])
