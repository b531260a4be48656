"""Tables of samples that grow: which rows of a CSV or Parquet file were not read yet."""

from __future__ import annotations

import csv
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from decimal import Decimal
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from retwin.cases.case import Case
from retwin.cases.columns import ColumnRecords, number
from retwin.checks import needs_extra, require, same_names
from retwin.data.logs.signals import nanoseconds
from retwin.errors import InputError, brief
from retwin.monitor.settings import FolderSource

CHUNK = 2**16
"""Bytes of a CSV file, and of one of its rows, that are read at once."""
ROWS = 8192
"""Rows of a Parquet file that are read at once."""
TAIL = 256
"""Bytes before the place up to which a file was read that are compared before it is read on."""
NANOSECONDS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}


@dataclass(frozen=True)
class Layout:
    """Where a table has the times, and each channel: the mean of its columns."""

    time: str
    unit: str
    columns: tuple[tuple[str, ...], ...]

    @property
    def wanted(self) -> list[str]:
        """All columns, that of the times first."""
        return [self.time, *dict.fromkeys(each for own in self.columns for each in own)]

    def nanoseconds(self, cell: str) -> int:
        """The time in a cell, from 1970 on; ValueError if it is none."""
        if self.unit == "iso":
            return nanoseconds(datetime.fromisoformat(cell.strip()))
        found = Decimal(cell.strip()) * NANOSECONDS[self.unit]
        if not abs(found) < 2**63:
            raise ValueError("a time that is out of range")
        return round(found)

    def values(self, cells: Mapping[str, NDArray]) -> NDArray:
        """The channels (n, d) of columns (n,)."""
        found = [np.mean([cells[each] for each in own], axis=0) for own in self.columns]
        made = np.array(found, dtype=float).reshape(len(self.columns), -1).T
        return np.where(np.isfinite(made), made, np.nan)

    def table(self, path: Path) -> Table:
        """What reads that file, by its suffix."""
        return (Parquet if path.suffix == ".parquet" else Csv)(path, self)


@dataclass(frozen=True)
class Rows:
    """Rows of a table: times (n,) in ns, values (n, d), and why rows between them are no samples.

    `end` is what the table continues from.
    """

    times: NDArray
    values: NDArray
    bad: list[str]
    end: Any


def layout_of(settings: FolderSource, channels: Sequence[str], case: Case | None) -> Layout:
    """The columns of the settings, else those of the case's records, else names of the channels.

    Raises
    ------
    InputError
        A channel has no column, or there is another; or the records of the case differ.

    """
    records = case.records if case is not None else None
    known = records.every_record if isinstance(records, ColumnRecords) else ()
    columns = settings.columns or _same(
        [dict(each.columns) for each in known], "columns", {name: name for name in channels}
    )
    remedy = 'write for each channel NAME = "COLUMN"'
    same_names("sources.columns", columns, channels, "a column for each of", remedy=remedy)
    clocks = [each.clock for each in known if each.clock is not None]
    time = settings.time or _same([each.column for each in clocks], "time", "time")
    unit = settings.unit or _same([each.unit for each in clocks], "unit", "s")
    several = [columns[name] for name in channels]
    return Layout(time, unit, tuple((e,) if isinstance(e, str) else tuple(e) for e in several))


class Columns(Protocol):
    """What a table must have."""

    @property
    def wanted(self) -> list[str]:
        """The columns that are read."""


class Table(ABC):
    """A file of rows that may grow, or be replaced by another one of that name.

    Parameters
    ----------
    path : Path
        The file.
    layout : Columns
        Its columns.

    """

    layout: Columns

    def __init__(self, path: Path, layout: Columns) -> None:
        self.path = path
        self.layout = layout
        self.place: Any = None
        """How far it was read; None from its begin."""
        self._seen: tuple[int, ...] = ()

    def changed(self) -> bool:
        """Whether the file was written to, or replaced, since this was last called."""
        about = os.stat(self.path)
        now = (about.st_ino, about.st_size, about.st_mtime_ns)
        before, self._seen = self._seen, now
        return before != now

    def rows(self) -> Iterator[Rows]:
        """New rows part by part; after each, set `place` to its end to have read it.

        Where the file was replaced or truncated, or its begin was changed, all rows are new again.
        Raises InputError where it is no table, or lacks a column.
        """
        try:
            yield from self._rows()
        except InputError:
            raise
        except Exception as error:  # of the libraries too, whose classes are many
            raise InputError(
                str(self.path),
                expected=f"a table with columns {', '.join(self.layout.wanted)}",
                got=f"{type(error).__name__}: {brief(error)}",
                remedy="correct it, or name the columns as the file does",
            ) from None

    @abstractmethod
    def _rows(self) -> Iterator[Rows]:
        """See `rows`; any exception is turned into an InputError there."""


@dataclass(frozen=True)
class _Place:
    """How far a text table was read: bytes, those before, and what is known of the table."""

    offset: int = 0
    tail: bytes = b""
    known: Any = None


class TextTable(Table):
    """Rows of text. An incomplete last one waits for its end."""

    @abstractmethod
    def _parsed(self, text: bytes, known: Any) -> Rows | None:
        """Complete lines, and what is known of the table after them as the end.

        `known` is None at the begin of the file. None is returned if the lines hold no row yet.
        """

    def _rows(self) -> Iterator[Rows]:
        with self.path.open("rb") as file:
            place = self._kept(file)
            while True:
                file.seek(place.offset)
                chunk = file.read(CHUNK)
                text = chunk[: chunk.rfind(b"\n") + 1]
                if len(chunk) == CHUNK and not text:
                    raise ValueError(f"a row of more than {CHUNK} bytes")
                made = self._parsed(text, place.known) if text else None
                if made is None:
                    return
                place = _Place(place.offset + len(text), (place.tail + text)[-TAIL:], made.end)
                yield replace(made, end=place)

    def _kept(self, file: Any) -> _Place:
        """How far the file was read, if it still is the same up to there."""
        place = self.place or _Place()
        file.seek(place.offset - len(place.tail))
        return place if file.read(len(place.tail)) == place.tail else _Place()


class Csv(TextTable):
    """A CSV file with a header."""

    layout: Layout

    def _parsed(self, text: bytes, known: tuple[str, ...] | None) -> Rows:
        lines = text.decode("utf-8", "replace").split("\n")
        header = known or ()
        if known is None:
            header = tuple(next(csv.reader([lines[0].removeprefix("\ufeff")])))
            missing = [each for each in self.layout.wanted if each not in header]
            if missing:
                raise ValueError(f"no column {', '.join(missing)} in its header")
            lines = lines[1:]
        at = {name: header.index(name) for name in self.layout.wanted}
        times: list[int] = []
        cells: list[list[float]] = []
        bad: list[str] = []
        clock = at.pop(self.layout.time)
        for line in lines:
            if not line.strip():
                continue
            try:
                (row,) = csv.reader([line], strict=True)
                if len(row) != len(header):
                    raise ValueError(f"{len(row)} of {len(header)} cells")
                found = [number(row[column]) for column in at.values()]
                times.append(self.layout.nanoseconds(row[clock]))
                cells.append(found)
            except (ValueError, ArithmeticError, csv.Error) as error:
                bad.append(f"{line[:80]!r} in {self.path.name} ({brief(error)})")
        table = np.array(cells, dtype=float).reshape(len(cells), len(at))
        values = self.layout.values(dict(zip(at, table.T, strict=True)))
        return Rows(np.array(times, dtype=np.int64), values, bad, header)


class Parquet(Table):
    """A Parquet file, which is written anew when it grows."""

    layout: Layout

    def _rows(self) -> Iterator[Rows]:
        parquet = needs_extra("pyarrow.parquet", "parquet", "reads Parquet files")
        with parquet.ParquetFile(self.path) as file:
            clock = file.read(columns=[self.layout.time]).column(0)
            done, last = self.place or (0, None)
            if done > len(clock) or (done and clock[done - 1].as_py() != last):
                done = 0  # another file
            first = 0
            for batch in file.iter_batches(ROWS, columns=self.layout.wanted):
                first, begin = first + batch.num_rows, first
                if first > done:
                    part = batch.slice(max(0, done - begin))
                    yield self._converted(part, (first, clock[first - 1].as_py()))

    def _converted(self, batch: Any, end: Any) -> Rows:
        cells = {
            name: batch.column(name).cast("double").to_numpy(zero_copy_only=False).astype(float)
            for name in self.layout.wanted[1:]
        }
        clock = batch.column(self.layout.time)
        stamped = str(clock.type).startswith("timestamp")
        if stamped:
            clock = clock.cast("timestamp[ns]", safe=False).cast("int64")
        times, kept, bad = [], [], []
        for i, cell in enumerate(clock.to_pylist()):
            try:
                times.append(int(cell) if stamped else self.layout.nanoseconds(str(cell)))
                kept.append(i)
            except (ValueError, TypeError, ArithmeticError) as error:
                bad.append(f"time {str(cell)[:80]!r} in {self.path.name} ({brief(error)})")
        return Rows(np.array(times, dtype=np.int64), self.layout.values(cells)[kept], bad, end)


def _same(found: list[Any], what: str, default: Any) -> Any:
    """What all records of a case have in common, or the default where there are none."""
    require(
        all(each == found[0] for each in found),
        f"sources.{what}",
        expected=f"the {what} of the files",
        got="none, and records of the case that differ in it",
        remedy=f"give `{what}` in the source",
    )
    return found[0] if found else default
