"""Tables of samples that grow, read by the mapping of a log: signals, units and clock."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.io.assembly import DataCase
from retwin.data.logs import arrow_tables
from retwin.data.logs.channels import in_unit, table_of
from retwin.data.logs.mapping import ChannelMapping
from retwin.data.logs.mapping import Mapping as LogMapping
from retwin.data.logs.signals import NANOSECOND, Signal, named_unit
from retwin.data.logs.tables import numbers, row_times, time_column, unit_in
from retwin.data.logs.text_tables import (
    AGREEING,
    HEAD,
    SEPARATORS,
    TextLayout,
    decimal_comma,
    text_layout,
)
from retwin.data.logs.units import same_unit
from retwin.data.trajectories import Channels
from retwin.errors import InputError, brief
from retwin.monitor.sources.tables import ROWS, Rows, Table, TextTable

UTF16 = (b"\xff\xfe", b"\xfe\xff")
"""Marks of an encoding in which the end of a row is not found by its bytes."""
REMEDY = "leave it out of the mapping of this source, or write complete logs"
NEVER = -(2**63)
"""Time in ns of a command that was not measured yet."""


@dataclass(frozen=True)
class MappedLayout:
    """How rows of a table become samples, by a mapping.

    Parameters
    ----------
    mapping : Mapping
        The settings.
    channels : tuple
        Name, mapping and unit of each channel, commands first; the unit is None where the twin
        states none.
    commands : int
        The number of commands.

    """

    mapping: LogMapping
    channels: tuple[tuple[str, ChannelMapping, str | None], ...]
    commands: int

    @property
    def signals(self) -> list[str]:
        """The signals of all channels, each once."""
        return list(dict.fromkeys(name for _, own, _ in self.channels for name in own.signals))

    @property
    def wanted(self) -> list[str]:
        """The signals, and the column of the times if the mapping names it."""
        clock = self.mapping.time.column
        return [clock] * bool(clock) + self.signals

    @property
    def offset(self) -> int:
        """What is added to the times in ns; all channels of a row have the same."""
        return round(self.channels[0][1].clock_offset / NANOSECOND)

    def values(self, cells: Mapping[str, NDArray], units: Mapping[str, str], where: str) -> NDArray:
        """The channels (n, d) of columns (n,) with the units that the table states."""
        return np.stack(
            [self._channel(each, cells, units, where) for each in self.channels], axis=1
        )

    def _channel(
        self,
        channel: tuple[str, ChannelMapping, str | None],
        cells: Mapping[str, NDArray],
        units: Mapping[str, str],
        where: str,
    ) -> NDArray:
        name, own, unit = channel
        first, *others = own.signals
        for other in others:
            require(
                same_unit(units[first], units[other]),
                f"{where}, {other}",
                expected=f"the unit of {first!r}, with which it is averaged",
                got=units[other] or "none",
                remedy="map one of them alone",
            )
        mean = np.mean([cells[each] for each in own.signals], axis=0)
        made, target, _ = in_unit(mean, own, units[first], unit, f"{where}, {first}")
        require(
            unit is not None or own.unit or same_unit(target, "1"),
            f"{where}, {first}",
            expected=f"the unit of {name}, of which the twin states none",
            got=f"that of the table alone, {target}",
            remedy=f"write unit = … for {name} in the mapping, the unit of its calibration data",
        )
        return made

    def known(self, times: NDArray, values: NDArray, since: NDArray) -> tuple[NDArray, NDArray]:
        """The values (n, d) without outputs where a command is missing for too long, and `since`.

        `since` (commands,) is when each command was last known, in ns.
        """
        made, since = values.copy(), since.copy()
        limits = [own.max_gap for _, own, _ in self.channels[: self.commands]]
        for row, time in enumerate(times):
            given = np.isfinite(values[row, : self.commands])
            since[given] = time
            for limit, last in zip(limits, since, strict=True):
                if limit is not None and last != NEVER and time - last > limit / NANOSECOND:
                    made[row, self.commands :] = np.nan
        return made, since

    def table(self, path: Path) -> Table:
        """What reads that file, by its suffix."""
        return (MappedParquet if path.suffix == ".parquet" else MappedCsv)(path, self)


def mapped_layout(
    mapping: LogMapping, inputs: Channels, outputs: Channels, rate: float, case: DataCase | None
) -> MappedLayout:
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
    _check_stream(mapping, rate)
    for table, channels, how, reason in (
        ("commands", commands, ("linear",), "it is held until the next row, which is not there"),
        ("outputs", measured, ("hold",), "what was not measured is missing"),
    ):
        for name, own, _ in channels:
            require(
                own.resample not in how,
                f"mapping: {table}.{name}.resample",
                expected=f"another one for rows as they appear: {reason}",
                got=own.resample,
                remedy=REMEDY,
            )
    every = (*commands, *measured)
    offsets = sorted({own.clock_offset for _, own, _ in every})
    require(
        len(offsets) == 1,
        "mapping: clock_offset",
        expected="the same for all channels, since a row of a stream has one time",
        got=", ".join(f"{each:g} s" for each in offsets),
        remedy="write channels with clocks of their own to topics or nodes of their own: MQTT or "
        "OPC UA",
    )
    return MappedLayout(mapping, every, len(commands))


def _check_stream(mapping: LogMapping, rate: float) -> None:
    """Refuse what has no meaning for rows that appear one after the other."""
    cut, time = mapping.cut, mapping.time
    require(
        mapping.rate is None or np.isclose(mapping.rate, rate, rtol=1e-6),
        "mapping: rate",
        expected=f"that of the twin, {rate:g} Hz",
        got=f"{mapping.rate:g} Hz" if mapping.rate else "none",
        remedy="leave it out: samples come to the sample rate of the twin",
    )
    require(
        time.rate is None,
        "mapping: time.rate",
        expected="a column of times, since a file that is replaced starts again",
        got=f"rows at {time.rate or 0:g} Hz without times",
        remedy="write the time of each row, and name its column",
    )
    cuts = {"trigger": cut.by == "trigger", "length": cut.by == "length"}
    cuts["min_length"] = cut.min_length is not None
    found = [name for name, given in cuts.items() if given]
    require(
        not found,
        "mapping: cut",
        expected="all rows of a stream, of which nothing is left out",
        got=f"a cut by {found[0]}" if found else "",
        remedy=REMEDY,
    )


class MappedCsv(TextTable):
    """A text table of any separator, with units, decimal commas and lines above its header.

    An incomplete last row waits for its end, and a header for its first row.
    """

    layout: MappedLayout

    def _parsed(self, text: bytes, known: tuple[TextLayout, NDArray] | None) -> Rows | None:
        layout, since = known or (None, np.full(self.layout.commands, NEVER))
        encoding = layout.encoding if layout else _encoding(text)
        lines = text.decode(encoding, "replace").removeprefix("\ufeff").split("\n")
        if layout is None:
            layout = self._begun(lines, encoding)
            if layout is None:
                return None
            lines = lines[layout.first :]
        rows, bad = self._cells(lines, layout)
        if not layout.comma and decimal_comma(rows, layout.separator):
            layout = replace(layout, comma=True)
        times, kept, odd = self._times(rows, layout)
        values, missing = self._values([rows[i] for i in kept], layout)
        values, since = self.layout.known(times, values, since)
        return Rows(times, values, [*bad, *odd, *missing], (layout, since))

    def _begun(self, lines: Sequence[str], encoding: str) -> TextLayout | None:
        """How the table is written; None if it has titles and no row yet."""
        head = [f"{line}\n" for line in lines[:HEAD]]
        title, rows = self._titled(head)
        if title is None:  # the table may have none, and columns by their numbers
            found = text_layout(head, encoding, self.path)
        else:
            # By as few rows as possible, so that it does not depend on when the file is read.
            for last in rows[:AGREEING]:
                some = [*head[: title + 1], *(head[row] for row in rows if row <= last)]
                try:
                    found = text_layout(some, encoding, self.path)
                except InputError:
                    continue
                found = replace(found, first=last)
                break
            else:
                require(
                    len(rows) < AGREEING,
                    self.path.name,
                    expected="rows of numbers below the titles",
                    got=repr(head[rows[0]].strip()[:60]) if rows else "none",
                    remedy="check that it is the right file",
                )
                return None
        lacking = [each for each in self.layout.wanted if each not in found.names]
        if lacking:
            raise ValueError(f"no column {', '.join(lacking)} in its header")
        return found

    def _titled(self, head: Sequence[str]) -> tuple[int | None, list[int]]:
        """The line with the titles, and those below it with as many cells."""
        for separator in SEPARATORS:
            rows = [next(csv.reader([line], delimiter=separator), []) for line in head]
            for place, row in enumerate(rows):
                names = {named_unit(each.strip().lstrip("#"))[0] for each in row}
                if len(row) > 1 and names.issuperset(self.layout.wanted):
                    below = range(place + 1, len(rows))
                    return place, [each for each in below if len(rows[each]) == len(row)]
        return None, []

    def _cells(self, lines: Sequence[str], layout: TextLayout) -> tuple[list[Sequence[str]], list]:
        """The cells of complete rows, and why others are none."""
        rows: list[Sequence[str]] = []
        bad: list[str] = []
        for line in lines:
            if not line.strip():
                continue
            try:
                row = layout.cells(line.rstrip("\r"))
            except (ValueError, csv.Error) as error:
                bad.append(f"{line[:80]!r} in {self.path.name} ({brief(error)})")
                continue
            if any(cell.strip() for cell in row):
                rows.append(row)
        return rows, bad

    def _times(
        self, rows: Sequence[Sequence[str]], layout: TextLayout
    ) -> tuple[NDArray, list[int], list[str]]:
        """Times in ns, the rows that have one, and why others have none."""
        clock = self.layout.mapping.time.clock
        name = clock.column or time_column(layout.names)
        require(
            name,
            self.path.name,
            expected="a column of times",
            got=f"the columns {', '.join(layout.names[:12])}",
            remedy="name it in the mapping: [time] column = …",
        )
        at = layout.names.index(name)
        unit = layout.units[at] or unit_in(name)
        where = f"{self.path.name}, column {name!r}"
        cells = np.array([row[at] for row in rows], np.str_)
        with suppress(InputError):  # of a row or more
            found = row_times(cells, unit, clock, where)
            return found + self.layout.offset, list(range(len(cells))), []
        parts, kept, bad = [np.empty(0, np.int64)], [], []
        for row, cell in enumerate(cells):
            try:
                parts.append(row_times(cells[row : row + 1], unit, clock, where))
                kept.append(row)
            except InputError as error:
                bad.append(f"time {str(cell)[:80]!r} in {self.path.name} ({error.expected})")
        return np.concatenate(parts) + self.layout.offset, kept, bad

    def _values(
        self, rows: Sequence[Sequence[str]], layout: TextLayout
    ) -> tuple[NDArray, list[str]]:
        """The channels (n, d), and which cells are no numbers."""
        columns: dict[str, NDArray] = {}
        bad = []
        for name in self.layout.signals:
            at = layout.names.index(name)
            cells = np.array([row[at] for row in rows], np.str_)
            columns[name], odd = numbers(cells, comma=layout.comma)
            if odd:
                bad.append(f"{odd} values of {name} in {self.path.name} that are no numbers")
        units = dict(zip(layout.names, layout.units, strict=True))
        return self.layout.values(columns, units, self.path.name), bad


class MappedParquet(Table):
    """A Parquet file, which is written anew when it grows."""

    layout: MappedLayout

    def _rows(self) -> Iterator[Rows]:
        own = self.layout
        read = arrow_tables.read(self.path, frozenset(own.signals), own.mapping.time.clock)
        found = {each.name: each for each in read if isinstance(each, Signal)}
        lacking = [each for each in own.signals if each not in found]
        if lacking:
            raise ValueError(f"no column of numbers {', '.join(lacking)}")
        times = next(iter(found.values())).times + own.offset
        done, last, since = self.place or (0, None, np.full(own.commands, NEVER))
        if done > len(times) or (done and times[done - 1] != last):
            done, since = 0, np.full(own.commands, NEVER)  # another file
        units = {name: each.unit for name, each in found.items()}
        for begin in range(done, len(times), ROWS):
            part = slice(begin, min(begin + ROWS, len(times)))
            cells = {name: each.values[part] for name, each in found.items()}
            values = own.values(cells, units, self.path.name)
            values, since = own.known(times[part], values, since)
            end = (part.stop, times[part.stop - 1], since)
            yield Rows(times[part], values, [], end)


def _encoding(text: bytes) -> str:
    """UTF-8, else the encoding of Western Windows."""
    if text[:2] in UTF16:
        raise ValueError("text in UTF-16, whose rows are not found while it grows: write UTF-8")
    try:
        text.decode("utf-8")
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"
