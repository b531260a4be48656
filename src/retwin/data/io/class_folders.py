"""Folders with one folder per class: of CSV files, or of the arm's authors' `dataset_*.mat`."""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.io.assembly import DataCase, Raw, assemble
from retwin.data.io.mat import mat_reader, mat_variables, matrix
from retwin.data.trajectories import Channels, Provenance, Trajectories
from retwin.errors import InputError
from retwin.progress import Progress, tracked
from retwin.serialisation.files import sha256
from retwin.serialisation.sizes import Budget
from retwin.workers.isolation import FileReader

Reader = Callable[[Path, str, "DataCase | None", Budget, FileReader], Raw]
VARIABLES = ("trajCmds", "trajResps", "dataset", "motorCmdsRadius")
"""The variables of these files that are read."""
BYTES_PER_BLOCK, BYTES_PER_NUMBER = 2**20, 8
"""Bytes of a CSV file that are read together to count its numbers, and those of a number."""


def read_class_folders(
    path: Path,
    *,
    case: DataCase | None = None,
    rate: float | None = None,
    progress: Progress | None = None,
    max_bytes: int | None = None,
) -> Trajectories:
    """Trajectories of the files `path`/class name/*.csv or `path`/class name/dataset_*.mat.

    CSV: no header, one row per sample, columns nominal then observed (with a case that has the
    width for it: commands first); `nan` is a missing measurement. MAT: `trajCmds` (desired),
    `trajResps` (realised), `motorCmdsRadius` (commands in rad), or the older `dataset` of six
    columns. Commands that MATLAB stored as `timeseries` objects cannot be decoded without MATLAB:
    then the set has none, and the case completes them from the desired path.

    Raises
    ------
    InputError
        There are no such files or files of both kinds, one has other contents, or all of them are
        too large.

    """
    kinds: list[tuple[str, Reader]] = [("*.csv", _read_csv), ("dataset_*.mat", _read_dataset)]
    found = [(_in_order(path, pattern), read) for pattern, read in kinds]
    found = [(files, read) for files, read in found if files]
    expected = "a folder per class with *.csv or dataset_*.mat files"
    got = f"{'both kinds' if found else 'no such file'} in {path}"
    remedy = "keep the kinds apart" if found else "give the folder above the class folders"
    require(len(found) == 1, "path", expected=expected, got=got, remedy=remedy)
    files, read = found[0]
    raws, budget = [], Budget(path.name, max_bytes)
    with mat_reader() as reader:
        for file in tracked(files, len(files), progress):
            where = f"{file.parent.name}/{file.name}"
            got = "a pipe, a device or a folder"
            remedy = "keep nothing else of that name there"
            require(file.is_file(), where, expected="a regular file", got=got, remedy=remedy)
            raws.append(read(file, where, case, budget, reader))
    raws, inputs = _commands_of_case(raws, case, radians=read is _read_dataset)
    source = Provenance(path.resolve().name, sha256(path))
    return assemble(raws, source=source, case=case, rate=rate, budget=budget, inputs=inputs)


def _in_order(path: Path, pattern: str) -> list[Path]:
    """Files of the class folders, the numbers in their names in numerical order."""
    files = [file for file in path.glob(f"*/{pattern}") if not file.parent.name.startswith(".")]

    def key(file: Path) -> tuple[Any, ...]:
        parts: list[Any] = re.split(r"([0-9]+)", file.name)
        parts[1::2] = map(int, parts[1::2])
        # Equal names (2 and 02) fall back on the text, so that the order never depends on the disk.
        return file.parent.name, parts, file.name

    return sorted(files, key=key)


def _read_csv(file: Path, where: str, case: DataCase | None, budget: Budget, _: FileReader) -> Raw:
    with file.open("rb") as blocks:
        for part in iter(lambda: blocks.read(BYTES_PER_BLOCK), b""):
            numbers = 1 + part.count(b",") + part.count(b"\n")
            budget.take(max(BYTES_PER_NUMBER * numbers, len(part)))  # a line may be a whole file
    label, values, width, got = file.parent.name, array("d"), 0, "no rows"
    with file.open(encoding="utf-8-sig", errors="replace") as lines:
        for number, line in enumerate(lines, start=1):
            fields = line.strip().split(",")
            if fields == [""]:
                continue
            width, got, before = width or len(fields), "", len(values)
            try:
                values.extend(map(float, fields))
            except ValueError:  # at the first field that is no number
                bad = fields[len(values) - before].strip()[:40]
                got = f"{bad!r} in line {number}"
                break
            if len(fields) != width:
                got = f"{len(fields)} columns in line {number} after {width} before"
                break
    expected = "rows of numbers with commas between, all of one length, without a header"
    remedy = "repair that line ('nan' stands for a missing measurement)"
    require(not got, where, expected=expected, got=got, remedy=remedy)
    block = np.frombuffer(values).reshape(-1, width)
    return Raw.of_columns(block, where, case, label, f"{label}/{file.stem}")


def _read_dataset(
    file: Path, where: str, case: DataCase | None, budget: Budget, reader: FileReader
) -> Raw:
    # Outputs per sample in the arm's authors' files: x, y and z.
    width = len(case.outputs) if case is not None else 3
    paths = mat_variables(file, budget, reader, VARIABLES)
    if {"trajCmds", "trajResps"} <= set(paths):
        nominal = _upright(paths["trajCmds"], width, f"{where}: trajCmds")
        observed = _upright(paths["trajResps"], width, f"{where}: trajResps")
        commands, recorded = _motor_commands(paths.get(VARIABLES[-1]), where, len(nominal))
    elif "dataset" in paths:
        both = _upright(paths["dataset"], 2 * width, f"{where}: dataset")
        nominal, observed = both[:, :width], both[:, width:]
        commands, recorded = None, None
    else:
        expected = "the variables trajCmds and trajResps, or dataset"
        got = ", ".join(sorted(mat_variables(file, budget, reader))) or "none"
        remedy = "give the folder of the authors' data as it is"
        raise InputError(where, expected=expected, got=got, remedy=remedy)
    fits = len(nominal) == len(observed)
    expected = f"{len(nominal)} samples, as trajCmds"
    remedy = "sample both on the same grid"
    require(fits, f"{where}: trajResps", expected=expected, got=len(observed), remedy=remedy)
    label = file.parent.name
    return Raw(where, label, nominal, observed, commands, f"{label}/{file.stem}", recorded)


def _upright(value: Any, width: int, where: str) -> NDArray:
    """`value` as (T, width), transposed if only its first axis has that width."""
    block = matrix(value, where)
    fits = (block.shape[0] == width) != (block.shape[1] == width)
    expected = f"samples by {width} columns, or {width} rows by samples"
    remedy = "save samples by columns, with another number of samples than columns"
    require(fits, where, expected=expected, got=f"shape {block.shape}", remedy=remedy)
    return block if block.shape[1] == width else block.T


def _motor_commands(value: Any, where: str, steps: int) -> tuple[NDArray | None, float | None]:
    """Commands (T, motors) in rad and their sample rate in Hz, None where the file has none.

    A table of numbers, or a cell per motor with a vector or with a struct of `Data` and `Time`.
    """
    where = f"{where}: motorCmdsRadius"
    if value is None:
        return None, None
    cells = np.asarray(value)
    if cells.dtype != object:
        return _upright(np.transpose(cells), steps, where).T, None
    series = [_series(cell, where) for cell in cells.ravel()]
    if not series or any(data is None for data, _ in series):
        return None, None
    vectors = [data for data, _ in series if data is not None]
    aligned = all(len(data) == steps for data in vectors)
    expected = f"{steps} samples per motor, as trajCmds"
    got = ", ".join(str(len(data)) for data in vectors)
    remedy = "sample commands and paths on the same grid"
    require(aligned, where, expected=expected, got=got, remedy=remedy)
    rates = {round(rate, 3) for _, rate in series if rate is not None}
    got = ", ".join(f"{rate:g} Hz" for rate in sorted(rates))
    remedy = "sample all motors on the same grid"
    require(len(rates) <= 1, where, expected="one sample rate", got=got, remedy=remedy)
    return np.stack(vectors, axis=1), next(iter(rates), None)


def _series(cell: Any, where: str) -> tuple[NDArray | None, float | None]:
    """Values (T,) and sample rate (Hz) of one motor; None for what cannot be decoded."""
    if cell is None:
        return None, None
    data = _vector(cell.get("Data") if isinstance(cell, dict) else cell, where)
    if not isinstance(cell, dict) or "Time" not in cell:
        return data, None
    times = _vector(cell["Time"], where)
    periods = np.diff(times)
    growing = len(periods) and np.all(np.isfinite(periods) & (periods > 0))
    expected = "one growing time per value"
    got = f"{len(times)} times for {len(data)} values, or times that do not grow"
    remedy = "repair the Time of the motor commands"
    require(len(times) == len(data) and growing, where, expected=expected, got=got, remedy=remedy)
    # The largest ratio of two sample periods that count as jitter: one sample less makes it 2.
    expected = "a constant sample rate"
    got = f"steps from {periods.min():g} to {periods.max():g} s"
    remedy = "resample the commands"
    require(periods.max() <= 1.5 * periods.min(), where, expected=expected, got=got, remedy=remedy)
    return data, float(1 / np.median(periods))


def _vector(value: Any, where: str) -> NDArray:
    """`value` (T, 1), (1, T) or (1, 1, T) as (T,)."""
    return matrix(np.atleast_2d(np.squeeze(np.asarray(value))), where).ravel()


def _commands_of_case(
    raws: list[Raw], case: DataCase | None, *, radians: bool
) -> tuple[list[Raw], Channels | None]:
    """`raws` with commands in the unit of the case, and the names of the command channels.

    Without a case commands in rad stay as they are. A case that does not take rad does not get
    them, and recovers its commands from the nominal path.
    """
    if not radians or any(raw.commands is None for raw in raws):
        return raws, None
    motors = {raw.commands.shape[1] for raw in raws if raw.commands is not None}
    if case is None:
        return raws, Channels.numbered("motor_", max(motors), "rad") if len(motors) == 1 else None
    if set(case.inputs.units) == {"rad"} and motors == {len(case.inputs)}:
        return raws, case.inputs
    return [replace(raw, commands=None) for raw in raws], None
