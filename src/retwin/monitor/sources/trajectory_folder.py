"""Trajectories in a folder: each file that is complete has one or several."""

from __future__ import annotations

import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from retwin.cases.case import Case
from retwin.checks import require
from retwin.data.io import load
from retwin.errors import InputError
from retwin.monitor.live.gate import Gate
from retwin.monitor.models.trajectory.monitor import TrajectoryMonitor
from retwin.monitor.sources.folder import Files
from retwin.monitor.sources.layouts import layout_of
from retwin.monitor.store.samples import LONGEST, SECOND, Trajectory, places
from retwin.monitor.store.updates import EARLIEST
from retwin.twins.twin import check_channels


@dataclass(frozen=True)
class Recorded:
    """How the files of a machine are read: by which monitor's channels, and by which case."""

    monitor: TrajectoryMonitor
    case: Case | None = None


@dataclass
class _File:
    """What a file is, since when, and what it was when it was read."""

    state: tuple[int, ...]
    since: float
    read: tuple[int, ...] = ()


class TrajectoryFolder(Files[Recorded]):
    """The files of a pattern, as trajectories of one machine or of several.

    A file is read once it is complete: its last change was `settle` seconds ago, by the clock or as
    long as this has watched it. One that changes afterwards is read again; what is stored already
    is recognised by its begin, and trajectories before the newest stored sample are left out.
    """

    kind = "trajectories"

    def _read(self, asset: str, paths: list[str], gate: Gate, stop: threading.Event) -> None:
        """Send the trajectories of complete files in the order of their begins."""
        self._forget(asset, paths)
        found: list[tuple[int, Trajectory]] = []
        read: list[tuple[str, tuple[int, ...]]] = []
        for path in paths:
            now = self._complete(asset, path)
            if now is None or self._known[asset, path].read == now:
                continue
            try:
                made = self._trajectories(asset, Path(path), now[-1])
            except (InputError, OSError) as error:  # it is read again when it has changed
                self.refuse(error)
                made = []
            newest = self._newest.get(asset, EARLIEST)
            found += [(each.begin, each) for each in made if each.begin > newest]
            read.append((path, now))
        for _, each in sorted(found, key=lambda each: each[0]):
            if not self.stored(gate, each, stop):
                return
        for path, now in read:
            self._known[asset, path].read = now

    def _complete(self, asset: str, path: str) -> tuple[int, ...] | None:
        """What a file is, if it is complete: its number, size and time of change in ns."""
        try:
            about = os.stat(path)
        except OSError:
            return None  # it was removed meanwhile
        now = (about.st_ino, about.st_size, about.st_mtime_ns)
        clock = time.monotonic()
        file = self._known.setdefault((asset, path), _File(now, clock))
        if file.state != now:
            file.state, file.since = now, clock
        age = max(clock - file.since, time.time() - about.st_mtime)
        return now if age >= self._settings.settle else None

    def _trajectories(self, asset: str, path: Path, changed: int) -> list[Trajectory]:
        """Those of a file; without times of its own they begin when it was changed."""
        own, twin = self._machines[asset], self._machines[asset].monitor.twin
        if self._settings.mapping is None and path.suffix in (".csv", ".parquet"):
            return self._of_table(asset, path)
        made = load(path, case=own.case, mapping=self._settings.mapping)
        check_channels(twin, made, path.name)
        length = round(made.steps * SECOND / made.rate)
        values = np.concatenate(
            [made.commands, np.where(made.mask, made.observed, np.nan)], axis=2, dtype=float
        )
        return [Trajectory(asset, changed + i * length, each) for i, each in enumerate(values)]

    def _of_table(self, asset: str, path: Path) -> list[Trajectory]:
        """The trajectory of a table with times, at the sample rate of the twin."""
        own, twin = self._machines[asset], self._machines[asset].monitor.twin
        channels = (*twin.inputs.names, *twin.outputs.names)
        times, rows = [], []
        for part in layout_of(self._settings, channels, own.case).table(path).rows():
            for reason in part.bad:
                self.refuse(reason)
            times.append(part.times)
            rows.append(part.values)
        moments = np.concatenate([np.zeros(0, dtype=np.int64), *times])
        if not len(moments):
            return []
        begin = int(moments.min())
        place, first = places(moments, begin, twin.rate)  # the first row counts, as of samples
        require(
            place.max() < LONGEST,
            path.name,
            expected=f"a trajectory of at most {LONGEST} samples at {twin.rate:g} Hz",
            got=f"times over {place.max() / twin.rate:g} s",
            remedy="write each trajectory to a file of its own, and check the unit of its times",
        )
        values = np.full((int(place.max()) + 1, len(channels)), np.nan)
        values[place] = np.concatenate(rows)[first]
        return [Trajectory(asset, begin, values)]
