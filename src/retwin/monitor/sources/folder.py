"""Tables in a folder: CSV or Parquet files that appear, grow and are replaced."""

from __future__ import annotations

import glob
import itertools
import threading
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from retwin.errors import InputError
from retwin.monitor.gate import Gate
from retwin.monitor.samples import Samples
from retwin.monitor.settings import FolderSource
from retwin.monitor.sources.mapped_tables import MappedLayout
from retwin.monitor.sources.source import Source
from retwin.monitor.sources.tables import Layout, Table

__all__ = ["Folder", "base_of"]

LATE = 60 * 10**9
"""Nanoseconds before the newest stored sample from which rows are sent again after a restart: what
is older is not used any more, and what is stored already is recognised."""


class Folder(Source):
    """The files of a pattern, as samples of one machine or of several.

    Files of a machine are read in the order of their first unread rows. How far each was read is
    not stored: after a restart, rows up to a minute before the newest stored sample are left out.

    Parameters
    ----------
    settings : FolderSource
        Its pattern is absolute.
    layouts : mapping of str to Layout or MappedLayout
        The columns of each machine's files.
    newest : mapping of str to int
        Time of the newest stored sample of each machine that has any, in ns.
    report : callable
        Takes a line about an event.

    """

    def __init__(
        self,
        settings: FolderSource,
        layouts: Mapping[str, Layout | MappedLayout],
        newest: Mapping[str, int],
        report: Callable[[str], None],
    ) -> None:
        super().__init__(f"folder {settings.files}", report)
        self._settings = settings
        self._layouts = layouts
        self._newest = newest
        self._tables: dict[tuple[str, str], Table] = {}

    def run(self, gate: Gate, stop: threading.Event) -> None:
        """Read the files again and again, until `stop` is set."""
        while not stop.is_set():
            for asset, layout in self._layouts.items():
                pattern = self._settings.files.replace("{asset}", glob.escape(asset))
                base = base_of(pattern)
                if base.is_dir():
                    self.back()
                    self._read(asset, self._changed(asset, pattern, layout), gate, stop)
                else:
                    self.lost(f"there is no folder {base}")
            stop.wait(self._settings.every)

    def _changed(self, asset: str, pattern: str, layout: Layout | MappedLayout) -> list[Table]:
        """The files of a machine that were written to, in the order of their new rows."""
        paths = glob.glob(pattern, recursive=True)
        for key in [key for key in self._tables if key[0] == asset and key[1] not in paths]:
            del self._tables[key]
        found = []
        for path in sorted(paths):
            table = self._tables.setdefault((asset, path), layout.table(Path(path)))
            try:
                if table.changed():
                    first = next((rows.times[0] for rows in table.rows() if len(rows.times)), None)
                    found.append((0 if first is None else int(first), path, table))
            except OSError:
                continue  # it was removed meanwhile
            except InputError as error:
                self._refuse_file(error)
        return [table for _, _, table in sorted(found, key=lambda each: each[:2])]

    def _read(self, asset: str, tables: list[Table], gate: Gate, stop: threading.Event) -> None:
        for table in tables:
            try:
                for rows in table.rows():
                    for reason in rows.bad:
                        self.refuse(reason)
                    known = self._newest.get(asset)
                    new = (
                        np.ones(len(rows.times), bool)
                        if known is None
                        else rows.times > known - LATE
                    )
                    samples = Samples(asset, rows.times[new], rows.values[new])
                    if new.any() and not self.stored(gate, samples, stop):
                        return
                    table.place = rows.end
            except InputError as error:
                self._refuse_file(error)

    def _refuse_file(self, error: InputError) -> None:
        self.refused += 1
        self._report(f"{self.name}: {error}")


def base_of(pattern: str) -> Path:
    """The folder that a pattern begins with."""
    parts = Path(pattern).parts[:-1]
    fixed = itertools.takewhile(lambda part: not glob.has_magic(part), parts)
    return Path(*fixed)
