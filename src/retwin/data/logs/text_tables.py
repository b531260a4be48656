"""CSV tables of any separator, with lines before the header, units, and decimal commas."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from retwin.data.logs.signals import Clock, Signal, Skipped, named_unit
from retwin.data.logs.tables import MISSING, TRUTH, numbers, table_signals, time_column
from retwin.errors import InputError, brief

SEPARATORS = (";", "\t", ",", "|")
"""Separators in the order in which they are tried; blanks come last."""
HEAD = 200
"""Lines in which the header and the first rows of numbers are looked for."""
AGREEING = 12
"""Rows that must have the same number of columns."""
LONGEST = 2**20
"""Characters of a line at most."""
BLOCK = 65_536
"""Rows that are converted together."""
TEXT_SHARE = 0.5
"""The share of cells that are no numbers from which a column is text."""
NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?inf|nan", re.IGNORECASE)
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(e[+-]?\d+)?")
STARTS = re.compile(r"[+-]?[.,]?\d")
"""How a number begins, and hardly a title."""
ISO = re.compile(r"\d{4}-\d\d?-\d\d?[T ]|\d\d?[./]\d\d?[./]\d{2,4}|\d\d?:\d\d")


@dataclass(frozen=True)
class TextLayout:
    """How a text table is written.

    Attributes
    ----------
    encoding : str
        The encoding of its text.
    separator : str
        What is between cells; "" for blanks.
    first : int
        The line, from 0, of the first row of numbers.
    names, units : tuple of str
        The title and the unit of each column.
    comma : bool
        Whether decimals are after a comma.

    """

    encoding: str
    separator: str
    first: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    comma: bool

    def cells(self, line: str) -> Sequence[str]:
        """The cells of a row; ValueError or csv.Error if it has more or less than the table."""
        if self.separator:
            (cells,) = csv.reader([line], delimiter=self.separator, strict=True)
        else:
            cells = line.split()
        row = trimmed(cells, len(self.names))
        if len(row) != len(self.names):
            raise ValueError(f"{len(row)} of {len(self.names)} cells")
        return row


def trimmed(row: Sequence[str], width: int) -> Sequence[str]:
    """The cells of a row, without an empty one behind a separator at the end of the line."""
    return row[:-1] if len(row) == width + 1 and not row[-1].strip() else row


def read(path: Path, wanted: frozenset[str] | None, clock: Clock) -> Iterator[Signal | Skipped]:
    """The signals of a text table; see `data.logs.signals.Reader`.

    Raises
    ------
    InputError
        It is no table of numbers, or a row has another number of cells than the first one.

    """
    layout = text_layout(*_begin(path), path)
    titles = dict(zip(layout.names, layout.units, strict=True))
    kept = set(titles) if wanted is None else {clock.column, *wanted} & set(titles)
    if wanted is not None and not clock.rate:  # the column of times may be found by its name
        kept = set(titles) if not clock.column else kept
    parts: dict[str, list[NDArray]] = {name: [] for name in titles if name in kept}
    count = 0
    # At a rate, a row without values is a sample too: without it, later ones would come earlier.
    even = bool(clock.rate or (clock.otherwise and not (clock.column or time_column(titles))))
    for block in _blocks(path, layout, empty=even):
        count += len(block)
        columns = list(zip(*block, strict=True))
        for place, name in enumerate(layout.names):
            if name in parts:
                # As numbers at once, where they are: text takes several times the memory.
                parts[name].append(_compact(np.array(columns[place], np.str_)))

    def cells(name: str) -> NDArray:
        own = parts[name]
        return np.concatenate(own) if own else np.empty(0)

    def column(name: str) -> tuple[NDArray, int] | str:
        found, bad = numbers(cells(name), comma=layout.comma)
        return "text" if count and bad > TEXT_SHARE * count else (found, bad)

    yield from table_signals(path.name, titles, column, cells, count, clock, wanted)


def read_cells(path: Path, wanted: Sequence[str]) -> tuple[dict[str, list[str]], bool]:
    """The cells of columns that are named by their titles, as they are written.

    Rows of empty cells stay: each row may be a sample at a given rate.

    Parameters
    ----------
    path : Path
        A table whose titles stand in one of the first `HEAD` rows.
    wanted : sequence of str
        Titles of columns.

    Returns
    -------
    cells : dict of str to list of str
        By title, a cell for each row below the titles.
    comma : bool
        Whether decimals are after a comma.

    Raises
    ------
    InputError
        A column is missing, a row has another number of cells than the titles, or quotation marks
        are not closed.

    """
    plain = {title.strip() for title in wanted}
    lines, encoding = _begin(path)
    tables = [(each, list(_rows(iter(lines), each, path))) for each in SEPARATORS]
    found = [
        (separator, rows, place)
        for separator, rows in tables
        for place, row in enumerate(rows)
        if {cell.strip() for cell in row}.issuperset(plain)
    ]
    if not found:
        titles = max((rows[0] for _, rows in tables if rows), key=len, default=[])
        raise InputError(
            path.name,
            expected=f"a header with the columns {', '.join(wanted)}",
            got=f"no column {', '.join(sorted(plain - {each.strip() for each in titles}))}",
            remedy="name the columns as the file does",
        )
    separator, rows, place = found[0]
    names = tuple(cell.strip() for cell in rows[place])
    comma = decimal_comma(rows[place + 1 :], separator)
    layout = TextLayout(encoding, separator, place + 1, names, ("",) * len(names), comma)
    cells: dict[str, list[str]] = {name: [] for name in wanted}
    for block in _blocks(path, layout, empty=True, strict=True):
        for name, own in cells.items():
            at = names.index(name.strip())
            own += [row[at] for row in block]
    return cells, comma


def _compact(cells: NDArray) -> NDArray:
    try:
        return cells.astype(float)
    except ValueError:
        return cells


def _opened(path: Path, encoding: str) -> TextIO:
    return path.open(encoding=encoding, newline="")


def _blocks(
    path: Path, layout: TextLayout, *, empty: bool, strict: bool = False
) -> Iterator[list[Sequence[str]]]:
    """The rows of a table, block by block.

    With `empty`, rows of empty cells are kept; if `strict`, quotation marks must be closed.
    """
    width = len(layout.names)
    with _opened(path, layout.encoding) as file:
        lines = _lines(file, path)
        for _ in range(layout.first):
            next(lines)
        block: list[Sequence[str]] = []
        rows = _rows(lines, layout.separator, path, strict=strict)
        for number, row in enumerate(rows, layout.first + 1):
            if not row or not (empty or any(cell.strip() for cell in row)):
                continue
            row = trimmed(row, width)
            if len(row) != width:
                raise InputError(
                    path.name,
                    expected=f"{width} cells in every row, as in its header",
                    got=f"{len(row)} in line {number}",
                    remedy="repair or remove that line; the last one of a log may be cut off",
                )
            block.append(row)
            if len(block) == BLOCK:
                yield block
                block = []
        if block:
            yield block


def _lines(file: TextIO, path: Path) -> Iterator[str]:
    """Lines of bounded length without zero characters."""
    while line := file.readline(LONGEST):
        if len(line) == LONGEST or "\0" in line:
            raise InputError(
                path.name,
                expected=f"lines of text of less than {LONGEST} characters",
                got="a longer one" if len(line) == LONGEST else "a zero byte",
                remedy="check that it is a text table, and whole",
            )
        yield line


def _rows(
    lines: Iterator[str], separator: str, path: Path, *, strict: bool = False
) -> Iterator[Sequence[str]]:
    if not separator:
        yield from (line.split() for line in lines)
        return
    try:
        yield from csv.reader(lines, delimiter=separator, strict=strict)
    except csv.Error as error:
        raise InputError(
            path.name,
            expected="a table of text",
            got=brief(error),
            remedy="check quotation marks, and that it is the right file",
        ) from None


def _begin(path: Path) -> tuple[list[str], str]:
    """The first lines, and the encoding."""
    encoding = _encoding(path)
    with _opened(path, encoding) as file:
        return list(islice(_lines(file, path), HEAD)), encoding


def text_layout(lines: Sequence[str], encoding: str, path: Path) -> TextLayout:
    """How a table is written of which these are the first lines, `HEAD` at most.

    Raises
    ------
    InputError
        They hold no row of numbers.

    """
    best: tuple[int, int, str] | None = None
    for separator in (*SEPARATORS, ""):
        rows = list(_rows(iter(lines), separator, path))
        first = _first_row(rows, comma=separator != ",")
        if first is not None:
            # More numbers win; blanks only where nothing else separates.
            count = sum(_is_value(cell, separator != ",") for cell in rows[first] if cell.strip())
            if _width(rows, first) > 1 and (best is None or (count > best[0] and separator)):
                best = (count, first, separator)
    if best is None:
        rows = list(_rows(iter(lines), ",", path))
        first = _first_row(rows, comma=False)
        if first is None:
            raise InputError(
                path.name,
                expected="a table of numbers",
                got=repr(lines[0].strip()[:60]) if lines else "an empty file",
                remedy="check that it is the right file",
            )
        best = (1, first, ",")
    _, first, separator = best
    rows = list(_rows(iter(lines), separator, path))
    width = _width(rows, first)
    names, units = _titles(_head(rows[:first], width, path), width)
    comma = decimal_comma(rows[first:], separator)
    return TextLayout(encoding, separator, first, names, units, comma)


def decimal_comma(rows: Sequence[Sequence[str]], separator: str) -> bool:
    """Whether decimals are after a comma in some cell."""
    cells = (cell.strip() for row in rows for cell in row)
    return separator != "," and any(DECIMAL_COMMA.fullmatch(cell) for cell in cells)


def _encoding(path: Path) -> str:
    """UTF-8, UTF-16 by its mark, else the encoding of Western Windows, which has all bytes."""
    with path.open("rb") as file:
        begin = file.read(2**20)
    if begin[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    try:
        begin[: begin.rfind(b"\n") + 1].decode("utf-8")
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8-sig"


def _width(rows: Sequence[Sequence[str]], first: int) -> int:
    """The number of columns: one less where each line ends with a separator, and has no title."""
    count = len(rows[first])
    ends = [row[-1] for row in rows[first:] if len(row) == count]
    titled = any(row[-1].strip() for row in rows[:first] if len(row) == count)
    return count if count == 1 or titled or any(map(str.strip, ends)) else count - 1


def _head(rows: Sequence[Sequence[str]], width: int, path: Path) -> Sequence[Sequence[str]]:
    """The rows above the numbers with a title, or a unit, for each column.

    Raises InputError for one that seems to hold damaged numbers, which would be left out.
    """
    full = [
        (number, row) for number, row in enumerate(rows, 1) if len(trimmed(row, width)) == width
    ]
    for number, row in full[1:]:
        filled = [cell.strip() for cell in row if cell.strip()]
        if filled and all(STARTS.match(cell) for cell in filled):
            raise InputError(
                path.name,
                expected="numbers in the rows below its header",
                got=f"{' '.join(filled)[:60]!r} in line {number}",
                remedy="repair or remove that line",
            )
    return [row for _, row in full]


def _is_value(cell: str, comma: bool) -> bool:
    text = cell.strip()
    small = text.lower()
    if not comma and "," in text:
        return False
    return bool(small in MISSING or small in TRUTH or NUMBER.fullmatch(text))


def _first_row(rows: Sequence[Sequence[str]], *, comma: bool) -> int | None:
    """The first row from which on all have the same number of cells, numbers among them."""

    def holds_numbers(row: Sequence[str]) -> bool:
        values = sum(_is_value(cell, comma) and bool(cell.strip()) for cell in row)
        stamps = sum(bool(ISO.match(cell.strip())) for cell in row)
        return values + stamps > 0 and 2 * (values + stamps) >= sum(bool(c.strip()) for c in row)

    for place, row in enumerate(rows):
        following = [each for each in rows[place : place + AGREEING] if any(map(str.strip, each))]
        # The last line may be cut off; the rows below say so when they are read.
        same = following[: max(1, len(following) - 1)]
        filled = any(map(str.strip, row))
        if filled and all(len(each) == len(row) and holds_numbers(each) for each in same):
            return place
    return None


def _titles(head: Sequence[Sequence[str]], width: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the columns, from the rows before the first one of numbers."""
    named = [row[:width] for row in head][-2:]
    units = [""] * width
    if not named:
        names = [f"column{i + 1}" for i in range(width)]
    else:
        # A second row of titles holds units: they are shorter, or in brackets.
        two = len(named) == 2 and all(named[0])
        titles = named[0] if two else named[-1]
        pairs = [named_unit(title.strip().lstrip("#").strip()) for title in titles]
        names, units = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
        if two:
            units = [
                cell.strip().strip("[]()") or own for cell, own in zip(named[1], units, strict=True)
            ]
    names = [name or f"column{i + 1}" for i, name in enumerate(names)]
    seen: dict[str, int] = {}
    for place, name in enumerate(names):
        seen[name] = seen.get(name, 0) + 1
        names[place] = name if seen[name] == 1 else f"{name}.{seen[name]}"
    return tuple(names), tuple(units)
