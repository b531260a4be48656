"""`read_logs`: measured logs as trajectories of a twin, channel by channel."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from retwin.cases.case import Case
from retwin.cases.columns import Record, number, read_columns, record_in
from retwin.cases.time_column import TimeColumn
from retwin.checks import finite, require
from retwin.data.io import load
from retwin.data.logs.mapping import NO_NOMINAL, read_mapping
from retwin.data.trajectories import HEALTHY, UNLABELLED, Channels, Provenance, Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.files import sha256
from retwin.twins.twin import Twin

__all__ = ["Columns", "Logs", "log_rate", "measured_outputs", "read_logs"]

TIMES = re.compile(r"(time|t|timestamp|zeit)\W*(s|ms|us|ns)?\W*", re.IGNORECASE)
"""Names of columns that are taken for the times of the rows, with their unit."""
OTHER_SEPARATORS = (";", "\t", "|")
"""Separators of columns that are named in place of a comma."""
LARGEST = 1e30
"""Magnitude from which a number is no measurement: programs write 3.4e38 for a missing one."""
ROUNDED = 1e-3
"""Relative accuracy to which a rate is rounded that is computed from times."""


@dataclass(frozen=True)
class Columns:
    """Which columns, or channels, of a log are the channels of a twin.

    Parameters
    ----------
    names : mapping of str to str
        Column by channel of the twin; a channel that is not named has a column of its own name.
    time : TimeColumn, optional
        The times of the rows of a table; by default a column with the name time, t or timestamp.
    transient : float
        Duration in s at the begin of each trajectory whose outputs are not used, while the real
        system still moves from a state that the twin does not start in.
    mapping : path, optional
        A mapping.toml, as for `rt.load`, for logs whose signals have times of their own; then
        columns and times are those that it names.

    Raises
    ------
    InputError
        A transient that is no finite number of at least 0.

    """

    names: Mapping[str, str] = field(default_factory=dict)
    time: TimeColumn | None = None
    transient: float = 0.0
    mapping: str | Path | None = None

    def __post_init__(self) -> None:
        finite("transient", self.transient, least=0.0, unit="s", remedy="leave it out")


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

    """

    trajectories: Trajectories
    test: Trajectories | None
    notes: tuple[str, ...]


def log_rate(path: str | Path, columns: Columns = Columns()) -> float | None:
    """The sample rate of a log in Hz, of a table by the median interval of its times.

    That of a log with a mapping is the mapping's. Returns None for a table without times. Raises
    InputError for a log that cannot be read.
    """
    path = Path(path)
    if columns.mapping is not None:
        return read_mapping(columns.mapping).rate
    if not _is_table(path):
        return load(path).rate
    clock = columns.time or _clock(path, _header(path))
    if clock is None:
        return None
    times = read_columns(path, {clock.column: clock.number})[clock.column]
    steps = np.diff(times[np.isfinite(times)])
    units = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "iso": 1.0}
    step = float(np.median(steps)) * units[clock.unit] if len(steps) else 0.0
    require(
        step > 0,
        path.name,
        expected=f"times in column {clock.column!r} that increase",
        got=f"a median interval of {step:g} s",
        remedy="name the column of the times, or give the sample rate and no times",
    )
    return (
        float(f"{1 / step:.3g}") if abs(float(f"{1 / step:.3g}") * step - 1) < ROUNDED else 1 / step
    )


def measured_outputs(
    paths: Sequence[str | Path], twin: Twin, columns: Columns = Columns()
) -> tuple[str, ...]:
    """Names of the outputs of a twin that some log holds, in the twin's order.

    They are known of tables without reading them, and by a mapping; with another log, all count as
    held. Raises InputError for a table that cannot be read.
    """
    if columns.mapping is not None:
        own = read_mapping(columns.mapping).outputs
        return tuple(n for n in twin.outputs.names if columns.names.get(n, n) in own)
    files = list(map(Path, paths))
    if not all(map(_is_table, files)):
        return twin.outputs.names
    there = {name for path in files for name in _header(path)}
    return tuple(n for n in twin.outputs.names if columns.names.get(n, n) in there)


def read_logs(
    paths: Sequence[str | Path],
    twin: Twin,
    columns: Columns = Columns(),
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
    require(
        paths,
        "logs",
        expected="one log at least",
        got="none",
        remedy="name the files with the measurements",
    )
    for name in columns.names:
        require(
            name in (*twin.inputs.names, *twin.outputs.names),
            "columns",
            expected=f"channels of the twin, {', '.join(twin.inputs.names + twin.outputs.names)}",
            got=repr(name),
            remedy="write CHANNEL=COLUMN, the name in the twin first",
        )
    notes: dict[str, list[str]] = {}
    sets, tests = [], []
    for done, path in enumerate(map(Path, paths)):
        mapped = columns.mapping is not None
        own = bool(case is not None and case.records is not None and not columns.names)
        own = own and not mapped
        if own and (_is_table(path) or path.is_dir()):
            assert case is not None
            assert case.records is not None
            calibration, test = case.records(path)
            sets.append(calibration)
            tests.append(test)
        elif mapped:
            rate = None if read_mapping(columns.mapping or "").rate else twin.rate
            found = load(path, rate=rate, max_bytes=max_bytes, mapping=columns.mapping)
            sets.append(_matched(found, twin, columns, path.name, notes))
            for note in found.provenance[0].notes:
                if note != NO_NOMINAL:  # the twin simulates them
                    notes.setdefault(note, []).append(path.name)
        elif _is_table(path):
            sets.append(_table(path, twin, columns, notes, rows_at_rate=rows_at_rate))
        else:
            found = load(path, case=case, max_bytes=max_bytes)
            sets.append(_matched(found, twin, columns, path.name, notes))
        if progress is not None:
            progress((done + 1) / len(paths))
    joined = _healthy(Trajectories.concatenate(sets), notes)
    _check_size(joined)
    if columns.transient:
        joined = _settled(joined, columns.transient)
    unseen = ~joined.mask.any(axis=(0, 1))
    if unseen.any():
        names = ", ".join(np.array(joined.outputs.names)[unseen])
        notes[f"No log holds {names}."] = []
    kept = Trajectories.concatenate(tests) if tests else None
    return Logs(joined, kept, tuple(_sentences(notes)))


def _sentences(notes: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Notes, each after the files to which it applies, if it is about some."""
    for text, files in notes.items():
        more = f" and {len(files) - 2} more" if len(files) > 2 else ""
        yield f"{', '.join(files[:2])}{more}: {text}." if files else text


def _is_table(path: Path) -> bool:
    return path.suffix.lower() == ".csv" and path.is_file()


def _header(path: Path) -> list[str]:
    """The names of a table's columns."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as lines:
            header = next(csv.reader(lines, strict=True), [])
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(
            str(path),
            expected="a CSV file with a header",
            got=f"{type(error).__name__}: {error}",
            remedy="name a text file, in UTF-8 and with commas",
        ) from None

    other = next((each for each in OTHER_SEPARATORS if len(header) == 1 and each in header[0]), "")
    require(
        not other,
        path.name,
        expected="columns that are separated by commas",
        got=f"columns that are separated by {other!r}",
        remedy="write the table with commas, and points in numbers",
    )
    return header


def _clock(path: Path, header: Iterable[str]) -> TimeColumn | None:
    """The column of the times, by its name; None if there is none."""
    for name in header:
        found = TIMES.fullmatch(name.strip())
        if found:
            with path.open(encoding="utf-8-sig", newline="") as lines:
                first = next(csv.DictReader(lines), {}).get(name) or ""
            unit = (found[2] or "s").lower()
            return TimeColumn(name, "iso" if _is_iso(first) else unit)  # type: ignore[arg-type]
    return None


def _is_iso(cell: str) -> bool:
    """Whether a cell is a date with a time, and no number."""
    try:
        float(cell)
    except ValueError:
        pass
    else:
        return False
    try:
        datetime.fromisoformat(cell.strip())
    except ValueError:
        return False
    return True


def _table(
    path: Path, twin: Twin, columns: Columns, notes: dict[str, list[str]], *, rows_at_rate: bool
) -> Trajectories:
    """A table as one trajectory."""
    header = _header(path)
    wanted = {
        name: columns.names.get(name, name) for name in (*twin.inputs.names, *twin.outputs.names)
    }
    _check_columns(path.name, wanted, header, twin, columns)
    clock = columns.time or _clock(path, header)
    if clock is None:
        require(
            rows_at_rate,
            path.name,
            expected="a column with the times of the rows, or the sample rate",
            got=f"columns {', '.join(header)}",
            remedy="give --time COLUMN, or --rate HZ if each row is a sample at that rate",
        )
        notes.setdefault(f"each row is a sample at {twin.rate:g} Hz", []).append(path.name)
    else:
        _check_there(path.name, clock.column, header)
    there = {name: column for name, column in wanted.items() if column in header}
    cells = dict.fromkeys(there.values(), number)
    table = read_columns(path, cells | ({clock.column: clock.number} if clock else {}))
    if clock is not None:
        notes.setdefault(_described(path.name, table, clock, twin.rate), []).append(path.name)
    missing = np.full(len(next(iter(table.values()))), np.nan)
    record = Record({name: there.get(name, "") for name in wanted}, time=clock)
    source = Provenance(path.name, sha256(path))
    return record_in({**table, "": missing}, record, twin, path.stem, source)


def _described(name: str, table: Mapping[str, NDArray], clock: TimeColumn, rate: float) -> str:
    """How the rows of a table come to the sample rate."""
    seconds = clock.seconds(table[clock.column], rate, name)
    own = 1 / float(np.median(np.diff(seconds)))
    even = np.allclose(seconds * rate, np.arange(len(seconds)), atol=1e-3)
    how = f"rows at {own:.4g} Hz (median) are brought to {rate:g} Hz"
    if even:
        how = f"a row per sample at {rate:g} Hz"
    return f"times in column {clock.column} ({clock.unit}), {how}"


def _check_columns(
    name: str, wanted: Mapping[str, str], header: Sequence[str], twin: Twin, columns: Columns
) -> None:
    """Refuse a table that lacks a command, all outputs, or a column that the user named."""
    for channel in columns.names:
        _check_there(name, wanted[channel], header)
    lacking = [each for each in twin.inputs.names if wanted[each] not in header]
    require(
        not lacking,
        name,
        expected=f"a column for every command, {', '.join(twin.inputs.names)}",
        got=f"columns {', '.join(header)}; none for {', '.join(lacking)}",
        remedy=f"give --column {lacking[0]}=COLUMN, or --inputs with the names of the inputs that "
        "were recorded"
        if lacking
        else "",
    )
    require(
        any(wanted[each] in header for each in twin.outputs.names),
        name,
        expected=f"a column for an output of the twin, {', '.join(twin.outputs.names)}",
        got=f"columns {', '.join(header)}",
        remedy=f"give --column {twin.outputs.names[0]}=COLUMN",
    )


def _check_there(name: str, column: str, header: Sequence[str]) -> None:
    require(
        column in header,
        name,
        expected=f"a column {column!r}",
        got=f"columns {', '.join(header)}",
        remedy="name the columns as the header of the file does",
    )


def _matched(
    found: Trajectories, twin: Twin, columns: Columns, name: str, notes: dict[str, list[str]]
) -> Trajectories:
    """Trajectories with the channels of the twin, in its order."""
    require(
        np.isclose(found.rate, twin.rate, rtol=1e-3, atol=0),
        name,
        expected=f"{twin.rate:g} Hz, the sample rate of the twin",
        got=f"{found.rate:g} Hz",
        remedy="resample the log, or give --rate to a twin that takes one",
    )
    inputs = _places(found.inputs, twin.inputs, columns, name, "command")
    outputs = _places(found.outputs, twin.outputs, columns, name, "output")
    lacking = [n for n, at in zip(twin.inputs.names, inputs, strict=True) if at is None]
    there = [at is not None for at in outputs]
    require(
        not lacking and any(there),
        name,
        expected=f"the commands {', '.join(twin.inputs.names)} and at least one of the outputs "
        f"{', '.join(twin.outputs.names)}",
        got=f"commands {found.inputs}, outputs {found.outputs}",
        remedy="give --column CHANNEL=NAME for channels that have another name in the log"
        if columns.mapping is None
        else "rename the tables of the mapping, or have it proposed for the twin: retwin data map "
        "LOG --case plant.fmu",
    )
    taken = _units_taken(found.inputs, twin.inputs, inputs)
    taken += _units_taken(found.outputs, twin.outputs, outputs)
    if taken:
        text = f"the twin states no units of {', '.join(taken)}: taken as those of the log"
        notes.setdefault(text, []).append(name)
    shape = (*found.observed.shape[:2], len(outputs))
    observed, mask = np.zeros(shape), np.zeros(shape, dtype=bool)
    for channel, at in enumerate(outputs):
        if at is not None:
            observed[..., channel] = found.observed[..., at]
            mask[..., channel] = found.mask[..., at]
    commands = found.commands[..., [at for at in inputs if at is not None]]
    return found.replace(
        commands=commands,
        nominal=twin.simulate(commands, seed=0).nominal,
        observed=observed,
        mask=mask,
        rate=twin.rate,
        inputs=twin.inputs,
        outputs=twin.outputs,
    )


def _places(
    own: Channels, wanted: Channels, columns: Columns, name: str, what: str
) -> list[int | None]:
    """Where each channel of the twin is among those of a log; None where it is not."""
    prefix = "u" if what == "command" else "y"
    if own == Channels.numbered(prefix, len(wanted)):
        return list(range(len(wanted)))  # a log whose channels nobody has named
    places: list[int | None] = []
    for channel, unit in zip(wanted.names, wanted.units, strict=True):
        column = columns.names.get(channel, channel)
        if channel in columns.names:
            _check_there(name, column, own.names)
        at = own.names.index(column) if column in own.names else None
        if at is not None:
            other = own.units[at]
            require(
                unit == other or "1" in (unit, other),
                name,
                expected=f"{what} {channel} in {unit}, the unit of the twin",
                got=other,
                remedy="convert the log",
            )
        places.append(at)
    return places


def _units_taken(own: Channels, wanted: Channels, places: Sequence[int | None]) -> list[str]:
    """Channels of a twin without a unit, with the unit that the log has."""
    channels = zip(wanted.names, wanted.units, places, strict=True)
    return [
        f"{channel} ({own.units[at]})"
        for channel, unit, at in channels
        if at is not None and unit == "1" and own.units[at] != "1"
    ]


def _healthy(found: Trajectories, notes: dict[str, list[str]]) -> Trajectories:
    """The healthy and the unlabelled trajectories; InputError if there is none."""
    kept = np.isin(found.labels, (HEALTHY, UNLABELLED))
    require(
        kept.any(),
        "logs",
        expected=f"a trajectory without a label, or labelled {HEALTHY}",
        got=f"labels {', '.join(sorted(found.known_labels))}",
        remedy="identify the parameters of a healthy system",
    )
    if not kept.all():
        notes[f"{int((~kept).sum())} trajectories of other classes are not used."] = []
    return found[kept]


def _check_size(found: Trajectories) -> None:
    """Refuse numbers that stand for missing measurements."""
    for name, values in (("observed", found.observed), ("commands", found.commands)):
        large = np.argwhere(np.abs(values) >= LARGEST)
        channels = found.outputs if name == "observed" else found.inputs
        if len(large):
            row, sample, channel = large[0]
            raise InputError(
                str(found.ids[row]),
                expected=f"numbers below {LARGEST:g}",
                got=f"{values[row, sample, channel]:g} for {channels.names[channel]} at "
                f"{sample / found.rate:g} s",
                remedy="leave the cell empty, or write NaN, where a measurement is missing",
            )


def _settled(found: Trajectories, transient: float) -> Trajectories:
    """The trajectories without their outputs in the first seconds."""
    mask = found.mask.copy()
    mask[:, : round(transient * found.rate)] = False
    require(
        mask.any(),
        "transient",
        expected=f"less than the {found.steps / found.rate:g} s of the longest trajectory",
        got=f"{transient:g} s",
        remedy="give a shorter transient",
    )
    return found.replace(mask=mask)
