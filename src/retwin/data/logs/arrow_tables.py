"""Parquet, Arrow IPC and Feather, by pyarrow."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import at_most, needs_extra
from retwin.data.logs.signals import MAX_SIGNALS, UNWANTED, Clock, Signal, Skipped, named_unit
from retwin.data.row_times import time_column
from retwin.data.tables import Table

FILES = (b"ARROW1", b"FEA1\0\0")
"""How files of Arrow begin that are no streams."""
MAX_DEPTH = 8
"""Structures inside structures at most."""
MAX_ELEMENTS = 64
"""Elements of a list of fixed length that become signals."""


def read(path: Path, wanted: frozenset[str] | None, clock: Clock) -> Iterator[Signal | Skipped]:
    """The signals of a table: its columns of numbers; see `data.logs.signals.Reader`."""
    table, left_out = read_table(path, wanted, clock)
    yield from (Skipped(name, UNWANTED) for name in left_out)
    yield from table.signals(clock, wanted)


def read_table(path: Path, wanted: frozenset[str] | None, clock: Clock) -> tuple[Table, list[str]]:
    """The columns that may be wanted, and the names of the others.

    Fields of structures are `column.field`, elements of lists of one length `column[0]`. The unit
    is in the title, or in the metadata of the column under `unit`.
    """
    arrow = needs_extra("pyarrow", "logs", "reads Parquet and Arrow")
    needs_extra("pyarrow.compute", "logs", "takes structures apart")
    table, left_out = _table(path, arrow, wanted, clock)
    columns: dict[str, Any] = {}
    units: dict[str, str] = {}
    for field, column in zip(table.schema, table.columns, strict=True):
        name, unit = named_unit(field.name)
        name = field.name if name in columns else name
        about = field.metadata or {}
        unit = unit or about.get(b"unit", b"").decode("utf-8", "replace")
        for own, leaf in _leaves(arrow, name, column, 0):
            columns[own], units[own] = leaf, unit
            remedy = "write those that are wanted to a file of their own"
            at_most(path.name, len(columns), MAX_SIGNALS, "columns", remedy=remedy)

    def cells(name: str) -> NDArray:
        column, types = columns[name], arrow.types
        if types.is_timestamp(column.type):
            made = column.cast("timestamp[ns]", safe=False).cast("int64").to_numpy()
            missing = np.isnan(made) if made.dtype.kind == "f" else np.zeros(len(made), bool)
            whole = np.where(missing, 0, made).astype("datetime64[ns]")
            return np.where(missing, np.datetime64("NaT"), whole)
        if types.is_boolean(column.type):
            column = column.cast("int8")
        elif types.is_decimal(column.type):
            column = column.cast("double", safe=False)
        return np.asarray(column.to_numpy())

    numeric = ("is_integer", "is_floating", "is_boolean", "is_decimal")
    others = {
        name: f"of type {str(column.type)[:40]}"
        for name, column in columns.items()
        if not any(getattr(arrow.types, each)(column.type) for each in numeric)
    }
    return Table(path.name, units, table.num_rows, cells, others=others), left_out


def _table(
    path: Path, arrow: Any, wanted: frozenset[str] | None, clock: Clock
) -> tuple[Any, list[str]]:
    """The table with the columns that may be wanted, and the names of the others."""
    if path.suffix.lower() == ".parquet":
        parquet = needs_extra("pyarrow.parquet", "logs", "reads Parquet")
        with parquet.ParquetFile(path) as file:
            titles = {each: named_unit(each)[0] for each in file.schema_arrow.names}
            if wanted is None:
                return file.read(), []
            # A wide file has many columns that a mapping does not name.
            names = {clock.column or time_column(titles.values()), *wanted}
            kept = [title for title, name in titles.items() if _names(name, names)]
            others = [name for title, name in titles.items() if title not in kept]
            return file.read(columns=kept), others
    with path.open("rb") as stream:
        if stream.read(6) in FILES or path.suffix.lower() == ".feather":
            feather = needs_extra("pyarrow.feather", "logs", "reads Feather")
            return feather.read_table(path, memory_map=False), []
        stream.seek(0)
        with arrow.ipc.open_stream(stream) as batches:
            return batches.read_all(), []


def _names(column: str, names: set[str]) -> bool:
    """Whether one of the names is that column, or something inside it."""
    return any(n == column or n.startswith((f"{column}.", f"{column}[")) for n in names)


def _leaves(arrow: Any, name: str, column: Any, depth: int) -> Iterator[tuple[str, Any]]:
    """The columns inside a column of structures, or of lists of one length."""
    kind = column.type
    if depth < MAX_DEPTH and arrow.types.is_struct(kind):
        for place in range(kind.num_fields):
            field = arrow.compute.struct_field(column, [place])
            yield from _leaves(arrow, f"{name}.{kind.field(place).name}", field, depth + 1)
    elif (
        depth < MAX_DEPTH
        and arrow.types.is_fixed_size_list(kind)
        and kind.list_size <= MAX_ELEMENTS
    ):
        for place in range(kind.list_size):
            element = arrow.compute.list_element(column, place)
            yield from _leaves(arrow, f"{name}[{place}]", element, depth + 1)
    else:
        yield name, column
