"""Samples from values of single channels that arrive one by one, each with its time."""

from __future__ import annotations

import bisect
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass
class _Group:
    """Values of one moment: its time in ns, when its first one arrived in s, and each channel's."""

    time: int
    arrived: float
    values: dict[int, float] = field(default_factory=dict)


class Assembly:
    """Puts values whose times differ by less than half a sample period together.

    A channel that reports changes alone keeps its value until the next one, and the first samples
    wait until each channel has one. A value that arrives after the sample of its time was taken
    makes another one of that time.

    Parameters
    ----------
    channels : int
        Number of channels.
    period : float
        Sample period in s.
    settle : float
        Time in s for which a sample waits for channels that may not have changed.

    """

    def __init__(self, channels: int, period: float, settle: float) -> None:
        self._near = round(period * 0.5e9)
        self._settle = settle
        self._held: list[float | None] = [None] * channels
        self._reached = [-(2**63)] * channels
        self._groups: list[_Group] = []

    def hold(self, channel: int, value: float) -> None:
        """Take the present value of a channel, which is from before the samples."""
        self._held[channel] = value

    def add(self, channel: int, time: int, value: float, now: float) -> None:
        """Take a value at a time in ns, NaN if it is missing, which arrived at `now` in s."""
        self._reached[channel] = max(self._reached[channel], time)
        for group in reversed(self._groups):
            if abs(group.time - time) < self._near and channel not in group.values:
                group.values[channel] = value
                return
        group = _Group(time, now, {channel: value})
        bisect.insort(self._groups, group, key=lambda each: each.time)

    def take(self, now: float) -> tuple[NDArray, NDArray]:
        """Times (n,) in ns and values (n, channels) of the samples that are complete."""
        times, rows = [], []
        while self._groups:
            group = self._groups[0]
            complete = min(self._reached) > group.time - self._near
            if not complete and now - group.arrived < self._settle:
                break
            self._groups.pop(0)
            for channel, value in group.values.items():
                self._held[channel] = value
            row = [each for each in self._held if each is not None]
            if len(row) == len(self._held):
                times.append(group.time)
                rows.append(row)
        values = np.array(rows, dtype=float).reshape(len(rows), len(self._held))
        return np.array(times, dtype=np.int64), values
