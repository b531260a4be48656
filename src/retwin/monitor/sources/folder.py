"""Files in a folder: tables that appear, grow and are replaced, or complete trajectories."""

from __future__ import annotations

import glob
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from retwin.cases.case import Case
from retwin.checks import require
from retwin.data.io import load
from retwin.errors import InputError
from retwin.monitor.live.gate import Gate
from retwin.monitor.models.trajectory.monitor import TrajectoryMonitor
from retwin.monitor.settings import FolderSource
from retwin.monitor.sources.source import Source
from retwin.monitor.sources.tables import GrowingTable, Layout, layout_of, state_of
from retwin.monitor.store.samples import EARLIEST, LONGEST, SECOND, Samples, Trajectory, places
from retwin.twins.twin import check_channels

OVERLAP = 60 * 10**9
"""Nanoseconds before the newest stored sample from which rows are sent again after a restart: what
is older is not used any more, and what is stored already is recognised."""


Read = TypeVar("Read")
"""How the files of a machine are read."""


class Files(Source, Generic[Read]):
    """The files of a pattern, of one machine or of several.

    Parameters
    ----------
    settings : FolderSource
        Its pattern is absolute.
    machines : mapping of str to Layout or Recorded
        How each machine's files are read.
    newest : mapping of str to int
        Time of the newest stored sample of each machine that has any, in ns.
    report : callable
        Takes a line about an event.

    """

    kind: ClassVar[str]
    """What lines that are reported begin with, before the pattern."""

    def __init__(
        self,
        settings: FolderSource,
        machines: Mapping[str, Read],
        newest: Mapping[str, int],
        report: Callable[[str], None],
    ) -> None:
        super().__init__(f"{self.kind} {settings.files}", report)
        self._settings = settings
        self._machines = machines
        self._newest = newest
        self._known: dict[tuple[str, str], Any] = {}
        """What is known of each machine's files by their paths."""

    def run(self, gate: Gate, stop: threading.Event) -> None:
        """Read the files again and again, until `stop` is set."""
        while not stop.is_set():
            patterns = {
                asset: self._settings.files.replace("{asset}", glob.escape(asset))
                for asset in self._machines
            }
            bases = {asset: _base(pattern) for asset, pattern in patterns.items()}
            missing = sorted({str(base) for base in bases.values() if not base.is_dir()})
            if missing:
                self.lost(f"there is no folder {', '.join(missing)}")
            else:
                self.back()
            for asset, pattern in patterns.items():
                if str(bases[asset]) not in missing:
                    self._read(asset, sorted(glob.glob(pattern, recursive=True)), gate, stop)
            stop.wait(self._settings.every)

    def _forget(self, asset: str, paths: list[str]) -> None:
        """Forget the files of a machine that are not there any more."""
        for key in [key for key in self._known if key[0] == asset and key[1] not in paths]:
            del self._known[key]

    @abstractmethod
    def _read(self, asset: str, paths: list[str], gate: Gate, stop: threading.Event) -> None:
        """Send what is new in the files of a machine."""


def _base(pattern: str) -> Path:
    """The folder of a pattern, as far as its name is no pattern."""
    parts = Path(pattern).parts[:-1]
    return Path(*takewhile(lambda part: not glob.has_magic(part), parts))


class Folder(Files[Layout]):
    """The files of a pattern, as samples of one machine or of several.

    Files of a machine are read in the order of their first unread rows. How far each was read is
    not stored: after a restart, rows up to a minute before the newest stored sample are left out.
    """

    kind = "folder"

    def _list_changed(self, asset: str, paths: list[str]) -> list[GrowingTable]:
        """The files of a machine that were written to, in the order of their new rows."""
        self._forget(asset, paths)
        found = []
        for path in paths:
            table = self._machines[asset].table(Path(path))
            table = self._known.setdefault((asset, path), table)
            try:
                if table.changed():
                    first = next((rows.times[0] for rows in table.rows() if len(rows.times)), None)
                    found.append((0 if first is None else int(first), path, table))
            except OSError:
                continue  # it was removed meanwhile
            except InputError as error:
                self._refuse_file(error)
        return [table for _, _, table in sorted(found, key=lambda each: each[:2])]

    def _read(self, asset: str, paths: list[str], gate: Gate, stop: threading.Event) -> None:
        for table in self._list_changed(asset, paths):
            try:
                for rows in table.rows():
                    for reason in rows.bad:
                        self.refuse(reason)
                    new = rows.times > self._newest.get(asset, EARLIEST + OVERLAP) - OVERLAP
                    samples = Samples(asset, rows.times[new], rows.values[new])
                    if new.any() and not self.stored(gate, samples, stop):
                        return
                    table.place = rows.end
            except InputError as error:
                self._refuse_file(error)

    def _refuse_file(self, error: InputError) -> None:
        self.refused += 1
        self._report(f"{self.name}: {error}")


Recorded = tuple[TrajectoryMonitor, Case | None]
"""How the files of a machine are read: by which monitor's channels, and by which case."""


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
        """What a file is, see `state_of`, if it is complete."""
        try:
            now, clock = state_of(path), time.monotonic()
        except OSError:
            return None  # it was removed meanwhile
        file = self._known.setdefault((asset, path), _File(now, clock))
        if file.state != now:
            file.state, file.since = now, clock
        age = max(clock - file.since, time.time() - now[-1] / SECOND)
        return now if age >= self._settings.settle else None

    def _trajectories(self, asset: str, path: Path, changed: int) -> list[Trajectory]:
        """Those of a file; without times of its own they begin when it was changed."""
        monitor, case = self._machines[asset]
        if self._settings.mapping is None and path.suffix in (".csv", ".parquet"):
            return self._of_table(asset, path)
        made = load(path, case=case, mapping=self._settings.mapping)
        check_channels(monitor.twin, made, path.name)
        length = round(made.steps * SECOND / made.rate)
        values = np.concatenate([made.commands, made.measured], axis=2, dtype=float)
        return [Trajectory(asset, changed + i * length, each) for i, each in enumerate(values)]

    def _of_table(self, asset: str, path: Path) -> list[Trajectory]:
        """The trajectory of a table with times, at the sample rate of the twin."""
        monitor, case = self._machines[asset]
        twin = monitor.twin
        channels = (*twin.inputs.names, *twin.outputs.names)
        times, rows = [], []
        for part in layout_of(self._settings, channels, case).table(path).rows():
            for reason in part.bad:
                self.refuse(reason)
            times.append(part.times)
            rows.append(part.values)
        moments = np.concatenate([np.zeros(0, dtype=np.int64), *times])
        if not len(moments):
            return []
        begin = int(moments.min())
        place, first = places(moments, begin, twin.rate)  # the first row counts, as of samples
        expected = f"a trajectory of at most {LONGEST} samples at {twin.rate:g} Hz"
        got = f"times over {place.max() / twin.rate:g} s"
        remedy = "write each trajectory to a file of its own, and check the unit of its times"
        require(place.max() < LONGEST, path.name, expected=expected, got=got, remedy=remedy)
        values = np.full((int(place.max()) + 1, len(channels)), np.nan)
        values[place] = np.concatenate(rows)[first]
        return [Trajectory(asset, begin, values)]
