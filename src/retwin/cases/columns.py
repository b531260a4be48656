"""Records in one CSV table: a column for each channel, and parts of its rows."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.checks import finite, require
from retwin.data.trajectories import HEALTHY, Channels, Provenance, Trajectories
from retwin.errors import InputError
from retwin.serialisation.files import sha256
from retwin.twins.twin import Twin

__all__ = ["ColumnRecords", "Record"]


@dataclass(frozen=True)
class Record:
    """One record in a table.

    Parameters
    ----------
    columns : mapping of str to str
        The column of each channel.
    rows : tuple of int, optional
        First row, counted from 0 after the header, and the row at which it ends; by default all.
    transient : float, default 0.0
        Duration in s at the begin whose outputs are masked, while the real system still moves from
        a state that the twin does not start in. Its commands count.

    Raises
    ------
    InputError
        Rows out of order, or a transient that is no finite number of at least 0.

    """

    columns: Mapping[str, str]
    rows: tuple[int, int] | None = None
    transient: float = 0.0

    def __post_init__(self) -> None:
        finite("transient", self.transient, least=0.0, unit="s", remedy="leave it out")
        require(
            self.rows is None or 0 <= self.rows[0] < self.rows[1],
            "rows",
            expected="the first row, at least 0, and a later one at which the record ends",
            got=self.rows,
            remedy="count from 0 after the header",
        )

    def overlaps(self, other: Record, channels: Channels) -> bool:
        """Whether both have rows of one column of these channels."""
        own, others = ({each.columns[name] for name in channels.names} for each in (self, other))
        (first, end), (begin, stop) = self.rows or (0, inf), other.rows or (0, inf)
        return bool(own & others) and first < stop and begin < end


Records = Mapping[str, str] | Record | Sequence[Mapping[str, str] | Record]
"""Records as a user gives them; columns alone stand for a record."""


@dataclass(frozen=True)
class ColumnRecords:
    """A function of a CSV file with a header that gives calibration records and test records.

    Each is one healthy trajectory. It ends where its commands end; an output that is missing before
    is masked. `nominal` is the output of the twin. Shorter records of a set are padded.

    Parameters
    ----------
    twin : Twin
        Its channels and sample rate are those of the records.
    calibration, test : Record, mapping of str to str, or a sequence of these
        The records; the column of each channel stands for a record of all rows.

    Raises
    ------
    InputError
        There is not one column for each input and output, or both sets have the same measurements.
        When called: the file cannot be read or lacks a column, or a command is no number.

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
        shared = [
            each
            for each in self._records("test")
            if any(each.overlaps(own, self.twin.outputs) for own in self._records("calibration"))
        ]
        require(
            not shared,
            "test",
            expected="measurements that are in no calibration record",
            got=f"the same columns, {', '.join(shared[0].columns.values())}" if shared else "",
            remedy="give other columns, or each a part of the rows: rows = [FIRST, END]",
        )

    def _records(self, name: str) -> tuple[Record, ...]:
        records: tuple[Record, ...] = getattr(self, name)
        return records

    def __call__(self, path: str | Path) -> tuple[Trajectories, Trajectories]:
        """The calibration records and the test records in a CSV file."""
        path = Path(path)
        every = (*self._records("calibration"), *self._records("test"))
        table = _read(path, list(dict.fromkeys(c for each in every for c in each.columns.values())))
        source = Provenance(path.name, sha256(path))
        return self._set(table, "calibration", source), self._set(table, "test", source)

    def _set(self, table: Mapping[str, NDArray], name: str, source: Provenance) -> Trajectories:
        """The records of that name, padded to the length of the longest."""
        records = self._records(name)
        ids = [name] if len(records) == 1 else [f"{name}-{i + 1}" for i in range(len(records))]
        made = [self._record(table, *each, source) for each in zip(records, ids, strict=True)]
        steps = max(each.steps for each in made)
        return Trajectories.concatenate([each.padded(steps) for each in made])

    def _record(
        self, table: Mapping[str, NDArray], record: Record, name: str, source: Provenance
    ) -> Trajectories:
        rows = slice(*(record.rows or (None,)))

        def values(channels: Channels) -> NDArray:
            columns = [table[record.columns[each]][rows] for each in channels.names]
            count = len(next(iter(table.values()))[rows])
            return np.array(columns).T.reshape(1, count, len(channels))

        commands, observed = values(self.twin.inputs), values(self.twin.outputs)
        # Without commands, a record ends where its measurements end.
        known = np.isfinite(commands[0]).all(axis=1)
        ends = known if len(self.twin.inputs) else np.isfinite(observed[0]).any(axis=1)
        steps = int(np.flatnonzero(ends).max(initial=-1)) + 1
        require(
            steps >= 2 and known[:steps].all(),
            source.name,
            expected="a number for every command until the record ends, two rows at least",
            got=f"{int(known.sum())} of {steps} rows of the {name} record",
            remedy="fill in the missing commands, which are known inputs",
        )
        observed[:, : round(record.transient * self.twin.rate)] = np.nan
        require(
            np.isfinite(observed[:, :steps]).any(),
            source.name,
            expected=f"measurements in the {name} record, after its transient",
            got=f"none in {steps} rows",
            remedy="check columns, rows and transient",
        )
        commands = commands[:, :steps]
        return Trajectories(
            commands=commands,
            nominal=self.twin.simulate(commands, seed=0).nominal,
            observed=observed[:, :steps],
            rate=self.twin.rate,
            labels=np.array([HEALTHY]),
            ids=np.array([name]),
            inputs=self.twin.inputs,
            outputs=self.twin.outputs,
            provenance=(source,),
        )


def _read(path: Path, names: list[str]) -> dict[str, NDArray]:
    """Columns of a CSV file; NaN where a cell is empty."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as lines:
            rows = list(csv.DictReader(lines, strict=True))
        return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}
    except (OSError, KeyError, ValueError, TypeError, csv.Error) as error:
        raise InputError(
            str(path),
            expected=f"a CSV file with a header and numbers in columns {', '.join(names)}",
            got=f"{type(error).__name__}: {error}",
            remedy="name the columns as the file does",
        ) from None
