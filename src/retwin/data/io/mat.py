"""MAT files: the public layout of the arm's data, nominal and observed side by side in cells."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.io.assembly import DataCase, Raw, assemble
from retwin.data.trajectories import Provenance, Trajectories
from retwin.errors import InputError
from retwin.serialisation.files import check_regular, sha256
from retwin.serialisation.sizes import Budget
from retwin.workers.isolation import FileReader
from retwin.workers.process import Frame

PAIRS = (("X_array", "y_array"), ("X_test_array", "y_test_array"))
"""The names of the variables that hold trajectories and class names."""


def read_mat(
    path: Path,
    *,
    case: DataCase | None = None,
    rate: float | None = None,
    max_bytes: int | None = None,
    **_: Any,
) -> Trajectories:
    """Trajectories of a MAT v5 file in the public layout.

    `X_array` and `y_array`, or `X_test_array` and `y_test_array`: n cells of (T, 2 d_y) numbers,
    nominal outputs then observed ones, and n cells with the class names. T may differ.

    Raises
    ------
    InputError
        The file is damaged or too large, has other variables, shapes or types, or no sample rate is
        known.

    """
    budget = Budget(path.name, max_bytes)
    with mat_reader() as reader:
        variables = mat_variables(path, budget, reader)
    found = [pair for pair in PAIRS if set(pair) <= set(variables)]
    expected = " or ".join(f"{x} with {y}" for x, y in PAIRS) + ", one pair of them"
    got = f"the variables {', '.join(sorted(variables)) or 'none'}"
    remedy = "save trajectories and class names under these names; for dataset_*.mat files "
    remedy += "give the folder that holds one folder per class"
    require(len(found) == 1, path.name, expected=expected, got=got, remedy=remedy)
    (x_name, y_name) = found[0]
    blocks = _cells(variables[x_name], f"{path.name}: {x_name}")
    labels = _cells(variables[y_name], f"{path.name}: {y_name}")
    complete = blocks and len(blocks) == len(labels)
    expected = f"at least one trajectory and one class name for each, {len(blocks)}"
    remedy = "give one class name per trajectory ('' when it is unknown)"
    require(complete, f"{path.name}: {y_name}", expected=expected, got=len(labels), remedy=remedy)
    raws = []
    for i, (cell, label) in enumerate(zip(blocks, labels, strict=True)):
        where = f"{path.name}: {x_name}, trajectory {i}"
        text = _text(label, f"{path.name}: {y_name}, trajectory {i}")
        raws.append(Raw.of_columns(matrix(cell, where), where, case, text))
    source = Provenance(path.name, sha256(path))
    return assemble(raws, source=source, case=case, rate=rate, budget=budget)


def mat_reader() -> FileReader:
    """A process that reads MAT files, since scipy trusts the sizes in them: one flipped bit may
    end its process.
    """
    task = f"{__name__}:send_variables"
    return FileReader(task, expected="a readable MAT file", remedy="get the file again")


def mat_variables(
    path: Path, budget: Budget, reader: FileReader, names: Sequence[str] | None = None
) -> dict[str, Any]:
    """The variables of a MAT file (those in `names`).

    Numbers are arrays, texts arrays of str (one per row), cells object arrays, a struct a dict (an
    array of structs an object array), and anything else is None.

    Raises
    ------
    InputError
        The file is damaged, of version 7.3 (HDF5), or larger than the budget.

    """
    size = check_regular(path).stat().st_size
    budget.take(size)
    request = {"path": str(path.resolve()), "names": None if names is None else list(names)}
    frames = reader.read(request, path.name, size, budget)
    return {name: _unpack(tree, iter(arrays)) for (name, tree), arrays in frames}


def send_variables(request: dict[str, Any]) -> Iterator[Frame]:
    """The task of `mat_reader`: the name of each variable, what it consists of, and its numbers."""
    from scipy.io import loadmat

    path = Path(request["path"])
    try:
        found = loadmat(path, variable_names=request["names"])
    except NotImplementedError:  # scipy's error for HDF5
        expected = "a MAT file of version 5 to 7"
        got = "one of version 7.3 (HDF5) or newer"
        remedy = "save it in MATLAB with the option '-v7'"
        raise InputError(path.name, expected=expected, got=got, remedy=remedy) from None
    for name, value in found.items():
        if not name.startswith("__"):
            arrays: list[NDArray] = []
            yield (name, _pack(value, arrays)), arrays


def _pack(value: Any, arrays: list[NDArray]) -> Any:
    """What a value of scipy consists of, for JSON; its numbers are added to `arrays`."""
    if type(value) is not np.ndarray:
        return None
    if value.dtype.names is not None:
        fields = value.dtype.names
        parts = [
            ["struct", {name: _pack(each[name], arrays) for name in fields}] for each in value.flat
        ]
        return parts[0] if len(parts) == 1 else ["cells", value.shape, parts]
    if value.dtype == object:
        return ["cells", value.shape, [_pack(each, arrays) for each in value.flat]]
    if value.dtype.kind == "U":
        return ["texts", value.shape, value.ravel().tolist()]
    arrays.append(value)
    return ["numbers"]


def _unpack(packed: Any, arrays: Iterator[NDArray]) -> Any:
    """The value of which `_pack` made this."""
    match packed:
        case ("numbers",):
            return next(arrays)
        case "texts", shape, parts:
            return np.array(parts, dtype=np.str_).reshape(shape)
        case "struct", fields:
            return {name: _unpack(each, arrays) for name, each in fields.items()}
        case "cells", shape, parts:
            made = np.empty(len(parts), dtype=object)
            for i, each in enumerate(parts):
                made[i] = _unpack(each, arrays)
            return made.reshape(shape)
    return None


def matrix(value: Any, where: str) -> NDArray:
    """`value` as a table (T, k) of floats in native byte order, with T and k above 0.

    Raises
    ------
    InputError
        It is no table of real numbers.

    """
    block = np.asarray(value)
    fits = block.dtype.kind in "iuf" and block.ndim == 2 and block.size
    expected = "a table of real numbers, samples by columns"
    got = f"{block.dtype} of shape {block.shape}"
    remedy = "save the numbers as a two-dimensional array"
    require(fits, where, expected=expected, got=got, remedy=remedy)
    if block.dtype.kind != "f":
        return block.astype(np.float64)
    return block.astype(block.dtype.newbyteorder("="), copy=False)


def _cells(value: Any, where: str) -> list[Any]:
    cells = np.asarray(value)
    fits = cells.dtype == object and cells.size in (0, max(cells.shape, default=0))
    expected = "a row of cells, one per trajectory"
    got = f"{cells.dtype} of shape {cells.shape}"
    require(fits, where, expected=expected, got=got, remedy="save a cell array of size 1 by n")
    return list(cells.ravel())


def _text(value: Any, where: str) -> str:
    name = np.asarray(value)
    # An empty text has no element: a trajectory without a label.
    fits = name.dtype.kind == "U" and name.size <= 1
    got = f"{name.dtype} of shape {name.shape}"
    require(fits, where, expected="a class name", got=got, remedy="save class names as texts")
    return str(name.item()) if name.size else ""
