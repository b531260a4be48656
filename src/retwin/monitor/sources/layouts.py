"""The layout of growing tables: by columns that are named, or by the mapping of a log."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from retwin.cases.case import Case
from retwin.cases.columns import ColumnRecords
from retwin.checks import require, same_names
from retwin.data.io.assembly import DataCase
from retwin.data.logs.channels import table_of
from retwin.data.logs.mapping import Mapping
from retwin.data.trajectories import Channels
from retwin.monitor.settings import FolderSource
from retwin.monitor.sources.tables import Layout

REMEDY = "leave it out of the mapping of this source, or write complete logs"


def layout_of(settings: FolderSource, channels: Sequence[str], case: Case | None) -> Layout:
    """The columns of the settings, else those of the case's records, else names of the channels.

    Raises
    ------
    InputError
        A channel has no column, or there is another; or the records of the case differ.

    """
    records = case.records if case is not None else None
    known = records.every_record if isinstance(records, ColumnRecords) else ()
    columns = settings.columns or _same(
        [dict(each.columns) for each in known], "columns", {name: name for name in channels}
    )
    remedy = 'write for each channel NAME = "COLUMN"'
    same_names("sources.columns", columns, channels, "a column for each of", remedy=remedy)
    clocks = [each.clock for each in known if each.clock is not None]
    time = settings.time or _same([each.column for each in clocks], "time", "time")
    unit = settings.unit or _same([each.unit for each in clocks], "unit", "s")
    several = [columns[name] for name in channels]
    return Layout(time, unit, tuple((e,) if isinstance(e, str) else tuple(e) for e in several))


def mapped_layout(
    mapping: Mapping, inputs: Channels, outputs: Channels, rate: float, case: DataCase | None
) -> Layout:
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
    every, cut, time = (*commands, *measured), mapping.cut, mapping.time

    def refuse(wrong: bool, key: str, got: object, expected: str) -> None:
        require(not wrong, f"mapping: {key}", expected=expected, got=got, remedy=REMEDY)

    other_rate = mapping.rate is not None and not np.isclose(mapping.rate, rate, rtol=1e-6)
    refuse(other_rate, "rate", mapping.rate, f"that of the twin, {rate:g} Hz, or none")
    wanted = "a column of times, since a file that is replaced starts again"
    refuse(time.rate is not None, "time.rate", time.rate, wanted)
    wanted = "all rows of a stream, of which nothing is left out"
    refuse(cut.by in ("trigger", "length"), "cut.by", cut.by, wanted)
    refuse(cut.min_length is not None, "cut.min_length", cut.min_length, wanted)
    for name, own, _ in commands:
        wanted = "another one: it is held until the next row, which is not there yet"
        refuse(own.resample == "linear", f"commands.{name}.resample", own.resample, wanted)
    for name, own, _ in measured:
        wanted = "another one for rows as they appear: what was not measured is missing"
        refuse(own.resample == "hold", f"outputs.{name}.resample", own.resample, wanted)
    offsets = sorted({own.clock_offset for _, own, _ in every})
    wanted = "the same for all channels, since a row of a stream has one time; MQTT and OPC UA take"
    wanted += " channels with clocks of their own"
    refuse(len(offsets) > 1, "clock_offset", offsets, wanted)
    columns = tuple(tuple(own.signals) for _, own, _ in every)
    return Layout(time.column, time.unit, columns, time.format, every, len(commands))


def _same(found: list[Any], what: str, default: Any) -> Any:
    """What all records of a case have in common, or the default where there are none."""
    require(
        all(each == found[0] for each in found),
        f"sources.{what}",
        expected=f"the {what} of the files",
        got="none, and records of the case that differ in it",
        remedy=f"give `{what}` in the source",
    )
    return found[0] if found else default
