"""MAT files: the public layout of the arm's data, nominal and observed side by side in cells."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.io.assembly import DataCase, Raw, assemble
from retwin.data.io.mat5 import NewerMat, read_mat5
from retwin.data.trajectories import Provenance, Trajectories
from retwin.errors import InputError
from retwin.serialisation.files import check_regular, refusing, sha256
from retwin.serialisation.sizes import Budget

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
    variables = mat_variables(path, budget)
    found = [pair for pair in PAIRS if set(pair) <= set(variables)]
    require(
        len(found) == 1,
        path.name,
        expected=" or ".join(f"{x} with {y}" for x, y in PAIRS) + ", one pair of them",
        got=f"the variables {', '.join(sorted(variables)) or 'none'}",
        remedy="save trajectories and class names under these names; for dataset_*.mat files "
        "give the folder that holds one folder per class",
    )
    (x_name, y_name) = found[0]
    blocks = _cells(variables[x_name], f"{path.name}: {x_name}")
    labels = _cells(variables[y_name], f"{path.name}: {y_name}")
    require(
        blocks and len(blocks) == len(labels),
        f"{path.name}: {y_name}",
        expected=f"at least one trajectory and one class name for each, {len(blocks)}",
        got=len(labels),
        remedy="give one class name per trajectory ('' when it is unknown)",
    )
    raws = []
    for i, (cell, label) in enumerate(zip(blocks, labels, strict=True)):
        where = f"{path.name}: {x_name}, trajectory {i}"
        text = _text(label, f"{path.name}: {y_name}, trajectory {i}")
        raws.append(Raw.of_columns(matrix(cell, where), where, case, text))
    source = Provenance(path.name, sha256(path))
    return assemble(raws, source=source, case=case, rate=rate, budget=budget)


def mat_variables(path: Path, budget: Budget, names: Sequence[str] | None = None) -> dict[str, Any]:
    """The variables of a MAT file (those in `names`), as `read_mat5` gives them.

    Raises
    ------
    InputError
        The file is damaged, of version 7.3 (HDF5), or larger than the budget.

    """
    expected = "a readable MAT file"
    with refusing(path.name, expected=expected, remedy="get the file again"):
        budget.take(path.stat().st_size)
        try:
            return read_mat5(check_regular(path).read_bytes(), budget, names)
        except NewerMat:
            raise InputError(
                path.name,
                expected="a MAT file of version 5 to 7",
                got="one of version 7.3 (HDF5) or newer",
                remedy="save it in MATLAB with the option '-v7'",
            ) from None


def matrix(value: Any, where: str) -> NDArray:
    """`value` as a table (T, k) of floats in native byte order, with T and k above 0.

    Raises
    ------
    InputError
        It is no table of real numbers.

    """
    block = np.asarray(value)
    require(
        block.dtype.kind in "iuf" and block.ndim == 2 and block.size,
        where,
        expected="a table of real numbers, samples by columns",
        got=f"{block.dtype} of shape {block.shape}",
        remedy="save the numbers as a two-dimensional array",
    )
    if block.dtype.kind != "f":
        return block.astype(np.float64)
    return block.astype(block.dtype.newbyteorder("="), copy=False)


def _cells(value: Any, where: str) -> list[Any]:
    cells = np.asarray(value)
    require(
        cells.dtype == object and cells.size in (0, max(cells.shape, default=0)),
        where,
        expected="a row of cells, one per trajectory",
        got=f"{cells.dtype} of shape {cells.shape}",
        remedy="save a cell array of size 1 by n",
    )
    return list(cells.ravel())


def _text(value: Any, where: str) -> str:
    name = np.asarray(value)
    # An empty text has no element: a trajectory without a label.
    require(
        name.dtype.kind == "U" and name.size <= 1,
        where,
        expected="a class name",
        got=f"{name.dtype} of shape {name.shape}",
        remedy="save class names as texts",
    )
    return str(name.item()) if name.size else ""
