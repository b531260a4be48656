"""`read_logs`: measured logs as trajectories of a twin, channel by channel."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from retwin.cases.case import Case
from retwin.cases.columns import ColumnRecords
from retwin.cases.matching import Notes, match_twin, usable
from retwin.cases.named_signals import (
    Columns,
    has_times,
    mapping_by_names,
    resampling_of,
    signals_of,
)
from retwin.catalog import LOGS
from retwin.checks import at_least, nothing, require
from retwin.data.io import load
from retwin.data.logs.mapped import mapped
from retwin.data.logs.mapping import NO_NOMINAL, read_mapping
from retwin.data.logs.reading import is_log, read_log
from retwin.data.logs.signals import Clock, Log
from retwin.data.trajectories import Trajectories
from retwin.progress import Progress, tracked
from retwin.serialisation.sizes import Budget
from retwin.twins.twin import Twin

ROUNDED = 1e-3
"""Relative accuracy to which a rate is rounded that is computed from times."""
CHANGED = ("no number", " is read as ", " to ", "put in order", "with the time of another")
"""Words of notes about a channel whose values or times are not those of the log."""


@dataclass(frozen=True, eq=False)
class Logs:
    """What was read from logs.

    Attributes
    ----------
    trajectories : Trajectories
        Healthy or unlabelled trajectories with the channels of the twin; `nominal` is the output
        of the twin. Outputs that no log holds are masked.
    test : Trajectories or None
        Those that the case itself keeps for a test; None if it keeps none.
    notes : tuple of str
        What was decided while reading, a sentence each: times, rates, outputs that are missing.
    columns : Columns
        Which columns were the channels.

    """

    trajectories: Trajectories
    test: Trajectories | None
    notes: tuple[str, ...]
    columns: Columns = Columns()  # noqa: RUF009 - frozen


def read_logs(
    paths: Sequence[str | Path],
    twin: Twin,
    columns: Columns = Columns(),  # noqa: B008 - frozen
    *,
    case: Case | None = None,
    rows_at_rate: bool = True,
    progress: Progress | None = None,
    max_bytes: int | None = None,
) -> Logs:
    """Logs as trajectories with the channels and the sample rate of a twin.

    Parameters
    ----------
    paths : sequence of path
        Tables `*.csv` with a header, each a trajectory, or whatever `rt.load` reads.
    twin : Twin
        Its channels and sample rate are those of the trajectories.
    columns : Columns
        Which columns are its channels.
    case : Case, optional
        The case of the twin, which may complete commands, or know which parts of a table calibrate
        and which test.
    rows_at_rate : bool
        Whether the rows of a table without times are samples at the rate of the twin; otherwise
        such a table is refused.
    progress : callable, optional
        Called with the share of the logs that is read.
    max_bytes : int, optional
        See `rt.load`.

    Returns
    -------
    Logs
        The trajectories, and what was decided while reading.

    Raises
    ------
    InputError
        A log cannot be read, lacks a command or all outputs, has another rate or other units than
        the twin, a command that is not finite, or no healthy trajectory.

    """
    reader = LogReader(columns, max_bytes)
    return reader.trajectories(paths, twin, case=case, rows_at_rate=rows_at_rate, progress=progress)


@dataclass(frozen=True, eq=False)
class LogReader:
    """Reads each log once, and answers every question about it from what was read.

    Attributes
    ----------
    columns : Columns
        Which columns are the channels of the twin.
    max_bytes : int, optional
        See `rt.load`.

    """

    columns: Columns = Columns()  # noqa: RUF009 - frozen
    max_bytes: int | None = None
    _read: dict[tuple[Path, Clock], Log] = field(default_factory=dict, repr=False)

    def rate(self, path: str | Path, names: Sequence[str]) -> float | None:
        """The sample rate of a log in Hz, by the median interval of the signals of some channels.

        That of a log with a mapping is the mapping's. Returns None for a table without times.
        Raises InputError for a log that cannot be read, or whose times do not increase.
        """
        path = Path(path)
        if self.columns.mapping is not None:
            return read_mapping(self.columns.mapping).rate
        if not is_log(path):
            return load(path, max_bytes=self.max_bytes).rate
        log = self._log(path, 1.0)
        if not has_times(log, self.columns.time):
            return None
        found = signals_of(log, names, self.columns.names)
        steps = [np.diff(log.signals[each].times) for each in found.values()]
        medians = [float(np.median(each)) for each in steps if len(each)]
        step = float(np.median(medians)) if medians else 0.0
        got = f"a median interval of {step:g} s"
        remedy = "name the column of the times, or give the sample rate and no times"
        require(step > 0, path.name, expected="times that increase", got=got, remedy=remedy)
        plain = float(f"{1 / step:.3g}")
        return plain if abs(plain * step - 1) < ROUNDED else 1 / step

    def signals(self, path: str | Path) -> tuple[str, ...]:
        """Names of the signals of a log, without its times."""
        return tuple(self._log(Path(path), 1.0).signals)

    def measured_outputs(self, paths: Sequence[str | Path], twin: Twin) -> tuple[str, ...]:
        """Names of the outputs of a twin that some log holds, in the twin's order.

        Of files that are no logs, all count as held. Raises InputError for a log that cannot be
        read.
        """
        names = self.columns.names
        if self.columns.mapping is not None:
            own = read_mapping(self.columns.mapping).outputs
            return tuple(n for n in twin.outputs.names if names.get(n, n) in own)
        files = list(map(Path, paths))
        if not all(map(is_log, files)):
            return twin.outputs.names
        there = {
            name
            for path in files
            for name in signals_of(self._log(path, 1.0), twin.outputs.names, names)
        }
        return tuple(n for n in twin.outputs.names if n in there)

    def trajectories(
        self,
        paths: Sequence[str | Path],
        twin: Twin,
        *,
        case: Case | None = None,
        rows_at_rate: bool = True,
        progress: Progress | None = None,
    ) -> Logs:
        """See `read_logs`."""
        at_least("logs", paths, 1, "log", remedy="name the files with the measurements")
        self._check_columns(twin)
        notes: Notes = {}
        sets, tests = [], []
        for path in tracked(map(Path, paths), len(paths), progress):
            own, test = self._of_log(path, twin, case, notes, rows_at_rate=rows_at_rate)
            sets.append(own)
            tests += test
        joined = usable(Trajectories.concatenate(sets), notes, self.columns.transient)
        kept = Trajectories.concatenate(tests) if tests else None
        return Logs(joined, kept, tuple(_sentences(notes)), self.columns)

    def _check_columns(self, twin: Twin) -> None:
        """Refuse columns of channels that the twin does not have."""
        names = (*twin.inputs.names, *twin.outputs.names)
        unknown = [repr(name) for name in self.columns.names if name not in names]
        remedy = "write CHANNEL=COLUMN, the name in the twin first"
        nothing("columns", unknown, f"channels of the twin, {', '.join(names)}", remedy=remedy)

    def _of_log(
        self, path: Path, twin: Twin, case: Case | None, notes: Notes, *, rows_at_rate: bool
    ) -> tuple[Trajectories, list[Trajectories]]:
        """The trajectories of one log, and those that the records of a case keep for the test."""
        mapping, names = self.columns.mapping, self.columns.names
        records = None if case is None or names or mapping is not None else case.records
        is_table = path.suffix.lower() == ".csv" and path.is_file()
        if records is not None and (is_table or path.is_dir()):
            if isinstance(records, ColumnRecords) and records.in_folder and is_table:
                return records.of_file(path), []
            calibration, test = records(path)
            return calibration, [test]
        if mapping is not None:
            rate = None if read_mapping(mapping).rate else twin.rate
            found = load(path, rate=rate, max_bytes=self.max_bytes, mapping=mapping)
            made = match_twin(found, twin, names, path.name, notes, mapped=True)
            _add_notes(found, path.name, notes)
            return made, []
        if is_log(path):
            return self._by_names(path, twin, notes, rows_at_rate=rows_at_rate), []
        found = load(path, case=case, max_bytes=self.max_bytes)
        return match_twin(found, twin, names, path.name, notes), []

    def _by_names(
        self, path: Path, twin: Twin, notes: Notes, *, rows_at_rate: bool
    ) -> Trajectories:
        """The trajectories of a log whose signals have the names of the twin's channels."""
        columns = self.columns
        log = self._log(path, twin.rate)
        timed = has_times(log, columns.time)
        expected = "a column with the times of the rows, or the sample rate"
        got = f"columns {', '.join(log.signals)}"
        remedy = "give --time COLUMN, or --rate HZ if each row is a sample at that rate"
        require(timed or rows_at_rate, path.name, expected=expected, got=got, remedy=remedy)
        suffix = path.suffix.lower()
        text = suffix in LOGS and not LOGS[suffix].extra  # each row of which has all channels
        mapping = mapping_by_names(log, twin, columns.names, table=text)
        found = mapped(log, mapping, budget=Budget(path.name, self.max_bytes))
        if len(found) == 1:
            found = found.replace(ids=[path.stem])
        how = f"each row is a sample at {twin.rate:g} Hz"
        how = resampling_of(log, mapping, twin.rate) if timed else how
        notes.setdefault(how, []).append(path.name)
        _add_notes(found, path.name, notes, whole=True)
        return match_twin(found, twin, {}, path.name, notes)

    def _log(self, path: Path, rate: float) -> Log:
        """The signals of a log; rows of a table without times are at that rate in Hz."""
        time = self.columns.time
        clock = time.clock if time.column or time.rate else replace(time.clock, otherwise=rate)
        known = self._read.get((path, clock))
        if known is None:
            budget = Budget(path.name, self.max_bytes)
            known = self._read[path, clock] = read_log(path, clock=clock, budget=budget)
        return known


def _add_notes(found: Trajectories, name: str, notes: Notes, *, whole: bool = False) -> None:
    """What was left out while reading a log; `whole` leaves out that nothing was."""
    for note in found.provenance[0].notes:
        nothing = whole and note.startswith("100.0%")
        if note != NO_NOMINAL and not nothing:  # the twin simulates them
            notes.setdefault(note, []).append(name)
    channels: dict[str, list[str]] = {}
    for each in found.provenance[0].sampling:
        if any(words in each.note for words in CHANGED):
            channels.setdefault(each.note, []).append(each.channel)
    for note, own in channels.items():
        notes.setdefault(f"{', '.join(own)}: {note}", []).append(name)


def _sentences(notes: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Notes, each after the files to which it applies, if it is about some."""
    for text, files in notes.items():
        more = f" and {len(files) - 2} more" if len(files) > 2 else ""
        yield f"{', '.join(files[:2])}{more}: {text}." if files else text
