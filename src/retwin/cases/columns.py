"""Records in CSV tables: the columns of each channel, parts of the rows, and their times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from glob import glob
from itertools import chain
from math import inf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.cases.time_column import TimeColumn
from retwin.checks import finite, require
from retwin.data.resampling import Resampling, is_sparse
from retwin.data.tables import Table, read_titled
from retwin.data.trajectories import HEALTHY, Channels, Provenance, Trajectories
from retwin.errors import InputError
from retwin.serialisation.files import sha256
from retwin.twins.twin import Twin


@dataclass(frozen=True)
class Record:
    """One record in a table, or one in each of several.

    Parameters
    ----------
    columns : mapping of str to str or tuple of str
        The column of each channel, or several of which it is the mean. True and False are 1 and 0.
    rows : tuple of int, optional
        First row, counted from 0 after the header, and the row at which it ends; by default all.
    transient : float, default 0.0
        Duration in s at the begin whose outputs are masked, while the real system still moves from
        a state that the twin does not start in. Its commands count.
    files : str or tuple of str, optional
        Files, or patterns such as `2020-*.csv`, in the folder that is read: a record in each.
    time : TimeColumn or str, optional
        The column of the rows' times, for rows that are not one sample each: those come to the
        sample rate as `TimeColumn` describes.

    Raises
    ------
    InputError
        Rows out of order, a transient that is no finite number of at least 0, or a channel without
        a column.

    """

    columns: Mapping[str, str | tuple[str, ...]]
    rows: tuple[int, int] | None = None
    transient: float = 0.0
    files: str | tuple[str, ...] = ()
    time: TimeColumn | str | None = None

    def __post_init__(self) -> None:
        finite("transient", self.transient, at_least=0.0, unit="s", remedy="leave it out")
        fits = self.rows is None or 0 <= self.rows[0] < self.rows[1]
        expected = "the first row, at least 0, and a later one at which the record ends"
        remedy = "count from 0 after the header"
        require(fits, "rows", expected=expected, got=self.rows, remedy=remedy)
        fits = all(map(_several, self.columns.values()))
        expected = "the column of each channel, or several"
        remedy = 'write for each channel NAME = "COLUMN", or a list for their mean'
        require(fits, "columns", expected=expected, got=dict(self.columns), remedy=remedy)

    @property
    def clock(self) -> TimeColumn | None:
        """How rows come to the sample rate; None where each is a sample."""
        return TimeColumn(self.time) if isinstance(self.time, str) else self.time

    def columns_of(self, channels: Channels) -> list[tuple[str, ...]]:
        """The columns of each channel."""
        return [_several(self.columns[name]) for name in channels.names]

    @property
    def every_column(self) -> list[str]:
        """The columns of all channels."""
        return list(dict.fromkeys(chain(*map(_several, self.columns.values()))))

    def overlaps(self, other: Record, channels: Channels) -> bool:
        """Whether both have rows of one column of these channels, in one file."""
        own, others = (set(chain(*each.columns_of(channels))) for each in (self, other))
        (first, end), (begin, stop) = self.rows or (0, inf), other.rows or (0, inf)
        same = set(_several(self.files)) & set(_several(other.files)) or self.files == other.files
        return bool(own & others and same) and first < stop and begin < end

    def found_in(self, path: Path) -> list[tuple[Path, Record]]:
        """The files of the record, each with the record in it alone.

        Raises
        ------
        InputError
            A folder is needed or given against the declared files, or has no such file.

        """
        patterns = _several(self.files)
        require(
            bool(patterns) == path.is_dir(),
            str(path),
            expected="a folder with the files of the records" if patterns else "one file",
            got="a folder" if path.is_dir() else "no folder",
            remedy='name the files of a folder in each record, files = ["*.csv"]',
        )
        found = [] if patterns else [path]
        for pattern in patterns:
            there = (path / pattern).is_file()
            names = [pattern] if there else sorted(glob(pattern, root_dir=path))
            files = [path / name for name in names]
            fits = files and all(file.is_file() for file in files)
            remedy = "check the names of the record's files, and the folder"
            require(fits, str(path), expected=f"files {pattern}", got="none", remedy=remedy)
            found += files
        return [(file, replace(self, files=str(file))) for file in dict.fromkeys(found)]


def _several(names: str | Sequence[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


Columns = Mapping[str, str | tuple[str, ...]]
Records = Columns | Record | Sequence[Columns | Record]
"""Records as a user gives them; columns alone stand for a record."""


@dataclass(frozen=True)
class ColumnRecords:
    """A function of CSV files with a header that gives calibration records and test records.

    It takes one file, or the folder of the files that the records name. Each record is one healthy
    trajectory. It ends where its commands end; an output that is missing before is masked.
    `nominal` is the output of the twin. Shorter records of a set are padded.

    Parameters
    ----------
    twin : Twin
        Its channels and sample rate are those of the records.
    calibration, test : Record, mapping of str to str or tuple of str, or a sequence of these
        The records; the column of each channel stands for a record of all rows.

    Raises
    ------
    InputError
        There is not one column for each input and output, or both sets have the same measurements.
        When called: a file cannot be read or lacks a column, a command is no number, or as
        `TimeColumn.seconds`.

    """

    twin: Twin
    calibration: Records
    test: Records

    def __post_init__(self) -> None:
        wanted = (*self.twin.inputs.names, *self.twin.outputs.names)
        for name in ("calibration", "test"):
            given = getattr(self, name)
            several = isinstance(given, Sequence)
            records = [
                each if isinstance(each, Record) else Record(each)
                for each in (given if several else [given])
            ]
            missing = next((each for each in records if set(each.columns) != set(wanted)), None)
            require(
                records and missing is None,
                name,
                expected=f"a column for each of {', '.join(wanted)}",
                got=", ".join(missing.columns if missing else ()) or "none",
                remedy='write for each channel NAME = "COLUMN"',
            )
            object.__setattr__(self, name, tuple(records))
        self._check_separate(*(self._records(name) for name in ("calibration", "test")))

    @property
    def in_folder(self) -> bool:
        """Whether the records name the files of a folder."""
        return any(each.files for each in self.every_record)

    @property
    def every_record(self) -> tuple[Record, ...]:
        """The records of both sets."""
        return self._records("calibration") + self._records("test")

    def _records(self, name: str) -> tuple[Record, ...]:
        return getattr(self, name)

    def _check_separate(self, calibration: Sequence[Record], test: Sequence[Record]) -> None:
        """Refuse measurements that are in both sets."""
        outputs = self.twin.outputs
        shared = [each for each in test if any(each.overlaps(own, outputs) for own in calibration)]
        require(
            not shared,
            "test",
            expected="measurements that are in no calibration record",
            got=f"the same columns, {', '.join(shared[0].every_column)}" if shared else "",
            remedy="give other columns, or each a part of the rows: rows = [FIRST, END]",
        )

    def __call__(self, path: str | Path) -> tuple[Trajectories, Trajectories]:
        """The calibration records and the test records in a CSV file or a folder of these."""
        path = Path(path)
        calibration, test = (
            [found for each in self._records(name) for found in each.found_in(path)]
            for name in ("calibration", "test")
        )
        self._check_separate(*([record for _, record in each] for each in (calibration, test)))
        every = (*calibration, *test)
        files = dict.fromkeys(file for file, _ in every)
        tables = {
            file: _table(file, [own for path, own in every if path == file]) for file in files
        }
        sources = {file: Provenance(file.name, sha256(file)) for file in tables}

        def made(name: str, found: Sequence[tuple[Path, Record]]) -> Trajectories:
            ids = [name] if len(found) == 1 else [f"{name}-{i + 1}" for i in range(len(found))]
            records = [
                record_in(tables[file], record, self.twin, own, sources[file])
                for own, (file, record) in zip(ids, found, strict=True)
            ]
            steps = max(each.steps for each in records)
            return Trajectories.concatenate([each.padded(steps) for each in records])

        return made("calibration", calibration), made("test", test)

    def of_file(self, path: Path) -> Trajectories:
        """All rows of one file of such a folder, as a trajectory with the name of the file.

        Its columns are those of the record that names the file, else of the first record.
        """
        every = self.every_record
        named = (each for each in every if any(fnmatch(path.name, n) for n in _several(each.files)))
        record = replace(next(named, every[0]), rows=None, transient=0.0, files=str(path))
        source = Provenance(path.name, sha256(path))
        return record_in(_table(path, [record]), record, self.twin, path.stem, source)


def record_in(
    table: Table, record: Record, twin: Twin, name: str, source: Provenance
) -> Trajectories:
    """One record in a table, as a trajectory.

    Parameters
    ----------
    table : Table
        With the columns of the record.
    record : Record
        The column of each channel, and the rows.
    twin : Twin
        Its channels and sample rate are those of the record.
    name : str
        The name of the trajectory.
    source : Provenance
        The file.

    Raises
    ------
    InputError
        A command is missing, nothing was measured, or the times are not as `TimeColumn` says.

    """
    rows = slice(*(record.rows or (None,)))
    clock, rate = record.clock, twin.rate
    seconds = np.empty(0) if clock is None else clock.seconds(table, rows, rate, name)
    count = len(range(table.rows)[rows])

    def values(channels: Channels, how: Resampling) -> NDArray:
        columns = [
            np.mean([table.cells(each)[rows] for each in several], axis=0)
            for several in record.columns_of(channels)
        ]
        found = np.array(columns).T.reshape(count, len(channels))
        if clock is not None:
            found = clock.resample(seconds, found, rate, how)
        return found[None]

    sparse = clock is not None and is_sparse(seconds, 1 / rate)
    commands = values(twin.inputs, "hold" if clock is None else clock.commands)
    observed = values(twin.outputs, "none" if sparse else "linear")
    # Without commands, a record ends where its measurements end.
    known = np.isfinite(commands[0]).all(axis=1)
    ends = known if len(twin.inputs) else np.isfinite(observed[0]).any(axis=1)
    steps = int(np.flatnonzero(ends).max(initial=-1)) + 1
    first = int(np.append(known, False).argmin())
    missing = f", none at {first / rate:g} s" if clock and first < steps else ""
    fits = steps >= 2 and known[:steps].all()
    expected = "a number for every command until the record ends, two rows at least"
    got = f"{int(known.sum())} of {steps} rows of the {name} record{missing}"
    remedy = "fill in the missing commands, which are known inputs, or give the rows before "
    remedy += "and after them as two records"
    require(fits, source.name, expected=expected, got=got, remedy=remedy)
    observed[:, : round(record.transient * rate)] = np.nan
    fits = np.isfinite(observed[:, :steps]).any()
    expected = f"measurements in the {name} record, after its transient"
    remedy = "check columns, rows and transient"
    require(fits, source.name, expected=expected, got=f"none in {steps} rows", remedy=remedy)
    commands = commands[:, :steps]
    return Trajectories(
        commands=commands,
        nominal=twin.simulate(commands, seed=0).nominal,
        observed=observed[:, :steps],
        rate=rate,
        labels=np.array([HEALTHY]),
        ids=np.array([name]),
        inputs=twin.inputs,
        outputs=twin.outputs,
        provenance=(source,),
    )


def _table(path: Path, records: Sequence[Record]) -> Table:
    """The columns of some records in a file: numbers, and the times as they are written.

    Raises InputError where a cell of a channel is no number.
    """
    channels = dict.fromkeys(chain(*(each.every_column for each in records)))
    clocks = [each.clock.column for each in records if each.clock]
    names = list(dict.fromkeys([*channels, *clocks]))
    table = read_titled(path, names)
    columns = {name: table.cells(name) for name in names}
    for name in channels:
        columns[name], bad = table.numbers(name)
        if bad.any():
            row = int(np.argmax(bad))
            expected = f"numbers in columns {', '.join(names)}"
            got = f"{str(table.cells(name)[row])[:40]!r} in data row {row} of {name}"
            remedy = "correct that cell, or leave it empty where nothing was measured"
            raise InputError(table.place, expected=expected, got=got, remedy=remedy)
    return replace(table, cells=columns.__getitem__)
