"""`Readings`: an output of one record, beside what drives it, and its constant stretches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from retwin.data.quality.finding import Finding
from retwin.data.trajectories import Trajectories

MOVED = 0.1
"""Share of the range of a command, or of an ideal output, from which it counts as moved."""
SAMPLES = 20
"""Samples of a record below which nothing is judged."""


@dataclass(frozen=True, eq=False)
class Readings:
    """An output of one record, without the samples at which nothing was measured.

    Attributes
    ----------
    record, channel : str
        The id of the record, and the name of the output.
    rate : float
        The sample rate in Hz.
    healthy : bool
        Whether the record has no label of a fault.
    samples : (m,) array of int
        The samples that were measured.
    values : (m,) array
        What was measured.
    drive : (m, p) array
        What the output should follow: its ideal value where that is known, else the commands.
    span : (p,) array
        The ranges of these over all records.
    ideal : bool
        Whether `drive` is the ideal output.

    """

    record: str
    channel: str
    rate: float
    healthy: bool
    samples: NDArray
    values: NDArray
    drive: NDArray
    span: NDArray
    ideal: bool

    @cached_property
    def stretches(self) -> NDArray:
        """Begin and end (r, 2) of the stretches of one value, of two samples or more."""
        edges = np.flatnonzero(np.diff(self.values) != 0) + 1
        ends = np.concatenate([[0], edges, [len(self.values)]])
        found = np.stack([ends[:-1], ends[1:]], axis=1)
        return found[np.diff(found, axis=1)[:, 0] > 1]

    @cached_property
    def still(self) -> NDArray:
        """Samples (r,) of each stretch after everything that drives the output has moved."""
        moving = np.ptp(self.drive, axis=0) > MOVED * self.span
        found = np.zeros(len(self.stretches), dtype=int)
        if not moving.any():
            return found
        drive, limit = self.drive[:, moving], MOVED * self.span[moving]
        # Samples of one value from which on they are a stretch of interest.
        for place in np.flatnonzero(np.diff(self.stretches)[:, 0] >= 3).tolist():
            start, end = self.stretches[place].tolist()
            moved = np.abs(drive[start:end] - drive[start]) > limit
            if moved.any(axis=0).all():
                found[place] = end - start - int(moved.argmax(axis=0).max())
        return found

    @cached_property
    def levels(self) -> tuple[NDArray, NDArray, NDArray]:
        """Values (v,) that last, and samples (v,) in all and after what drives them has moved.

        The latter without what lasts from the begin on, unless it is all: it may not move yet.
        """
        lengths = np.diff(self.stretches)[:, 0]
        counted = (self.stretches[:, 0] > 0) | (lengths == self.size)
        values, own = np.unique(self.values[self.stretches[:, 0]], return_inverse=True)
        if not len(values):
            return values, values, values
        every, still = (
            np.asarray(np.bincount(own, each)) for each in (lengths, counted * self.still)
        )
        return values, every, still

    def span_of(self, level: float) -> tuple[int, int, int]:
        """Begin and end of the stretches of a value, and their number."""
        own = self.stretches[self.values[self.stretches[:, 0]] == level]
        return int(own.min()), int(own.max()), len(own)

    @property
    def size(self) -> int:
        """The number of samples."""
        return len(self.values)

    @cached_property
    def noise(self) -> NDArray:
        """Standard deviation (w,) of white noise in windows of `WINDOW` samples; 0 without.

        The fourth differences of white noise have 70/6 of the power of its second ones, those of
        motion hardly any.
        """
        count = (self.size - 4) // WINDOW
        second, fourth = (
            np.sum(np.diff(self.values, n)[: count * WINDOW].reshape(count, WINDOW) ** 2, axis=1)
            for n in (2, 4)
        )
        return np.where(fourth > 4 * second, np.sqrt(fourth / WINDOW / 70), 0.0)

    def finding(self, kind: str, text: str, start: int, end: int) -> Finding:
        """A finding about the values from `start` to before `end`."""
        begin, stop = 0.0, 0.0
        if end - start < self.size:
            begin = float(self.samples[start] / self.rate)
            stop = float((self.samples[end - 1] + 1) / self.rate)
        return Finding(self.record, self.channel, kind, text, begin, stop)


WINDOW = 10
"""Samples over which noise is estimated."""


def readings_of(records: Trajectories, samples: int = SAMPLES) -> Iterator[list[Readings]]:
    """For each output, what was measured of it in the records that have so many samples."""
    lengths, commands = records.lengths.tolist(), records.commands.astype(float)
    span, ids, healthy = np.ptp(commands, axis=(0, 1)), records.ids.tolist(), records.maybe_healthy
    for k, channel in enumerate(records.outputs.names):
        ideal = records.nominal[..., k, None].astype(float)
        known = bool(np.ptp(ideal) > 0)
        drive, own = (ideal, np.ptp(ideal).reshape(1)) if known else (commands, span)
        found = []
        for i, length in enumerate(lengths):
            seen = np.flatnonzero(records.mask[i, :length, k])
            if len(seen) >= samples:
                name = ids[i], channel, records.rate, bool(healthy[i])
                values = records.observed[i, seen, k].astype(float)
                found.append(Readings(*name, seen, values, drive[i, seen], own, known))
        if found:
            yield found
