"""The tables of the store, and the two databases that hold them: SQLite and PostgreSQL."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import existing, needs_extra, nothing, require
from retwin.errors import InputError, brief
from retwin.monitor.store.audit import Entry

if TYPE_CHECKING:
    import sqlalchemy as sa
else:
    sa = needs_extra("sqlalchemy", "monitor", "holds what the monitor stores")

SCHEMA = 1
"""The version of the tables."""
WRITER = 0x72657477696E
"""The number of the lock that the one process that writes holds in PostgreSQL: "retwin"."""
PATIENCE = 5.0
"""Seconds for which a lock inside SQLite is waited for."""
PRAGMAS = {
    "journal_mode": "wal",
    "synchronous": 2,  # FULL: each commit is flushed to the disk
    "fullfsync": 1,  # on macOS through the disk's cache too
    "foreign_keys": 1,
    "busy_timeout": int(1000 * PATIENCE),
    "journal_size_limit": 2**26,
}
"""Settings of each connection to SQLite, read back after they were made."""
SERVER = {"fsync": "on", "full_page_writes": "on", "synchronous_commit": "on"}
"""Settings of PostgreSQL without which a commit is not durable."""

TABLES = sa.MetaData()
meta = sa.Table(
    "retwin_meta",
    TABLES,
    sa.Column("key", sa.Text, primary_key=True),
    sa.Column("value", sa.Text, nullable=False),
)
# SQLite numbers rows by itself only where the type of the key is INTEGER.
_KEY = sa.BigInteger().with_variant(sa.Integer, "sqlite")
assets = sa.Table(
    "retwin_assets",
    TABLES,
    sa.Column("id", _KEY, primary_key=True, autoincrement=True),
    sa.Column("name", sa.Text, nullable=False, unique=True),
    sa.Column("channels", sa.Integer, nullable=False),
    sa.Column("settings", sa.Text, nullable=False),
    sa.Column("version", sa.Integer),
)
samples = sa.Table(
    "retwin_samples",
    TABLES,
    sa.Column("asset", _KEY, sa.ForeignKey(assets.c.id), primary_key=True),
    sa.Column("time", sa.BigInteger, primary_key=True),
    sa.Column("packed", sa.LargeBinary, nullable=False),
    sqlite_with_rowid=False,
)
states = sa.Table(
    "retwin_states",
    TABLES,
    sa.Column("asset", _KEY, sa.ForeignKey(assets.c.id), primary_key=True, autoincrement=False),
    sa.Column("time", sa.BigInteger, nullable=False),
    sa.Column("arrays", sa.LargeBinary, nullable=False),
)
log = sa.Table(
    "retwin_log",
    TABLES,
    sa.Column("sequence", _KEY, primary_key=True, autoincrement=False),
    sa.Column("kind", sa.Text, nullable=False),
    sa.Column("text", sa.Text, nullable=False),
    sa.Column("previous", sa.Text, nullable=False),
    sa.Column("hash", sa.Text, nullable=False),
    sa.Index("retwin_log_kind", "kind", "sequence"),
)


class Database:
    """A database with the tables of the store.

    Parameters
    ----------
    file : Path
        The file of SQLite, used without `url`.
    url : str
        A PostgreSQL database, or "".
    read_only : bool
        Whether statements that write fail.

    """

    def __init__(self, file: Path, url: str, *, read_only: bool) -> None:
        self._read_only = read_only
        self._writer: Any = None
        if url:
            needs_extra("psycopg", "postgres", "speaks to PostgreSQL")
            address = _address(url)
            self.name = address.render_as_string(hide_password=True)
            # Bounded, so that a server that does not answer is an error.
            self._engine = sa.create_engine(address, connect_args={"connect_timeout": 10})
            sa.event.listen(self._engine, "connect", self._prepare_postgresql)
        else:
            what = f"the folder of a store, with {file.name}"
            existing("folder", file.parent, file.is_file() or not read_only, what)
            self.name = str(file)
            self._engine = sa.create_engine(sa.URL.create("sqlite", database=str(file)))
            sa.event.listen(self._engine, "connect", self._prepare_sqlite)

    @property
    def _sqlite(self) -> bool:
        return self._engine.dialect.name == "sqlite"

    def open(self) -> None:
        """Make the tables that are missing, and check durability and schema."""
        if self._read_only:
            with self.reader() as connection:
                self._check_schema(connection)
            return
        with self.writer() as connection:
            if sa.inspect(connection).has_table(meta.name):
                self._check_schema(connection)
            TABLES.create_all(connection)
            if connection.execute(meta.select()).first() is None:
                connection.execute(meta.insert().values(key="schema", value=str(SCHEMA)))

    def close(self) -> None:
        """Close all connections."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        self._engine.dispose()

    @contextmanager
    def reader(self) -> Iterator[Any]:
        """A connection for one or a few statements that read."""
        with self._reporting(), self._engine.connect() as connection:
            yield connection

    @contextmanager
    def writer(self) -> Iterator[Any]:
        """The one connection that writes, in a transaction that ends with the block."""
        with self._reporting():
            if self._writer is None:
                self._writer = self._engine.connect()
                self._hold()
            try:
                with self._writer.begin():
                    yield self._writer
            except sa.exc.DBAPIError as error:
                if error.connection_invalidated:
                    self._drop()
                raise

    def insert(self, connection: Any, table: sa.Table, rows: list[tuple]) -> None:
        """Insert rows, whose values are in the order of the table's columns.

        The driver gets them as they are: SQLAlchemy takes as long for each as the database.
        """
        if rows:
            mark = "?" if self._sqlite else "%s"
            marks = ", ".join([mark] * len(table.columns))
            connection.exec_driver_sql(f"INSERT INTO {table.name} VALUES ({marks})", rows)

    @contextmanager
    def _reporting(self) -> Iterator[None]:
        """Turn errors of the database into an InputError on one line."""
        try:
            yield
        except sa.exc.SQLAlchemyError as error:
            cause = getattr(error, "orig", None) or error
            expected = "a database that stores and reads"
            got = f"{type(cause).__name__}: {brief(cause)}"
            remedy = "nothing of this step was acknowledged: check its free disk space, its "
            remedy += "rights and its server, and repeat the step"
            raise InputError(self.name, expected=expected, got=got, remedy=remedy) from None

    def shrink(self) -> None:
        """Give the pages of removed rows back: to the disk in SQLite, to new rows in PostgreSQL."""
        with self.reader() as connection:
            if self._sqlite:
                # A script, since a statement is executed up to its first row only: one page.
                raw: Any = connection.connection.driver_connection
                raw.executescript("PRAGMA incremental_vacuum; PRAGMA wal_checkpoint(TRUNCATE)")
            else:
                alone = connection.execution_options(isolation_level="AUTOCOMMIT")
                alone.execute(sa.text(f"VACUUM {samples.name}"))

    def _check_schema(self, connection: Any) -> None:
        row = connection.execute(meta.select().where(meta.c.key == "schema")).one_or_none()
        found = row.value if row is not None else str(SCHEMA)
        expected = f"a store of schema {SCHEMA}"
        got = f"schema {found[:20]}"
        remedy = "open it with the version of retwin that wrote it, or a newer one"
        require(found == str(SCHEMA), self.name, expected=expected, got=got, remedy=remedy)

    def _hold(self, *, release: float = 2.0) -> None:
        """Take the lock of the process that writes, which ends with the connection.

        In SQLite the lock on the store's folder does that.

        Parameters
        ----------
        release : float, default 2.0
            Seconds in which PostgreSQL notices that a process ended, and frees its lock.

        """
        if self._sqlite:
            return
        ask = sa.text(f"SELECT pg_try_advisory_lock({WRITER})")
        until = time.monotonic() + release
        while not (held := self._writer.execute(ask).scalar_one()) and time.monotonic() < until:
            time.sleep(0.1)
        self._writer.commit()
        if not held:
            self._drop()
        expected = "a store that no other process writes to"
        got = "one that a process writes to now"
        remedy = "wait until it has ended, open it with read_only, or give another database"
        require(held, self.name, expected=expected, got=got, remedy=remedy)

    def _drop(self) -> None:
        self._writer.invalidate()
        self._writer.close()
        self._writer = None

    def _prepare_sqlite(self, raw: Any, _: Any) -> None:
        if self._read_only:
            raw.execute(f"PRAGMA busy_timeout={PRAGMAS['busy_timeout']}")
            raw.execute("PRAGMA query_only=1")
            return
        # Before the first table is made; later it has no effect.
        raw.execute("PRAGMA auto_vacuum=2")
        found = {}
        for name, value in PRAGMAS.items():
            raw.execute(f"PRAGMA {name}={value}")
            found[name] = raw.execute(f"PRAGMA {name}").fetchone()[0]
        self._require_durable(found, PRAGMAS, "put the store on a local disk")

    def _prepare_postgresql(self, raw: Any, _: Any) -> None:
        with raw.cursor() as cursor:
            cursor.execute("SET synchronous_commit = on")
            if self._read_only:
                cursor.execute("SET default_transaction_read_only = on")
            found = {name: cursor.execute(f"SHOW {name}").fetchone()[0] for name in SERVER}
        raw.commit()
        self._require_durable(found, SERVER, "change the settings of the server")

    def _require_durable(self, found: dict, needed: dict, remedy: str) -> None:
        wrong = [f"{name}={found[name]}" for name, value in needed.items() if found[name] != value]
        expected = ", ".join(f"{name}={value}" for name, value in needed.items())
        nothing(self.name, wrong, expected, remedy=remedy)


def present(connection: Any, key: int, times: NDArray, *, at_once: int = 500) -> NDArray:
    """Those of the times that samples of an asset have; others between them are not read.

    Parameters
    ----------
    at_once : int, default 500
        Times that are looked for at once; a query has a limit.

    """
    found: list[int] = []
    for first in range(0, len(times), at_once):
        chosen = samples.c.time.in_(times[first : first + at_once].tolist())
        own = sa.select(samples.c.time).where(samples.c.asset == key, chosen)
        found += connection.execute(own).scalars().all()
    return np.array(found, dtype=np.int64)


def last_entry(connection: Any) -> Entry | None:
    """The newest entry of the log; None if it has none."""
    row = connection.execute(log.select().order_by(log.c.sequence.desc()).limit(1)).one_or_none()
    return row and Entry(*row)


def _address(url: str) -> Any:
    try:
        address = sa.make_url(url)
    except sa.exc.ArgumentError:
        address = sa.URL.create("none")
    postgresql = address.get_backend_name() in ("postgresql", "postgres")
    expected = "a PostgreSQL database, postgresql://user@host/name"
    remedy = "correct it, or leave it out for SQLite in the folder"
    require(postgresql, "url", expected=expected, got="another address", remedy=remedy)
    return address.set(drivername="postgresql+psycopg")
