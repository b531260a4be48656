"""Parquet, Arrow IPC and Feather, by pyarrow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import at_most, needs_extra
from retwin.data.logs.signals import MAX_SIGNALS, Clock, Signal, Skipped, inside, named_units
from retwin.data.row_times import time_column
from retwin.data.tables import Table

FILES = (b"ARROW1", b"FEA1\0\0")
"""How files of Arrow begin that are no streams."""


def read(path: Path, wanted: frozenset[str] | None, clock: Clock) -> Iterator[Signal | Skipped]:
    """The signals of a table: its columns of numbers; see `data.logs.signals.Reader`."""
    yield from read_table(path, wanted, clock).signals(clock, wanted)


def read_table(path: Path, wanted: frozenset[str] | None, clock: Clock) -> Table:
    """The columns that may be wanted; those that are not have no cells.

    Fields of structures are `column.field`, elements of lists of one length `column[0]`. The unit
    is in the title, or in the metadata of the column under `unit`. Titles that are alike but for
    the unit are names as a whole.
    """
    arrow = needs_extra("pyarrow", "logs", "reads Parquet and Arrow")
    needs_extra("pyarrow.compute", "logs", "takes structures apart")
    table, names = _table(path, arrow, wanted, clock)
    columns: dict[str, Any] = {}
    units = {n: unit for title, (n, unit) in names.items() if title not in table.column_names}
    for field, column in zip(table.schema, table.columns, strict=True):
        about = field.metadata or {}
        name, unit = names[field.name]
        unit = unit or about.get(b"unit", b"").decode("utf-8", "replace")
        for own, leaf in _leaves(arrow, name, column, 0):
            columns[own], units[own] = leaf, unit
            remedy = "write those that are wanted to a file of their own"
            at_most(path.name, len(columns), MAX_SIGNALS, "columns", remedy=remedy)

    def cells(name: str) -> NDArray:
        column, types = columns[name], arrow.types
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
    return Table(path.name, units, table.num_rows, cells, others=others)


def _table(
    path: Path, arrow: Any, wanted: frozenset[str] | None, clock: Clock
) -> tuple[Any, dict[str, tuple[str, str]]]:
    """The table with the columns that may be wanted; names and units of all by their titles."""
    if path.suffix.lower() == ".parquet":
        parquet = needs_extra("pyarrow.parquet", "logs", "reads Parquet")
        with parquet.ParquetFile(path) as file:
            found = _by_title(file.schema_arrow.names)
            # A wide file has many columns that a mapping does not name.
            names = [name for name, _ in found.values()]
            some = {clock.column or time_column(names), *(wanted or ())}
            kept = [
                title
                for title, (name, _) in found.items()
                if wanted is None or any(inside(each, name) for each in some)
            ]
            return file.read(columns=kept), found
    with path.open("rb") as stream:
        if stream.read(6) in FILES or path.suffix.lower() == ".feather":
            feather = needs_extra("pyarrow.feather", "logs", "reads Feather")
            table = feather.read_table(path, memory_map=False)
        else:
            stream.seek(0)
            with arrow.ipc.open_stream(stream) as batches:
                table = batches.read_all()
    return table, _by_title(table.column_names)


def _by_title(titles: Sequence[str]) -> dict[str, tuple[str, str]]:
    return dict(zip(titles, named_units(titles), strict=True))


def _leaves(
    arrow: Any, name: str, column: Any, depth: int, *, max_depth: int = 8, max_elements: int = 64
) -> Iterator[tuple[str, Any]]:
    """The columns inside a column of structures, or of lists of one length.

    Parameters
    ----------
    max_depth : int, default 8
        Structures inside structures at most.
    max_elements : int, default 64
        Elements of a list of fixed length that become signals.

    """
    kind = column.type
    if depth < max_depth and arrow.types.is_struct(kind):
        for place in range(kind.num_fields):
            field = arrow.compute.struct_field(column, [place])
            yield from _leaves(arrow, f"{name}.{kind.field(place).name}", field, depth + 1)
    elif (
        depth < max_depth
        and arrow.types.is_fixed_size_list(kind)
        and kind.list_size <= max_elements
    ):
        for place in range(kind.list_size):
            element = arrow.compute.list_element(column, place)
            yield from _leaves(arrow, f"{name}[{place}]", element, depth + 1)
    else:
        yield name, column
