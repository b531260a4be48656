"""`TimeColumn`: when the rows of a table were recorded, and how they come to a sample rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from retwin.checks import one_of, positive, require
from retwin.data.logs.signals import NANOSECOND, NANOSECONDS, Clock
from retwin.data.resampling import SAME, Resampling, longest_bridge, resample
from retwin.data.row_times import row_times
from retwin.data.tables import Table

UNITS = (*NANOSECONDS, "iso")
"""Units of times."""
WRONG_UNIT = 100.0
"""Ratio of the interval between rows to the sample period at which the unit is refused; units
differ by a factor of 1000."""


@dataclass(frozen=True)
class TimeColumn:
    """The times of a table's rows, and how its values come to the samples of a record.

    The first row is the first sample. Measurements are interpolated along straight lines, between
    samples that are at most `max_gap` apart; elsewhere they are missing.

    Parameters
    ----------
    column : str
        The column of the times, which increase.
    unit : {"s", "ms", "us", "ns", "iso"}
        Their unit, or ISO 8601 text; without a time zone it is UTC.
    commands : {"hold", "linear"}
        The commands between rows: held, so that a sample is the mean until the next one (a pulse
        keeps its area), or straight lines.
    max_gap : float, optional
        The longest interval in s between values of a channel that is bridged; by default 2.5 times
        the sample period or the median interval, whichever is longer.

    Raises
    ------
    InputError
        An unknown unit or kind of command, or an interval that is not positive.

    """

    column: str
    unit: Literal["s", "ms", "us", "ns", "iso"] = "s"
    commands: Literal["hold", "linear"] = "hold"
    max_gap: float | None = None

    def __post_init__(self) -> None:
        one_of("unit", self.unit, UNITS, remedy="give the unit of the times")
        one_of("commands", self.commands, ("hold", "linear"))
        if self.max_gap is not None:
            positive("max_gap", self.max_gap, unit="s", remedy="leave it out")

    def seconds(self, table: Table, rows: slice, rate: float, record: str) -> NDArray:
        """Times (T,) of some rows in s since the first one.

        Raises
        ------
        InputError
            There are fewer than two, one is missing, repeated, or before the one above, they hardly
            cover the record, or their unit does not suit the sample rate in Hz. The message names
            the record.

        """
        place = f"{table.place}, {record} record"
        cells, _, _ = table.stamps(self.column)
        times = row_times(cells[rows], "", Clock(unit=self.unit), place)
        expected = f"two rows at least, with a time in column {self.column!r} of each"
        got = f"{len(times)} rows"
        require(len(times) >= 2, place, expected=expected, got=got, remedy="check column and rows")
        steps = np.diff(times) * NANOSECOND
        row = int(np.argmax(steps <= 0))
        expected = f"times in column {self.column!r} that increase"
        got = f"{'the same time' if steps[row] == 0 else 'an earlier time'} in data row {row + 1}"
        got += f", {steps[row]:g} s after the row before"
        remedy = "sort the rows by time, and keep one of those that were logged twice"
        require(steps[row] > 0, place, expected=expected, got=got, remedy=remedy)
        ratio = float(np.median(steps)) * rate
        require(
            1 / WRONG_UNIT < ratio < WRONG_UNIT,
            place,
            expected=f"times about {1 / rate:g} s apart, the sample period",
            got=f"a median of {ratio / rate:g} s with unit {self.unit!r}",
            remedy=f"give the unit of column {self.column!r}: {', '.join(UNITS)}",
        )
        elapsed: NDArray = (times - times[0]) * NANOSECOND
        row = int(np.argmax(steps))
        require(
            elapsed[-1] * rate < WRONG_UNIT * len(times),
            place,
            expected="rows that cover the record",
            got=f"an interval of {steps[row]:g} s before data row {row + 1}, in column "
            f"{self.column!r}",
            remedy="give the rows before and after it as two records",
        )
        return elapsed

    def resample(self, seconds: NDArray, values: NDArray, rate: float, how: Resampling) -> NDArray:
        """Values (T, d) at times (T,) in s, as samples (N, d) at a rate in Hz; NaN if missing."""
        grid = np.arange(int((seconds[-1] + SAME / rate) * rate) + 1) / rate
        longest = self.max_gap or longest_bridge(seconds, 1 / rate)
        columns = [resample(seconds, v, grid, 1 / rate, how, longest=longest) for v in values.T]
        return np.array(columns).reshape(len(values.T), len(grid)).T
