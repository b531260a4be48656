"""How a text table is written: separator, decimal sign, lines before the header, and units."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TextIO

from retwin.checks import nothing, require
from retwin.data.logs.signals import named_units
from retwin.errors import InputError, brief

MISSING = frozenset({"", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "?"})
"""Cells that stand for a missing value, in small letters."""
TRUTH = {"true": "1", "false": "0", "on": "1", "off": "0"}
"""Cells that stand for 1 and 0."""
SEPARATORS = (";", "\t", ",", "|")
"""Separators in the order in which they are tried; blanks come last."""
HEAD = 200
"""Lines in which the header and the first rows of numbers are looked for."""
LONGEST = 2**20
"""Characters of a line at most."""
NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?inf|nan", re.IGNORECASE)
STARTS = re.compile(r"[+-]?[.,]?\d")
"""How a number begins, and hardly a title."""
ISO = re.compile(r"\d{4}-\d\d?-\d\d?[T ]|\d\d?[./]\d\d?[./]\d{2,4}|\d\d?:\d\d")

Row = Sequence[str]
"""The cells of a row."""


@dataclass(frozen=True)
class Layout:
    """How a text table is written.

    Attributes
    ----------
    encoding : str
        The encoding of its text.
    separator : str
        What is between cells; "" for blanks.
    first : int
        The line, from 0, of the first row of numbers.
    titles, names, units : tuple of str
        The title of each column, and its name and unit.

    """

    encoding: str
    separator: str
    first: int
    titles: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]

    def whole(self, row: Row) -> Row:
        """The cells of a row, without an empty one behind a separator at the end of the line.

        Raises ValueError if it has more or less than the table.
        """
        row = _trim(row, len(self.names))
        if len(row) != len(self.names):
            raise ValueError(f"{len(row)} of {len(self.names)} cells")
        return row

    def row(self, line: str, place: str) -> Row:
        """The cells of a row that is a line; ValueError if it is none of the table."""
        return self.whole(next(rows_of([line], self.separator, place, strict=True)))

    def column(self, name: str) -> int:
        """Where a column is, by its whole title or its name; ValueError if it is nowhere."""
        plain = name.strip()
        return (self.titles if plain in self.titles else self.names).index(plain)


def begin_of(path: Path) -> tuple[list[str], str]:
    """The first lines, and the encoding."""
    with path.open("rb") as binary:
        encoding = encoding_of(binary.read(2**20))
    with opened(path, encoding) as file:
        return list(islice(lines_of(file, path), HEAD)), encoding


def encoding_of(begin: bytes) -> str:
    """UTF-8, UTF-16 by its mark, else that of Western Windows, which has all bytes."""
    if begin[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    try:
        begin[: begin.rfind(b"\n") + 1].decode("utf-8")
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8-sig"


def opened(path: Path, encoding: str) -> TextIO:
    """The text of a file, with its ends of lines as they are."""
    return path.open(encoding=encoding, newline="")


def lines_of(file: TextIO, path: Path) -> Iterator[str]:
    """Lines of bounded length without zero characters."""
    while line := file.readline(LONGEST):
        textual = len(line) < LONGEST and "\0" not in line
        expected = f"lines of text of less than {LONGEST} characters"
        got = "a longer one" if len(line) == LONGEST else "a zero byte"
        remedy = "check that it is a text table, and whole"
        require(textual, path.name, expected=expected, got=got, remedy=remedy)
        yield line


def rows_of(
    lines: Iterable[str], separator: str, place: str, *, strict: bool = False
) -> Iterator[Row]:
    """The cells of lines; InputError where, if `strict`, quotation marks are not closed."""
    if not separator:
        yield from (line.split() for line in lines)
        return
    try:
        yield from csv.reader(lines, delimiter=separator, strict=strict)
    except csv.Error as error:
        expected = "a table of text"
        remedy = "check quotation marks, and that it is the right file"
        raise InputError(place, expected=expected, got=brief(error), remedy=remedy) from None


def text_layout(
    lines: Sequence[str], encoding: str, place: str, wanted: Sequence[str] = ()
) -> Layout:
    """How a table is written of which these are the first lines, `HEAD` at most.

    The header is the row with the titles that are wanted, with or without their units; if none are,
    or no row has them, it is above the first row of numbers.

    Raises
    ------
    InputError
        No row has the titles or numbers.

    """
    wanted = [each.strip() for each in wanted]
    found = _by_titles(lines, place, wanted) if wanted else None
    separator, first, titles, units = found or _by_numbers(lines, place)
    pairs = named_units([title.strip().lstrip("#").strip() for title in titles])
    own = [cell.strip().strip("[]()") for cell in units] or [""] * len(pairs)
    names = [name or f"column{i + 1}" for i, (name, _) in enumerate(pairs)]
    seen: dict[str, int] = {}
    for at, name in enumerate(names):
        seen[name] = seen.get(name, 0) + 1
        names[at] = name if seen[name] == 1 else f"{name}.{seen[name]}"
    every = tuple(unit or other for unit, (_, other) in zip(own, pairs, strict=True))
    stripped = tuple(title.strip() for title in titles)
    layout = Layout(encoding, separator, first, stripped, tuple(names), every)
    missing = [f"no column {each}" for each in wanted if each not in (*layout.titles, *names)]
    expected = f"a header with the columns {', '.join(wanted)}"
    nothing(place, missing, expected, remedy="name the columns as the file does")
    return layout


def _by_titles(
    lines: Sequence[str], place: str, wanted: Sequence[str]
) -> tuple[str, int, Row, Row] | None:
    """Separator, line of the first row, titles and units, where a row has the titles.

    A row of units below them has no numbers in the columns that are wanted. None if no row has
    them all.
    """
    for separator in SEPARATORS:
        rows = [next(rows_of([line], separator, place), []) for line in lines]
        for at, row in enumerate(rows):
            plain = [cell.strip() for cell in row]
            names = [name for name, _ in named_units([each.lstrip("#").strip() for each in plain])]
            if not {*plain, *names}.issuperset(wanted):
                continue
            width = len(row) - (not plain[-1])
            columns = [(plain if each in plain else names).index(each) for each in wanted]
            below = next((k for k in range(at + 1, len(rows)) if rows[k]), at + 1)
            units = _trim(rows[below], width) if below < len(rows) else ()
            some = [units[each] for each in columns] if len(units) == width else []
            if any(map(str.strip, some)) and not _holds_numbers(some, separator != ","):
                return separator, below + 1, row[:width], units
            return separator, at + 1, row[:width], ()
    return None


def _by_numbers(lines: Sequence[str], place: str) -> tuple[str, int, Row, Row]:
    """Separator, line of the first row of numbers, titles and units."""
    found = []
    for separator in (*SEPARATORS, ""):
        rows = list(rows_of(lines, separator, place))
        first = _first_row(rows, comma=separator != ",")
        several = first is not None and _width(rows, first) > 1
        if first is not None and (several or separator == ","):
            values = [cell for cell in rows[first] if cell.strip()]
            count = sum(_is_value(cell, separator != ",") for cell in values)
            # More numbers win; blanks only where nothing else separates.
            found.append(((several, bool(separator), count), separator, first, rows))
    expected = "a table of numbers"
    got = repr(lines[0].strip()[:60]) if lines else "an empty file"
    require(found, place, expected=expected, got=got, remedy="check that it is the right file")
    _, separator, first, rows = max(found, key=lambda each: each[0])
    width = _width(rows, first)
    head = [row[:width] for row in _head(rows[:first], width, place)][-2:]
    # A second row of titles holds units.
    if len(head) == 2 and all(head[0]):
        return separator, first, head[0], head[1]
    return separator, first, head[-1] if head else [""] * width, ()


def _trim(row: Row, width: int) -> Row:
    return row[:-1] if len(row) == width + 1 and not row[-1].strip() else row


def _width(rows: Sequence[Row], first: int) -> int:
    """The number of columns: one less where each line ends with a separator, and has no title."""
    count = len(rows[first])
    ends = [row[-1] for row in rows[first:] if len(row) == count]
    titled = any(row[-1].strip() for row in rows[:first] if len(row) == count)
    return count if count == 1 or titled or any(map(str.strip, ends)) else count - 1


def _head(rows: Sequence[Row], width: int, place: str) -> Sequence[Row]:
    """The rows above the numbers with a title, or a unit, for each column.

    Raises InputError for one that seems to hold damaged numbers, which would be left out.
    """
    full = [(number, row) for number, row in enumerate(rows, 1) if len(_trim(row, width)) == width]
    for number, row in full[1:]:
        filled = [cell.strip() for cell in row if cell.strip()]
        fits = not filled or not all(STARTS.match(cell) for cell in filled)
        expected = "numbers in the rows below its header"
        got = f"{' '.join(filled)[:60]!r} in line {number}"
        require(fits, place, expected=expected, got=got, remedy="repair or remove that line")
    return [row for _, row in full]


def _is_value(cell: str, comma: bool) -> bool:
    text = cell.strip()
    small = text.lower()
    if not comma and "," in text:
        return False
    return bool(small in MISSING or small in TRUTH or NUMBER.fullmatch(text))


def _holds_numbers(row: Row, comma: bool) -> bool:
    """Whether half of the cells that are filled are numbers or times, and one at least."""
    filled = [cell for cell in row if cell.strip()]
    count = sum(_is_value(cell, comma) or bool(ISO.match(cell.strip())) for cell in filled)
    return count > 0 and 2 * count >= len(filled)


def _first_row(rows: Sequence[Row], *, comma: bool, agreeing: int = 12) -> int | None:
    """The first row from which on all have the same number of cells, numbers among them.

    Parameters
    ----------
    agreeing : int, default 12
        Rows that must have the same number of columns.

    """
    for place, row in enumerate(rows):
        following = [each for each in rows[place : place + agreeing] if any(map(str.strip, each))]
        # The last line may be cut off; the rows below say so when they are read.
        same = following[: max(1, len(following) - 1)]
        if any(map(str.strip, row)) and all(
            len(each) == len(row) and _holds_numbers(each, comma) for each in same
        ):
            return place
    return None
