"""TDMS of LabVIEW, by nptdms."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import needs_extra
from retwin.data.logs.signals import UNWANTED, Clock, Signal, Skipped, even_times, to_nanoseconds
from retwin.data.row_times import row_times, time_column, unit_in
from retwin.errors import InputError

UNITS = ("unit_string", "NI_UnitDescription", "unit")
"""Properties that may hold the unit of a channel."""


def read(path: Path, wanted: frozenset[str] | None, clock: Clock) -> Iterator[Signal | Skipped]:
    """The channels as `group/channel`; see `data.logs.signals.Reader`.

    Times come from the waveform properties, else from the channel of times of the group, else from
    the rate of the clock. Scales that the file declares are applied.

    Raises
    ------
    InputError
        The file is cut off, or a group has no times.

    """
    nptdms = needs_extra("nptdms", "logs", "reads TDMS")
    with nptdms.TdmsFile.open(path, raw_timestamps=False) as file:
        _check_whole(path, file)
        for group in file.groups():
            channels = {each.name: each for each in group.channels()}
            stamps: dict[int, NDArray] = {}
            own = clock.column.removeprefix(f"{group.name}/") or time_column(channels)
            for name, channel in channels.items():
                title = f"{group.name}/{name}"
                if name == own:
                    continue
                if wanted is not None and title not in wanted:
                    yield Skipped(title, UNWANTED)
                    continue
                dtype = channel.dtype
                if dtype is None or dtype.kind not in "iufb":
                    yield Skipped(title, "text or times")
                    continue
                values = np.asarray(channel[:], dtype=float)
                times = _waveform_times(channel, len(values))
                if times is None:
                    if len(values) not in stamps:
                        stamps[len(values)] = _group_times(
                            path, channels.get(own), group.name, len(values), clock
                        )
                    times = stamps[len(values)]
                yield Signal(title, times, values, _unit(channel))


def _check_whole(path: Path, file: Any) -> None:
    status = getattr(file, "file_status", None)
    if status is not None and status.incomplete_final_segment:
        got = "a last segment that is cut off"
        remedy = "copy the file again, or repair it in LabVIEW"
        raise InputError(path.name, expected="a TDMS file that is whole", got=got, remedy=remedy)


def _unit(channel: Any) -> str:
    return next((str(channel.properties[n]) for n in UNITS if channel.properties.get(n)), "")


def _waveform_times(channel: Any, count: int) -> NDArray | None:
    """Times in ns by the waveform properties; None for a channel without."""
    step = channel.properties.get("wf_increment")
    if not isinstance(step, float | int) or not 0 < step < 1e9:
        return None
    begin = channel.properties.get("wf_start_time")
    start = 0
    if isinstance(begin, np.datetime64) and not np.isnat(begin):
        start = int(begin.astype("datetime64[ns]").astype(np.int64))
        start = max(start, 0)  # LabVIEW writes the year 1904 where there is no time
    offset = channel.properties.get("wf_start_offset", 0.0)
    offset = float(offset) if isinstance(offset, float | int) and abs(offset) < 1e9 else 0.0
    return start + to_nanoseconds(offset + np.arange(count) * step, "s", channel.name)


def _group_times(path: Path, channel: Any, group: str, count: int, clock: Clock) -> NDArray:
    """Times in ns of a group without waveform properties."""
    if channel is not None and len(channel) == count:
        unit, where = (
            _unit(channel) or unit_in(channel.name),
            f"{path.name}, {group}/{channel.name}",
        )
        return row_times(np.asarray(channel[:]), unit, clock, where)
    if clock.rate:
        return even_times(count, clock.rate, path.name)
    expected = f"times of the {count} samples of group {group!r}"
    got = "neither waveform properties nor a channel of times of that length"
    remedy = "name it in the mapping: [time] column = …, or give the samples per s: rate = …"
    raise InputError(path.name, expected=expected, got=got, remedy=remedy)
