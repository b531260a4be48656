"""Tables in a folder: CSV or Parquet files that appear, grow and are replaced."""

from __future__ import annotations

import glob
import threading
from abc import abstractmethod
from collections.abc import Callable, Mapping
from itertools import takewhile
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from retwin.errors import InputError
from retwin.monitor.live.gate import Gate
from retwin.monitor.settings import FolderSource
from retwin.monitor.sources.source import Source
from retwin.monitor.sources.tables import GrowingTable, Layout
from retwin.monitor.store.samples import Samples
from retwin.monitor.store.updates import EARLIEST

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
