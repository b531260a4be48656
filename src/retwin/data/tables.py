"""Tables of any format: the cells of their columns as numbers, times and signals.

`data.layout` recognises how a text table is written, and `data.row_times` what its times mean.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.layout import (
    MISSING,
    TRUTH,
    Layout,
    Row,
    begin_of,
    lines_of,
    opened,
    rows_of,
    text_layout,
)
from retwin.data.logs.signals import UNWANTED, Clock, Signal, Skipped, even_times
from retwin.data.row_times import increases, row_times, time_column, unit_in
from retwin.errors import InputError, brief

TIMES = "times"
"""Why a column of times is no signal."""
EVEN = "no times: rows at a given rate"
"""What is noted of a table without a column of times."""
THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
"""A number with a comma that may stand before decimals or before thousands."""


@dataclass(frozen=True)
class Table:
    """The columns of a table, each of which is converted when it is wanted.

    Attributes
    ----------
    place : str
        The table, for messages.
    units : mapping of str to str
        The unit of each column, "" if the table states none.
    rows : int
        The number of rows.
    cells : callable
        Gives the cells (rows,) of a column: numbers, datetime64 or text.
    comma : bool
        Whether decimals in text may be after a comma.
    others : mapping of str to str
        Why columns hold no numbers, by the type that the table states.

    """

    place: str
    units: Mapping[str, str]
    rows: int
    cells: Callable[[str], NDArray]
    comma: bool = False
    others: Mapping[str, str] = field(default_factory=dict)

    def numbers(self, name: str) -> tuple[NDArray, NDArray]:
        """The numbers (rows,) in a column, NaN where one is missing, and which are no numbers."""
        cells = self.cells(name)
        bad = np.zeros(len(cells), bool)
        try:
            return cells.astype(float), bad
        except (TypeError, ValueError):
            made = np.full(len(cells), np.nan)
        for row, cell in enumerate(cells.tolist()):
            text = str(cell).strip()
            small = text.lower()
            try:
                made[row] = float(TRUTH.get(small, text.replace(",", ".") if self.comma else text))
            except ValueError:
                bad[row] = small not in MISSING
        return made, bad

    def time_name(self, clock: Clock) -> str:
        """The column of the times, stated or by its name; "" for rows at a rate.

        Raises InputError where there is neither.
        """
        name = clock.column or ("" if clock.rate else time_column(self.units))
        names = list(self.units)
        fits = name in names or (not name and (clock.rate or clock.otherwise))
        expected = f"a column of times{f' {clock.column!r}' * bool(clock.column)}"
        got = f"the columns {', '.join(names[:12])}{', …' * (len(names) > 12)}"
        remedy = "name it in the mapping: [time] column = …, or give the rows per s: rate = …"
        require(fits, self.place, expected=expected, got=got, remedy=remedy)
        return name

    def stamps(self, name: str) -> tuple[NDArray, str, str]:
        """The cells of a column of times, their unit, and the column for messages."""
        return self.cells(name), self.units[name] or unit_in(name), f"{self.place}, column {name!r}"

    def signals(self, clock: Clock, wanted: frozenset[str] | None) -> Iterator[Signal | Skipped]:
        """The signals of the columns that are wanted, of all where that is None.

        Raises InputError where there is no column of times, or it holds something else.
        """
        if wanted is None and not (clock.column or clock.rate or clock.otherwise):
            clock = Clock(self._likely_times(), clock.unit, clock.format)
        name = self.time_name(clock)
        if name:
            stamps, unit, where = self.stamps(name)
            times = row_times(stamps, unit, clock, where)
        else:
            times = even_times(self.rows, clock.rate or clock.otherwise or 1.0, self.place)
        yield Skipped(name, TIMES if name else EVEN)
        for title, unit in self.units.items():
            if title == name:
                continue
            if wanted is not None and title not in wanted:
                yield Skipped(title, UNWANTED)
            elif title in self.others:
                yield Skipped(title, self.others[title])
            else:
                values, bad = self.numbers(title)
                # The share of cells that are no numbers from which a column is text.
                text = self.rows and bad.sum() > 0.5 * self.rows
                yield (
                    Skipped(title, "text")
                    if text
                    else Signal(title, times, values, unit, int(bad.sum()), self._read(title))
                )

    def _read(self, name: str) -> str:
        """How numbers such as 1,234 are read, of which all may be thousands; "" elsewhere."""
        cells = self.cells(name)
        text = self.comma and cells.dtype.kind == "U"
        found = [cell.strip() for cell in cells.tolist() if "," in cell] if text else []
        if not found or not all(map(THOUSANDS.fullmatch, found)):
            return ""
        return f"{found[0]} is read as {found[0].replace(',', '.')}, and not as thousands"

    def _likely_times(self) -> str:
        """The column of times by its name, else the first one of dates, else one that increases."""
        dated = (each for each in self.units if self.cells(each).dtype.kind == "M")
        first = (each for each in list(self.units)[:1] if increases(self.cells(each)))
        return time_column(self.units) or next(dated, next(first, ""))


def read(path: Path, wanted: frozenset[str] | None, clock: Clock) -> Iterator[Signal | Skipped]:
    """The signals of a text table; see `data.logs.signals.Reader`.

    Raises
    ------
    InputError
        It is no table of numbers, or a row has another number of cells than the first one.

    """
    layout = text_layout(*begin_of(path), path.name)
    names = layout.names
    kept = names if wanted is None else [n for n in names if n in {clock.column, *wanted}]
    if wanted is not None and not (clock.rate or clock.column):
        kept = names  # the column of times is found by its name
    # At a rate, a row without values is a sample too: without it, later ones would come earlier.
    even = bool(clock.rate or (clock.otherwise and not (clock.column or time_column(names))))
    yield from _read_columns(path, layout, kept, empty=even).signals(clock, wanted)


def text_table(place: str, layout: Layout, rows: int, cells: Mapping[str, NDArray]) -> Table:
    """A table with the cells (rows,) of some columns, by the names by which they are wanted."""
    units = {each: layout.units[layout.column(each)] for each in (*layout.names, *cells)}
    return Table(place, units, rows, cells.__getitem__, layout.separator != ",")


def read_titled(path: Path, wanted: Sequence[str]) -> Table:
    """The columns of a text table that are named by their titles, with or without the units.

    Rows of empty cells stay: each row may be a sample at a given rate.

    Raises
    ------
    InputError
        A column is missing, a row has another number of cells than the titles, or quotation marks
        are not closed.

    """
    try:
        layout = text_layout(*begin_of(path), path.name, wanted)
        return _read_columns(path, layout, wanted, empty=True, strict=True)
    except (OSError, UnicodeError) as error:
        got = getattr(error, "strerror", None) or f"{type(error).__name__}: {brief(error)}"
        remedy = "check the name of the file, and that it is the right one"
        raise InputError(str(path), expected="a table of text", got=got, remedy=remedy) from None


def _read_columns(
    path: Path, layout: Layout, names: Sequence[str], *, empty: bool, strict: bool = False
) -> Table:
    """Some columns of a table.

    With `empty`, rows of empty cells are kept; if `strict`, quotation marks must be closed.
    """
    parts: dict[str, list[NDArray]] = {name: [np.empty(0)] for name in names}
    places = {name: layout.column(name) for name in names}
    count = 0
    for block in _blocks(path, layout, empty=empty, strict=strict):
        count += len(block)
        cells = list(zip(*block, strict=True))
        for name, place in places.items():
            # As numbers at once, where they are: text takes several times the memory.
            parts[name] = [p for p in parts[name] if len(p)]
            parts[name].append(_compact(np.array(cells[place], np.str_)))
    columns = {name: np.concatenate(own) for name, own in parts.items()}
    return text_table(path.name, layout, count, columns)


def _compact(cells: NDArray) -> NDArray:
    try:
        return cells.astype(float)
    except ValueError:
        return cells


def _blocks(path: Path, layout: Layout, *, empty: bool, strict: bool) -> Iterator[list[Row]]:
    """The rows of a table, block by block."""
    with opened(path, layout.encoding) as file:
        lines = lines_of(file, path)
        rows = rows_of(
            islice(lines, layout.first, None), layout.separator, path.name, strict=strict
        )
        block: list[Row] = []
        for number, row in enumerate(rows, layout.first + 1):
            if not row or not (empty or any(cell.strip() for cell in row)):
                continue
            try:
                block.append(layout.whole(row))
            except ValueError:
                expected = f"{len(layout.names)} cells in every row, as in its header"
                got = f"{len(row)} in line {number}"
                remedy = "repair or remove that line; the last one of a log may be cut off"
                raise InputError(path.name, expected=expected, got=got, remedy=remedy) from None
            # Rows that are converted together.
            if len(block) == 65_536:
                yield block
                block = []
        if block:
            yield block
