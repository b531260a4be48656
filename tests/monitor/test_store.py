"""The store: what was acknowledged is there, once, in SQLite and in PostgreSQL alike."""

from __future__ import annotations

import resource
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from retwin.errors import InputError
from retwin.monitor import Asset, Store, Update, verify
from retwin.monitor.store.store import FILE

Open = Callable[..., Store]
LATEST = 2**63 - 1


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.slow)])
def opened(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Open]:
    """Opens the same store again and again, in a new database of each kind."""
    url = request.getfixturevalue("new_database")() if request.param == "postgresql" else ""
    stores: list[Store] = []

    def open_store(**options) -> Store:
        stores.append(Store(tmp_path / "store", url, **options))
        return stores[-1]

    yield open_store
    for store in stores:
        store.close()


def update(asset: str, first: int, last: int, *, channels: int = 2) -> Update:
    """Samples at all times from the first to before the last, whose values depend on the time."""
    times = np.arange(first, last)
    return Update(asset, times, values(times, channels), {"latest": np.array(float(last))})


def values(times: np.ndarray, channels: int = 2) -> np.ndarray:
    return np.outer(times + 0.1, np.arange(1.0, channels + 1))


def read(store: Store, asset: str, after: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    parts = list(store.samples(asset, after))
    if not parts:
        return np.empty(0, int), np.empty((0, 2))
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def test_what_was_committed_is_read_again(opened: Open) -> None:
    store = opened()
    empty = store.head
    hostile = "</script> 'Ω\"; DROP TABLE retwin_log; --"
    for asset in (Asset("pump", 2, {"rate": 0.1}), Asset(hostile, 3, version=4)):
        store.add_asset(asset)
    arrays = {
        "mean": np.arange(3.0),
        "covariance": np.arange(6.0).reshape(2, 3).T,
        "count": np.array(7),
        "none": np.empty((0, 4), np.float32),
    }
    times = np.array([-5, 0, LATEST])
    given = np.array([[0.1, np.nan], [-0.0, np.inf], [5e-324, 1.7976931348623157e308]])
    done = store.commit(
        [Update("pump", times, given, arrays), update(hostile, 0, 9, channels=3)],
        [("alarm", {"asset": hostile, "time": LATEST, "evidence": 0.1 + 0.2})],
    )
    assert done.repeated == {}
    store.close()
    again = opened()
    assert again.assets() == [Asset("pump", 2, {"rate": 0.1}), Asset(hostile, 3, {}, 4)]
    found_times, found = read(again, "pump")
    np.testing.assert_array_equal(found_times, times)
    assert found.tobytes() == given.tobytes(), "NaN and signs too"
    time, state = again.state("pump") or (0, {})
    assert time == LATEST
    assert {name: (each.dtype, each.shape) for name, each in state.items()} == {
        name: (each.dtype, each.shape) for name, each in arrays.items()
    }
    for name, each in arrays.items():
        np.testing.assert_array_equal(state[name], each)
    assert list(again.log()) == done.entries
    assert done.entries[0].data["evidence"] == 0.1 + 0.2
    assert again.head == done.entries[0].hash != empty
    assert verify(again.log(), again.head).ok
    assert verify(again.log(), empty).ok, "an empty log's head"


def test_repeated_samples_are_ignored_and_reported(opened: Open) -> None:
    store = opened()
    store.add_asset(Asset("pump", 2))
    store.add_asset(Asset("tank", 2))
    store.commit([update("pump", 0, 10)])
    other = Update("pump", [12, 3, 12, 20, 9, 11], np.full((6, 2), -1.0))
    done = store.commit([other, update("tank", 5, 8)])
    assert {name: each.tolist() for name, each in done.repeated.items()} == {"pump": [3, 12, 9]}
    times, found = read(store, "pump")
    assert times.tolist() == [*range(10), 11, 12, 20]
    np.testing.assert_array_equal(found, [*values(np.arange(10)), *np.full((3, 2), -1.0)])
    assert read(store, "pump", after=9)[0].tolist() == [11, 12, 20]
    assert read(store, "pump", after=20)[0].size == 0
    store.close()
    again = opened().commit([Update("pump", [20, 15], np.zeros((2, 2)))])
    assert again.repeated["pump"].tolist() == [20], "as after a lost acknowledgement"


def test_a_commit_is_stored_whole_or_not_at_all(opened: Open) -> None:
    store = opened()
    store.add_asset(Asset("pump", 2))
    first = store.commit([update("pump", 0, 5)], [("note", {"n": 0})])
    wrong = (
        ([update("pump", 5, 9), update("nothing", 0, 1)], []),
        ([update("pump", 5, 9), update("pump", 9, 12, channels=3)], []),
        ([update("pump", 5, 9)], [("note", {"n": float("nan")})]),
        ([update("pump", 5, 9)], [("note", {"n": 1}), ("Kind of note", {})]),
        ([Update("pump", [5.5], [[0.0, 0.0]])], []),
        ([Update("pump", [2**63], [[0.0, 0.0]])], []),
        ([Update("pump", [5], [["a", "b"]])], []),
        ([Update("pump", [5, 6], [[0.0, 0.0], [0.0]])], []),
        ([Update("pump", state={"x": np.array(["text"])}, time=9)], []),
        ([Update("pump", state={"x": np.zeros(1)}, time=2**63)], []),
        ([Update("pump", state={"x": np.zeros(1)})], []),
        ([Update("pump", [5], [[0.0, 0.0]]), Update("pump", state={"x": np.zeros(2)})], []),
    )
    for updates, entries in wrong:
        with pytest.raises(InputError):
            store.commit(updates, entries)
        assert read(store, "pump")[0].tolist() == [*range(5)]
        assert list(store.log()) == first.entries
        assert (store.state("pump") or (0,))[0] == 4
    done = store.commit([update("pump", 5, 9)], [("note", {"n": 1})])
    assert done.repeated == {}
    assert done.entries[0].previous == first.entries[0].hash
    assert verify(store.log(), store.head).ok


def test_long_reads_come_in_parts(opened: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("retwin.monitor.store.store.ROWS", 16)
    store = opened()
    store.add_asset(Asset("pump", 2))
    entries = [("odd" if n % 2 else "even", {"n": n}) for n in range(40)]
    store.commit([update("pump", 0, 40)], entries)
    assert [len(times) for times, _ in store.samples("pump")] == [16, 16, 8]
    assert [entry.data["n"] for entry in store.log()] == [*range(40)]
    assert [entry.data["n"] for entry in store.log("odd")] == [*range(1, 40, 2)]


def test_retention_removes_the_oldest_samples_and_never_the_log(opened: Open) -> None:
    store = opened(max_samples=100)
    store.add_asset(Asset("pump", 2))
    store.add_asset(Asset("slow", 2))
    store.commit([update("slow", 0, 3)])
    for first in range(0, 1000, 20):
        store.commit([update("pump", first, first + 20)], [("note", {"first": first})])
        assert read(store, "pump")[0].size <= 110
    times = read(store, "pump")[0]
    assert times.tolist() == [*range(1000 - len(times), 1000)]
    assert len(times) >= 100
    assert read(store, "slow")[0].size == 3, "of an asset that is slower, nothing is removed"
    assert sum(1 for _ in store.log()) == 50
    store.close()
    assert read(opened(max_samples=7), "pump")[0].tolist() == [*range(993, 1000)]


def test_the_file_shrinks_and_its_pages_are_used_again(tmp_path: Path) -> None:
    sizes = []
    for limit in (3000, 3000, 30):
        with Store(tmp_path, max_samples=limit) as store:
            store.add_asset(Asset("pump", 20))
            first = 3000 * len(sizes)
            for begin in range(first, first + (0 if limit == 30 else 3000), 500):
                store.commit([update("pump", begin, begin + 500, channels=20)])
        sizes.append((tmp_path / FILE).stat().st_size)
    assert sizes[1] < 1.25 * sizes[0]
    assert sizes[2] < 0.1 * sizes[0]


def test_one_process_writes_while_others_read(opened: Open) -> None:
    store = opened()
    store.add_asset(Asset("pump", 2))
    with pytest.raises(InputError, match="writes to now"):
        opened()
    reader = opened(read_only=True)
    store.commit([update("pump", 0, 4)], [("note", {})])
    assert read(reader, "pump")[0].size == 4
    assert reader.head == store.head
    with pytest.raises(InputError, match="read only"):
        reader.commit([update("pump", 4, 5)])
    store.close()
    opened().commit([update("pump", 4, 5)])


@pytest.mark.slow
def test_two_folders_with_one_database(new_database: Callable[[], str], tmp_path: Path) -> None:
    url = new_database()
    with Store(tmp_path / "a", url), pytest.raises(InputError, match="writes to now"):
        Store(tmp_path / "b", url)
    Store(tmp_path / "b", url).close()


@pytest.mark.slow
def test_a_broken_connection_is_one_error_and_then_made_anew(
    new_database: Callable[[], str], tmp_path: Path
) -> None:
    import psycopg

    url = new_database()
    with Store(tmp_path, url) as store:
        store.add_asset(Asset("pump", 2))
        store.commit([update("pump", 0, 3)], [("note", {})])
        with psycopg.connect(url, autocommit=True) as other:
            end = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = %s"
            name = url.rpartition("/")[2]
            other.execute(f"{end} AND pid <> pg_backend_pid()", [name])
        with pytest.raises(InputError, match="nothing of this step was acknowledged") as error:
            store.commit([update("pump", 3, 5)], [("note", {})])
        assert "\n" not in str(error.value)
        assert url.split(":")[2].split("@")[0] not in str(error.value), "the password"
        assert store.commit([update("pump", 3, 5)], [("note", {})]).repeated == {}
        with pytest.raises(InputError, match="writes to now"):
            Store(tmp_path / "b", url)
        assert read(store, "pump")[0].tolist() == [*range(5)]
        assert verify(store.log(), store.head).intact == 2


def test_a_store_of_a_newer_schema_is_refused(opened: Open) -> None:
    from retwin.monitor.store.database import meta

    store = opened()
    with store._writing() as connection:
        connection.execute(meta.update().values(value="2"))
    store.close()
    for read_only in (False, True):
        with pytest.raises(InputError, match="store of schema 1, got schema 2"):
            opened(read_only=read_only)


def test_settings_of_durability(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from retwin.monitor.store import database

    with Store(tmp_path) as store, store._writing() as connection:
        found = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar_one()
            for name in ("journal_mode", "synchronous", "foreign_keys", "auto_vacuum")
        }
    expected = {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "auto_vacuum": 2}
    assert found == expected
    # As a file system without shared memory does, which keeps another journal.
    monkeypatch.setitem(database.PRAGMAS, "foreign_keys", 7)
    with pytest.raises(InputError, match="got foreign_keys=1; put the store on a local disk"):
        Store(tmp_path)


@pytest.mark.slow
def test_a_server_that_does_not_promise_durability(
    new_database: Callable[[], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from retwin.monitor.store import database

    monkeypatch.setitem(database.SERVER, "fsync", "what this server has not")
    with pytest.raises(InputError, match="got fsync=on; change the settings of the server"):
        Store(tmp_path, new_database())


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"url": "mysql://host/name"}, "a PostgreSQL database"),
        ({"url": "no address"}, "a PostgreSQL database"),
        ({"url": "postgresql://retwin:secret@127.0.0.1:1/none"}, "stores and reads"),
        ({"max_samples": 0}, "max_samples"),
        ({"read_only": True}, "folder of a store"),
    ],
    ids=["backend", "address", "server", "samples", "missing"],
)
def test_wrong_arguments(tmp_path: Path, given: dict, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        Store(tmp_path, **given)
    assert "secret" not in str(error.value)
    Store(tmp_path).close()


def test_without_the_extra_all_else_works() -> None:
    code = (
        "import sys, retwin\n"
        "assert 'sqlalchemy' not in sys.modules\n"
        "sys.modules['sqlalchemy'] = None\n"
        "assert retwin.monitor.verify([]).ok\n"
        "assert 'torch' not in sys.modules\n"
        "try: retwin.monitor.Store\n"
        "except retwin.InputError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install" in done.stdout
    assert '[monitor]"' in done.stdout


def test_damaged_files(tmp_path: Path) -> None:
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / FILE).write_text("no database" * 1000)
    with pytest.raises(InputError, match="not a database"):
        Store(tmp_path / "text")
    with Store(tmp_path / "edited") as store:
        store.add_asset(Asset("pump", 2))
        store.commit([update("pump", 0, 3)], [("note", {"n": 0}), ("note", {"n": 1})])
    with closing(sqlite3.connect(tmp_path / "edited" / FILE)) as raw:
        raw.execute("UPDATE retwin_samples SET packed = x'00'")
        raw.execute("UPDATE retwin_states SET arrays = x'ffffffffffffffff00'")
        raw.execute("UPDATE retwin_assets SET settings = '[' || settings")
        raw.execute("UPDATE retwin_log SET text = '{\"n\":2}' WHERE sequence = 1")
        raw.commit()
    with Store(tmp_path / "edited") as store:
        for reading in (lambda: read(store, "pump"), lambda: store.state("pump"), store.assets):
            with pytest.raises(InputError):
                reading()
        found = verify(store.log(), store.head)
        assert (found.intact, found.reason) == (1, "entry 1: its contents do not give its hash")


def test_a_full_disk_is_one_error_and_loses_nothing(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    with Store(tmp_path) as store:
        store.add_asset(Asset("pump", 20))
        acknowledged, error = 0, None
        try:
            for attempt in range(2):
                resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, before[1]))
                with pytest.raises(InputError) as error:
                    while True:
                        part = update("pump", acknowledged, acknowledged + 100, channels=20)
                        store.commit([part], [("note", {"last": acknowledged + 99})])
                        acknowledged += 100
                assert "nothing of this step was acknowledged" in str(error.value)
                assert "\n" not in str(error.value)
                assert read(store, "pump")[0].tolist() == [*range(acknowledged)], attempt
                assert (store.state("pump") or (0,))[0] == acknowledged - 1
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert acknowledged > 0
        done = store.commit([update("pump", acknowledged, acknowledged + 100, channels=20)])
        assert done.repeated == {}
    with Store(tmp_path) as store:
        assert read(store, "pump")[0].tolist() == [*range(acknowledged + 100)]
        found = verify(store.log(), store.head)
        assert (found.ok, found.intact) == (True, acknowledged // 100)


@pytest.mark.parametrize("name", ["", "a" * 201, "a\nb", "a\0b", "\ud800"])
def test_names_of_assets(tmp_path: Path, name: str) -> None:
    with Store(tmp_path) as store:
        with pytest.raises(InputError, match="printable"):
            store.add_asset(Asset(name, 1))
        store.add_asset(Asset("pump", 2, {"a": 1}))
        store.add_asset(Asset("pump", 2, {"a": 2}, 3))
        with pytest.raises(InputError, match="expected 2, as the asset pump has"):
            store.add_asset(Asset("pump", 3))
        assert store.assets() == [Asset("pump", 2, {"a": 2}, 3)]
