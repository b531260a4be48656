"""MDF 3 and 4 of measurement systems in vehicles, by asammdf."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from retwin.checks import needs_extra
from retwin.data.logs.signals import UNWANTED, Clock, Signal, Skipped, to_nanoseconds
from retwin.errors import InputError


def read(path: Path, wanted: frozenset[str] | None, clock: Clock) -> Iterator[Signal | Skipped]:
    """The channels by their names; see `data.logs.signals.Reader`.

    A name that several groups have is `group/name`, with the number of the group. Times are those
    of the master channel, conversions to physical values are applied, and samples that the file
    marks as invalid are left out.

    Raises
    ------
    InputError
        A group has fewer samples than it declares: the file is cut off.

    """
    asammdf = needs_extra("asammdf", "logs", "reads MDF")
    with asammdf.MDF(path) as file:
        start = file.header.start_time
        begin = int(start.timestamp() * 1e9) if start is not None else 0
        places = [
            (channel.name, group, index)
            for group, each in enumerate(file.groups)
            for index, channel in enumerate(each.channels)
            if index != file.masters_db.get(group)
        ]
        several = {name for name, n in Counter(name for name, *_ in places).items() if n > 1}
        for name, group, index in places:
            title = f"{group}/{name}" if name in several else name
            if wanted is not None and title not in wanted:
                yield Skipped(title, UNWANTED)
                continue
            yield _signal(path, file, title, (group, index), max(begin, 0))


def _signal(
    path: Path, file: Any, title: str, place: tuple[int, int], begin: int
) -> Signal | Skipped:
    group, index = place
    if file.masters_db.get(group) is None:
        return Skipped(title, "without a channel of times")
    found = file.get(group=group, index=index, ignore_invalidation_bits=True)
    declared = int(file.groups[group].channel_group.cycles_nr)
    if len(found.samples) < declared:
        expected = f"{declared} samples of {title!r}, as it declares"
        remedy = "the file is cut off: get or make it again"
        raise InputError(path.name, expected=expected, got=str(len(found.samples)), remedy=remedy)
    if found.samples.ndim != 1 or found.samples.dtype.kind not in "iufb":
        return Skipped(title, "text or arrays")
    values = found.samples.astype(float)
    invalid = getattr(found, "invalidation_bits", None)
    if invalid is not None:
        values = np.where(np.asarray(invalid, bool), np.nan, values)
    times = to_nanoseconds(found.timestamps, "s", f"{path.name}, times of {title}")
    return Signal(title, begin + times, values, str(found.unit or ""))
