"""What the monitor remembers: samples, states of the streams, and the log, in SQL.

SQLite in a folder by default, or PostgreSQL. Samples, states and log entries of many assets are
committed together, and what was acknowledged survives a crash of the process and of the machine.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import instance, one_per, require, whole
from retwin.monitor.store.audit import START, Entry, append, canonical
from retwin.monitor.store.database import (
    Database,
    assets,
    last_entry,
    log,
    present,
    sa,
    samples,
    states,
)
from retwin.monitor.store.samples import (
    EARLIEST,
    LATEST,
    WORD,
    Asset,
    Committed,
    Update,
    one_asset,
    pack,
)
from retwin.serialisation.files import refusing
from retwin.serialisation.places import in_use

FILE = "monitor.sqlite"
"""The database in the folder of the store, where no other is given."""
ROWS = 4096
"""Rows that are read at once."""


class Store:
    """A store in a folder; a context manager that closes it.

    One process at a time opens a store to write. After an error in `commit`, nothing of it was
    acknowledged: read state and head again before the next one, since a database whose connection
    broke may have stored all of it. The methods may be called in any thread.

    Parameters
    ----------
    folder : path
        The folder of the store, which is made. It holds `monitor.sqlite` and versions of twins.
    url : str, optional
        A PostgreSQL database instead, "postgresql://user@host/name".
    max_samples : int, optional
        Samples of each asset that are kept, up to 10 % more, the oldest removed first; by default
        all. Entries of the log are never removed.
    read_only : bool
        Whether to read only, also beside the process that writes.

    Raises
    ------
    InputError
        Another process writes to the store, its schema is newer, it is no store, it is on a disk
        or server that does not promise durability, or a package of the extra is missing.

    """

    def __init__(
        self,
        folder: str | Path,
        url: str = "",
        *,
        max_samples: int | None = None,
        read_only: bool = False,
    ) -> None:
        if max_samples is not None:
            whole("max_samples", max_samples, at_least=1)
        self.folder = Path(folder)
        self.read_only = read_only
        self._max_samples = max_samples
        self.lock = threading.RLock()
        """Held while a thread reads something and writes what depends on it."""
        self._stale = True
        """Whether the database may hold something else than the last transaction left."""
        self._last: Entry | None = None
        self._assets: dict[str, tuple[int, int]] | None = None
        """Key and channels of each asset by its name; None if they must be read."""
        self._held: dict[int, _Held] = {}
        with ExitStack() as opened:
            if not read_only:
                opened.enter_context(in_use(self.folder))
            self._database = Database(self.folder / FILE, url, read_only=read_only)
            opened.callback(self._database.close)
            self._database.open()
            if not read_only and max_samples is not None:
                with self._writing() as connection:
                    for key, _ in self._known(connection).values():
                        self._remove_surplus(connection, key)
                self._database.shrink()
            self._opened = opened.pop_all()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the store, so that another process may write; once more is no error."""
        with self.lock:
            self._opened.close()

    def add_asset(self, asset: Asset) -> None:
        """Add an asset, or replace the settings and the version of one; durable on return.

        Raises
        ------
        InputError
            Its name is empty, longer than 200 characters or not printable, or one of this name
            has another number of channels.

        """
        name = instance("name", asset.name, str, remedy="give the asset's name as text")
        printable = 0 < len(name) <= 200 and name.isprintable()
        expected = "from 1 to 200 printable characters"
        got = repr(name[:80])
        require(printable, "name", expected=expected, got=got, remedy="rename the asset")
        if asset.version is not None:
            whole("version", asset.version, at_most=2**31 - 1)
        row = {
            "channels": whole("channels", asset.channels, at_least=1, at_most=10_000),
            "settings": canonical(asset.settings),
            "version": asset.version,
        }
        with self._writing() as connection:
            known = self._known(connection).get(name)
            if known is None:
                connection.execute(assets.insert().values(name=name, **row))
            else:
                same = known[1] == asset.channels
                expected = f"{known[1]}, as the asset {name} has"
                remedy = "add the machine under another name"
                require(same, "channels", expected=expected, got=asset.channels, remedy=remedy)
                connection.execute(assets.update().where(assets.c.id == known[0]).values(row))
            self._assets = None

    def assets(self) -> list[Asset]:
        """All assets in the order in which they were added."""
        with self._database.reader() as connection:
            rows = connection.execute(assets.select().order_by(assets.c.id)).all()
        loaded = [(row, Entry(0, "", row.settings, "", "").data) for row in rows]
        return [Asset(row.name, row.channels, data, row.version) for row, data in loaded]

    def commit(
        self, updates: Sequence[Update] = (), entries: Sequence[tuple[str, Mapping]] = ()
    ) -> Committed:
        """Store samples, states and log entries, all or none; durable on return.

        Parameters
        ----------
        updates : sequence of Update
            New samples and states of assets, each asset at most once.
        entries : sequence of (str, mapping)
            Kinds and data of new entries of the log, see `retwin.monitor.store.audit.canonical`.

        Raises
        ------
        InputError
            An asset is unknown, an array has another shape, the data of an entry are not JSON's,
            the disk is full or the database fails. Nothing was stored or acknowledged.

        """
        with self._writing() as connection:
            known = self._known(connection)
            packed = [pack(each, known) for each in updates]
            names = [each.asset for each in updates]
            one_per("updates", names, len(set(names)), "asset", remedy="join the samples of each")
            repeated, inserted, latest = {}, list[tuple](), list[tuple]()
            for name, (key, times, rows, state) in zip(names, packed, strict=True):
                new = self._new(connection, key, times)
                if not new.all():
                    repeated[name] = times[~new]
                inserted += [rows[i] for i in np.flatnonzero(new)]
                latest += state
            self._database.insert(connection, samples, inserted)
            if latest:
                keys = [row[0] for row in latest]
                connection.execute(states.delete().where(states.c.asset.in_(keys)))
            self._database.insert(connection, states, latest)
            chained = []
            for kind, data in entries:
                self._last = append(self._last, kind, data)
                chained.append(self._last)
            self._database.insert(connection, log, [astuple(entry) for entry in chained])
            for key, *_ in packed:
                self._remove_surplus(connection, key)
        return Committed(repeated, chained)

    def samples(self, asset: str, after: int | None = None) -> Iterator[tuple[NDArray, NDArray]]:
        """The samples of an asset after a stream time, in order of time, part by part.

        Parameters
        ----------
        asset : str
            Its name.
        after : int, optional
            Stream time in nanoseconds; by default all samples.

        Yields
        ------
        (array (n,), array (n, channels))
            Times in nanoseconds and values. Samples that are added meanwhile may be among them.

        """
        key, channels = self._asset(asset)
        if after is not None:
            whole("after", after, at_least=EARLIEST, at_most=LATEST)
        chosen = samples.select().where(samples.c.asset == key)
        for rows in self._parts(chosen, samples.c.time, after):
            times = np.array([row.time for row in rows], dtype=np.int64)
            with refusing(f"samples of {asset}", expected="stored values", remedy="restore a copy"):
                joined = b"".join(row.packed for row in rows)
                values = np.frombuffer(joined, WORD).reshape(len(rows), channels)
            yield times, values.astype(float)

    def state(self, asset: str) -> tuple[int, dict[str, NDArray]] | None:
        """Stream time in nanoseconds and arrays of the last state of an asset; None without one."""
        from safetensors.numpy import load

        key, _ = self._asset(asset)
        with self._database.reader() as connection:
            row = connection.execute(states.select().where(states.c.asset == key)).one_or_none()
        if row is None:
            return None
        with refusing(f"state of {asset}", expected="stored arrays", remedy="restore a copy"):
            return row.time, load(row.arrays)

    def present(self, asset: str, times: NDArray) -> NDArray:
        """Those of the times (n,), in nanoseconds, at which samples of an asset are stored."""
        if not len(times):
            return np.zeros(0, dtype=np.int64)
        key, _ = self._asset(asset)
        with self._database.reader() as connection:
            return present(connection, key, times)

    def log(self, kind: str | None = None, after: int = -1) -> Iterator[Entry]:
        """The entries of the log in their order, or those of one kind, read part by part.

        With `after`, only those whose sequence, from 0 on, is larger.
        """
        chosen = log.select() if kind is None else log.select().where(log.c.kind == kind)
        for rows in self._parts(chosen, log.c.sequence, after):
            yield from (Entry(*row) for row in rows)

    def _parts(
        self, chosen: sa.Select, key: sa.Column, last: int | None
    ) -> Iterator[Sequence[Any]]:
        """Rows in the order of a key, after a value of it, part by part.

        No connection is held while a part is used, which may take long.
        """
        while True:
            later = chosen if last is None else chosen.where(key > last)
            with self._database.reader() as connection:
                rows = connection.execute(later.order_by(key).limit(ROWS)).all()
            if not rows:
                return
            yield rows
            last = int(rows[-1]._mapping[key])

    @property
    def last(self) -> Entry | None:
        """The last entry of the log; None if it has none."""
        with self._database.reader() as connection:
            return last_entry(connection)

    @property
    def head(self) -> str:
        """The hash of the last entry of the log: keep it elsewhere to detect a cut-off log."""
        return last.hash if (last := self.last) else START

    def _asset(self, name: str) -> tuple[int, int]:
        with self.lock, self._database.reader() as connection:
            return one_asset(self._known(connection), name)

    def _known(self, connection: Any) -> dict[str, tuple[int, int]]:
        if self._assets is None or self.read_only:
            rows = connection.execute(assets.select()).all()
            self._assets = {row.name: (row.id, row.channels) for row in rows}
        return self._assets

    @contextmanager
    def _writing(self) -> Iterator[Any]:
        """The connection that writes, in a transaction; what is known of it is read again later."""
        expected = "one that was opened to write"
        got = "one that was opened to read only"
        remedy = "open it without read_only"
        require(not self.read_only, "store", expected=expected, got=got, remedy=remedy)
        with self.lock:
            try:
                with self._database.writer() as connection:
                    if self._stale:
                        self._last = last_entry(connection)
                        self._assets = None
                        self._held = {}
                        self._stale = False
                    yield connection
            except BaseException:
                self._stale = True
                raise

    def _new(self, connection: Any, key: int, times: NDArray) -> NDArray:
        """Whether each sample (n,) is neither stored nor repeated; it is counted as stored."""
        if not len(times):
            return np.ones(0, dtype=bool)
        held = self._held_by(connection, key)
        if times[0] > held.latest and (np.diff(times) > 0).all():  # the usual case: no query
            new = np.ones(len(times), dtype=bool)
        else:
            new = np.zeros(len(times), dtype=bool)
            new[np.unique(times, return_index=True)[1]] = True
            new &= ~np.isin(times, present(connection, key, times))
        held.latest = max(held.latest, int(times.max()))
        held.count += int(new.sum())
        return new

    def _held_by(self, connection: Any, key: int) -> _Held:
        if key not in self._held:
            own = samples.c.asset == key
            latest = connection.execute(sa.select(sa.func.max(samples.c.time)).where(own)).scalar()
            count = 0
            if self._max_samples is not None:
                counted = sa.select(sa.func.count()).select_from(samples).where(own)
                count = connection.execute(counted).scalar_one()
            self._held[key] = _Held(count, EARLIEST if latest is None else latest)
        return self._held[key]

    def _remove_surplus(self, connection: Any, key: int, *, surplus: float = 0.1) -> None:
        """Remove the oldest samples of an asset that has too many.

        Parameters
        ----------
        surplus : float, default 0.1
            Share of `max_samples` by which an asset may exceed it, so that samples are removed in
            groups.

        """
        held = self._held_by(connection, key)
        if self._max_samples is None or held.count <= self._max_samples * (1 + surplus):
            return
        own = samples.c.asset == key
        times = sa.select(samples.c.time).where(own).order_by(samples.c.time)
        place = held.count - self._max_samples - 1
        last = connection.execute(times.limit(1).offset(place)).scalar_one()
        connection.execute(samples.delete().where(own, samples.c.time <= last))
        held.count = self._max_samples


@dataclass
class _Held:
    """The number of an asset's samples, where they are counted, and the time of the latest one."""

    count: int
    latest: int
