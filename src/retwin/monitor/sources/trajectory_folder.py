"""Trajectories in a folder: each file that is complete has one or several."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from retwin.cases.case import Case
from retwin.checks import require
from retwin.data.io import load
from retwin.errors import InputError
from retwin.monitor.live.gate import Gate
from retwin.monitor.models.trajectories import TrajectoryMonitor
from retwin.monitor.settings import FolderSource
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


class TrajectoryFolder(Files):
    """The files of a pattern, as trajectories of one machine or of several.

    A file is read once it is complete: its last change was `settle` seconds ago, by the clock or as
    long as this has watched it. One that changes afterwards is read again; what is stored already
    is recognised by its begin.

    Parameters
    ----------
    settings : FolderSource
        Its pattern is absolute.
    machines : mapping of str to Recorded
        How each machine's files are read.
    newest : mapping of str to int
        Time of the newest stored sample of each machine that has any, in ns: trajectories that
        begin earlier are left out.
    report : callable
        Takes a line about an event.

    """

    def __init__(
        self,
        settings: FolderSource,
        machines: Mapping[str, Recorded],
        newest: Mapping[str, int],
        report: Callable[[str], None],
    ) -> None:
        super().__init__("trajectories", settings, machines, newest, report)
        self._machines = machines
        self._seen: dict[tuple[str, str], tuple[tuple[int, ...], float]] = {}
        """What a file was, and since when."""
        self._done: dict[tuple[str, str], tuple[int, ...]] = {}

    def _read(self, asset: str, paths: list[str], gate: Gate, stop: threading.Event) -> None:
        """Send the trajectories of complete files in the order of their begins."""
        for key in [key for key in self._seen if key[0] == asset and key[1] not in paths]:
            del self._seen[key]
            self._done.pop(key, None)
        found: list[tuple[int, Trajectory]] = []
        read: list[tuple[str, tuple[int, ...]]] = []
        for path in paths:
            now = self._complete(asset, path)
            if now is None or self._done.get((asset, path)) == now:
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
            self._done[asset, path] = now

    def _complete(self, asset: str, path: str) -> tuple[int, ...] | None:
        """What a file is, if it is complete: its number, size and time of change in ns."""
        try:
            about = os.stat(path)
        except OSError:
            return None  # it was removed meanwhile
        now = (about.st_ino, about.st_size, about.st_mtime_ns)
        clock = time.monotonic()
        before, since = self._seen.get((asset, path), (None, clock))
        if before != now:
            since = clock
            self._seen[asset, path] = now, since
        age = max(clock - since, time.time() - about.st_mtime)
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
