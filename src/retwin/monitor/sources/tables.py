"""Tables of samples that grow: their layouts, and which rows of a file were not read yet."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.cases.case import Case
from retwin.cases.columns import ColumnRecords
from retwin.checks import require, same_names
from retwin.data.io.assembly import DataCase
from retwin.data.layout import HEAD, encoding_of, text_layout
from retwin.data.layout import Layout as TextLayout
from retwin.data.logs.channels import in_unit, mean_of, table_of
from retwin.data.logs.formats.arrow_tables import read_table
from retwin.data.logs.mapping import ChannelMapping, Mapping
from retwin.data.logs.signals import NANOSECOND, Clock, Signal, TimeUnit, named_unit
from retwin.data.logs.units import same_unit
from retwin.data.row_times import time_column, times_that_are
from retwin.data.tables import Table, text_table
from retwin.data.trajectories import Channels
from retwin.errors import brief
from retwin.monitor.settings import FolderSource
from retwin.serialisation.files import refusing

REMEDY = "leave it out of the mapping of this source, or write complete logs"
CHUNK = 2**16
"""Bytes of a CSV file, and of one of its rows, that are read at once."""
ROWS = 8192
"""Rows of a Parquet file that are converted at once."""
NEVER = -(2**63)
"""Time in ns of a command that was not measured yet."""


@dataclass(frozen=True)
class Layout:
    """Where a table has the times, and each channel: the mean of its columns.

    Parameters
    ----------
    time, unit : str
        The column of the times, and its unit, or "iso"; "" for what is found.
    columns : tuple of tuple of str
        The columns of each channel, by their titles, with or without units.
    format : str
        The format of times that are other text.
    channels : tuple
        Of a mapping: name, mapping and unit of each channel, commands first; the unit is None where
        the twin states none. Without it, values are taken as they are, and a row with a cell that
        is no number is none.
    commands : int
        The number of commands, of a mapping.

    """

    time: str
    unit: TimeUnit
    columns: tuple[tuple[str, ...], ...]
    format: str = ""
    channels: tuple[tuple[str, ChannelMapping, str | None], ...] = ()
    commands: int = 0

    @property
    def signals(self) -> list[str]:
        """The columns of all channels, each once."""
        return list(dict.fromkeys(each for own in self.columns for each in own))

    @property
    def wanted(self) -> list[str]:
        """All columns, that of the times first if it is named."""
        return [self.time] * bool(self.time) + self.signals

    @property
    def clock(self) -> Clock:
        """Where the times are."""
        return Clock(self.time, self.unit, self.format)

    @property
    def offset(self) -> int:
        """What is added to the times in ns; all channels of a row have the same."""
        return round(self.channels[0][1].clock_offset / NANOSECOND) if self.channels else 0

    def rows(self, table: Table, since: NDArray, end: Any) -> Rows:
        """The samples in a table; `since` (commands,) is when each command was last known, in ns.

        It is changed by those of the table.
        """
        cells, unit, where = table.stamps(table.time_name(self.clock))
        times, kept, bad = times_that_are(cells, unit, self.clock, where)
        found: dict[str, Signal] = {}
        every = np.arange(table.rows)
        good = np.isin(every, kept)
        for name in self.signals:
            numbers, odd = table.numbers(name)
            odd &= good
            found[name] = Signal(name, every, numbers, table.units[name] if self.channels else "")
            if self.channels and odd.any():
                bad.append(
                    f"{odd.sum()} of the values of {name} in {table.place}, which are no numbers; "
                    "all others are used"
                )
            elif odd.any():
                text = table.cells(name)[odd].tolist()
                bad += [f"{str(each)[:80]!r} in {table.place}, column {name!r}" for each in text]
                good &= ~odd
        means = [mean_of([found[each] for each in own], table.place) for own in self.columns]
        pairs = zip(self.channels, means, strict=False)
        columns = [_in_unit_of(*pair, table.place) for pair in pairs] or [e.values for e in means]
        values = np.stack(columns, axis=1)[good]
        times = times[good[kept]] + self.offset
        self._mask(times, values, since)
        return Rows(times, np.where(np.isfinite(values), values, np.nan), bad, end)

    def _mask(self, times: NDArray, values: NDArray, since: NDArray) -> None:
        """Leave outputs out where a command is missing for longer than its `max_gap`."""
        limits = [own.max_gap for _, own, _ in self.channels[: self.commands]]
        for time, row in zip(times if self.commands else (), values, strict=False):
            since[np.isfinite(row[: self.commands])] = time
            for limit, last in zip(limits, since, strict=True):
                if limit is not None and last != NEVER and time - last > limit / NANOSECOND:
                    row[self.commands :] = np.nan

    def table(self, path: Path) -> GrowingTable:
        """What reads that file, by its suffix."""
        return (Parquet if path.suffix == ".parquet" else Csv)(path, self)


def _in_unit_of(
    channel: tuple[str, ChannelMapping, str | None], signal: Signal, place: str
) -> NDArray:
    """The mean (n,) of columns as values of a channel of a mapping."""
    name, own, unit = channel
    where = f"{place}, {own.signals[0]}"
    made, target, _ = in_unit(signal.values, own, signal.unit, unit, where)
    stated = unit is not None or own.unit or same_unit(target, "1")
    expected = f"the unit of {name}, of which the twin states none"
    got = f"that of the table alone, {target}"
    remedy = f"write unit = … for {name} in the mapping, the unit of its calibration data"
    require(stated, where, expected=expected, got=got, remedy=remedy)
    return made


@dataclass(frozen=True)
class Rows:
    """Rows of a table: times (n,) in ns, values (n, d), and why rows between them are no samples.

    `end` is what the table continues from.
    """

    times: NDArray
    values: NDArray
    bad: list[str]
    end: Any


def state_of(path: str | Path) -> tuple[int, int, int]:
    """The number of a file, its size, and the time of its change in ns."""
    about = os.stat(path)
    return about.st_ino, about.st_size, about.st_mtime_ns


class GrowingTable(ABC):
    """A file of rows that may grow, or be replaced by another one of that name.

    Parameters
    ----------
    path : Path
        The file.
    layout : Layout
        Its columns.

    """

    def __init__(self, path: Path, layout: Layout) -> None:
        self.path = path
        self.layout = layout
        self.place: Any = None
        """How far it was read; None from its begin."""
        self._seen: tuple[int, ...] = ()

    def changed(self) -> bool:
        """Whether the file was written to, or replaced, since this was last called."""
        before, self._seen = self._seen, state_of(self.path)
        return before != self._seen

    def rows(self) -> Iterator[Rows]:
        """New rows part by part; after each, set `place` to its end to have read it.

        Where the file was replaced or truncated, or its begin was changed, all rows are new again.
        Raises InputError where it is no table, or lacks a column.
        """
        expected = f"a table with columns {', '.join(self.layout.wanted)}"
        remedy = "correct it, or name the columns as the file does"
        with refusing(self.path, expected=expected, remedy=remedy):
            yield from self._rows()

    @abstractmethod
    def _rows(self) -> Iterator[Rows]:
        """See `rows`; any exception is turned into an InputError there."""


@dataclass(frozen=True)
class _Place:
    """How far a text table was read: bytes, those before, and what is known of the table."""

    offset: int = 0
    tail: bytes = b""
    layout: TextLayout | None = None
    since: NDArray | None = None


class Csv(GrowingTable):
    """A text table, whose incomplete last row waits for its end, and a header for its first row."""

    def _rows(self) -> Iterator[Rows]:
        with self.path.open("rb") as file:
            place = self._kept(file)
            while True:
                file.seek(place.offset)
                chunk = file.read(CHUNK)
                text = chunk[: chunk.rfind(b"\n") + 1]
                if len(chunk) == CHUNK and not text:
                    raise ValueError(f"a row of more than {CHUNK} bytes")
                made = self._parse(text, place) if text else None
                if made is None:
                    return
                place = made.end
                yield made

    def _kept(self, file: Any) -> _Place:
        """How far the file was read, if it still is the same up to there."""
        place = self.place or _Place()
        file.seek(place.offset - len(place.tail))
        return place if file.read(len(place.tail)) == place.tail else _Place()

    def _parse(self, text: bytes, place: _Place, *, tail: int = 256) -> Rows | None:
        """Complete lines after a place; None if they hold no row yet.

        Parameters
        ----------
        tail : int, default 256
            Bytes before the place up to which a file was read that are compared before it is read
            on.

        """
        layout, name = place.layout, self.path.name
        encoding = layout.encoding if layout else encoding_of(text)
        if encoding == "utf-16":  # the end of a row is not found by its bytes
            raise ValueError("text in UTF-16, whose rows are not found while it grows: write UTF-8")
        lines = text.decode(encoding, "replace").split("\n")[:-1]
        if layout is None:
            layout = text_layout(lines[:HEAD], encoding, name, self.layout.wanted)
            lines = lines[layout.first :]
            if not lines:
                return None
        rows, bad = [], []
        for line in filter(str.strip, lines):
            try:
                row = layout.row(line.rstrip("\r"), name)
            except ValueError as error:
                bad.append(f"{line[:80]!r} in {name} ({brief(error)})")
                continue
            if any(cell.strip() for cell in row):
                rows.append(row)
        wanted = {*self.layout.signals, self.layout.time or time_column(layout.names)} - {""}
        columns = {
            each: np.array([row[at] for row in rows], np.str_)
            for each in wanted
            for at in [layout.column(each)]
        }
        since = np.full(self.layout.commands, NEVER) if place.since is None else place.since.copy()
        end = _Place(place.offset + len(text), (place.tail + text)[-tail:], layout, since)
        made = self.layout.rows(text_table(name, layout, len(rows), columns), since, end)
        return replace(made, bad=bad + made.bad)


class Parquet(GrowingTable):
    """A Parquet file, which is written anew when it grows."""

    def _rows(self) -> Iterator[Rows]:
        own = self.layout
        names = {each: named_unit(each)[0] for each in own.wanted}
        table = read_table(self.path, frozenset([*names, *names.values()]), own.clock)
        found = {each: each if each in table.units else plain for each, plain in names.items()}
        lacking = [each for each, name in found.items() if name not in table.units]
        if lacking:
            raise ValueError(f"no column {', '.join(lacking)}")
        clock = own.time or table.time_name(own.clock)
        found.setdefault(clock, clock)
        columns = {each: table.cells(name) for each, name in found.items()}
        units = {each: table.units[name] for each, name in found.items()}
        done, last, since = self.place or (0, None, None)
        if done > table.rows or (done and columns[clock][done - 1] != last):
            done, since = 0, None  # another file
        since = np.full(own.commands, NEVER) if since is None else since
        for begin in range(done, table.rows, ROWS):
            part = slice(begin, min(begin + ROWS, table.rows))
            some = {each: cells[part] for each, cells in columns.items()}
            since = since.copy()
            end = (part.stop, columns[clock][part.stop - 1], since)
            yield own.rows(
                Table(self.path.name, units, part.stop - begin, some.__getitem__), since, end
            )


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


def mapped_layout(
    mapping: Mapping, inputs: Channels, outputs: Channels, rate: float, case: DataCase | None
) -> Layout:
    """How a mapping is applied to rows as they appear.

    Parameters
    ----------
    mapping : Mapping
        The settings. The class of the log and nominal outputs are of no use in a stream.
    inputs, outputs : Channels
        Those of the twin.
    rate : float
        Its sample rate in Hz.
    case : DataCase or None
        As logs are read with: whether a unit of "1" is one.

    Raises
    ------
    InputError
        The channels are not those of the twin, or a setting needs later rows or a whole log.

    """
    stated = case is not None and bool(case.classes)
    commands = table_of(mapping.commands, inputs, "commands", stated=stated)
    measured = table_of(mapping.outputs, outputs, "outputs", stated=stated)
    every, cut, time = (*commands, *measured), mapping.cut, mapping.time

    def refuse(wrong: bool, key: str, got: object, expected: str) -> None:
        require(not wrong, f"mapping: {key}", expected=expected, got=got, remedy=REMEDY)

    other_rate = mapping.rate is not None and not np.isclose(mapping.rate, rate, rtol=1e-6)
    refuse(other_rate, "rate", mapping.rate, f"that of the twin, {rate:g} Hz, or none")
    wanted = "a column of times, since a file that is replaced starts again"
    refuse(time.rate is not None, "time.rate", time.rate, wanted)
    wanted = "all rows of a stream, of which nothing is left out"
    refuse(cut.by in ("trigger", "length"), "cut.by", cut.by, wanted)
    refuse(cut.min_length is not None, "cut.min_length", cut.min_length, wanted)
    for name, own, _ in commands:
        wanted = "another one: it is held until the next row, which is not there yet"
        refuse(own.resample == "linear", f"commands.{name}.resample", own.resample, wanted)
    for name, own, _ in measured:
        wanted = "another one for rows as they appear: what was not measured is missing"
        refuse(own.resample == "hold", f"outputs.{name}.resample", own.resample, wanted)
    offsets = sorted({own.clock_offset for _, own, _ in every})
    wanted = "the same for all channels, since a row of a stream has one time; MQTT and OPC UA take"
    wanted += " channels with clocks of their own"
    refuse(len(offsets) > 1, "clock_offset", offsets, wanted)
    columns = tuple(tuple(own.signals) for _, own, _ in every)
    return Layout(time.column, time.unit, columns, time.format, every, len(commands))


def _same(found: list[Any], what: str, default: Any) -> Any:
    """What all records of a case have in common, or the default where there are none."""
    agree = all(each == found[0] for each in found)
    got = "none, and records of the case that differ in it"
    remedy = f"give `{what}` in the source"
    require(agree, f"sources.{what}", expected=f"the {what} of the files", got=got, remedy=remedy)
    return found[0] if found else default
