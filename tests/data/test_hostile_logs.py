"""Logs that are cut off, damaged, larger than they look, or made to do harm."""

from __future__ import annotations

import json
import sqlite3
import struct
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from log_files import SPEEDS, csv, mcap, ros2_bag, tdms

from retwin.data import load
from retwin.data import tables as text_tables
from retwin.data.logs.mapping import Mapping
from retwin.data.logs.reading import read_log
from retwin.data.logs.signals import Clock
from retwin.errors import InputError
from retwin.serialisation.sizes import Budget

LIMIT = 2**26
"""Bytes that the signals of a log may take in these tests."""
SECONDS = 60.0
"""Longest time that a refusal may take, on a busy machine."""


def refused(path: Path, match: str) -> str:
    """The message with which a log is refused, in one line that names it."""
    begun = time.monotonic()
    with pytest.raises(InputError, match=match) as caught:
        read_log(path, budget=Budget(path.name, LIMIT))
    assert time.monotonic() - begun < SECONDS
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.5, 0.95])
@pytest.mark.parametrize("name", [each for each in SPEEDS if each != "bag"])
def test_logs_that_are_cut_off(name: str, share: float, tmp_path: Path) -> None:
    path = tmp_path / name
    SPEEDS[name][0](path)
    data = path.read_bytes()
    cut = int(share * len(data))
    if name == "a.csv":  # in a row that lacks a cell; a cut at the end of one is not seen
        cut = data[:cut].rfind(b";") if cut else 0
    path.write_bytes(data[:cut])
    assert name in refused(path, "expected .* got ")


def mcap_of(path: Path, write: Callable[..., None]) -> None:
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, chunk_size=2**40)
        writer.start("", "")
        write(writer)
        writer.finish()


def json_channel(writer, topic: str = "/a") -> int:
    return writer.register_channel(topic, "json", writer.register_schema("a", "jsonschema", b"{}"))


def bomb(writer) -> None:
    """A gigabyte of the same messages in a few kilobytes: chunks are compressed as a whole."""
    channel = json_channel(writer)
    text = b'{"v": 1}' + b" " * 2**20
    for k in range(800):
        writer.add_message(channel, k, text, k)


def names(writer) -> None:
    channel = json_channel(writer)
    for k in range(300):
        text = json.dumps({f"{k}-{i}": i for i in range(60)}).encode()
        writer.add_message(channel, k, text, k)


def nested(writer) -> None:
    writer.add_message(json_channel(writer), 1, b"[" * 100_000 + b"]" * 100_000, 1)


def code(writer) -> None:
    """A definition whose names would be code in the module that the library makes."""
    schema = writer.register_schema(
        "a/msg/A:\n    import os; os.abort()\nclass B", "ros2msg", b"float64 x"
    )
    writer.add_message(writer.register_channel("/a", "cdr", schema), 1, bytes(12), 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("write", "match"),
    [
        (bomb, "expected contents of at most 67.1 MB"),
        (names, "at most 10000 signals"),
        (nested, "at which its reader failed: RecursionError"),
        (code, "names of types and fields|whole"),
    ],
)
def test_mcap_files_that_do_harm(write: Callable[..., None], match: str, tmp_path: Path) -> None:
    mcap_of(tmp_path / "a.mcap", write)
    assert (tmp_path / "a.mcap").stat().st_size < 2**24
    refused(tmp_path / "a.mcap", match)


@pytest.mark.slow
def test_a_record_that_declares_more_than_there_is(tmp_path: Path) -> None:
    mcap(tmp_path / "a.mcap")
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[9:17] = struct.pack("<Q", 2**62)
    (tmp_path / "a.mcap").write_bytes(data)
    refused(tmp_path / "a.mcap", r"a\.mcap: expected")


@pytest.mark.slow
def test_a_parquet_file_of_many_equal_rows(tmp_path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    ones = pa.table({"time": np.zeros(2**20), "y": np.zeros(2**20)})
    with parquet.ParquetWriter(tmp_path / "a.parquet", ones.schema) as writer:
        for _ in range(48):
            writer.write_table(ones)
    assert (tmp_path / "a.parquet").stat().st_size < 2**22
    refused(tmp_path / "a.parquet", r"expected contents of at most 67\.1 MB")


@pytest.mark.slow
def test_a_tdms_file_that_declares_more_samples_than_it_has(tmp_path: Path) -> None:
    """Those that are there are read, and nothing is allocated for the others."""
    tdms(tmp_path / "a.tdms")
    data = (tmp_path / "a.tdms").read_bytes()
    declared = struct.pack("<Q", 100)  # of the first segment
    assert declared in data
    (tmp_path / "a.tdms").write_bytes(data.replace(declared, struct.pack("<Q", 2**40)))
    found = read_log(tmp_path / "a.tdms", budget=Budget("a", LIMIT))
    assert {len(each.times) for each in found.signals.values()} == {300}


def database(path: Path, *statements: str) -> None:
    connection = sqlite3.connect(path)
    for each in statements:
        connection.execute(each)
    connection.commit()
    connection.close()


@pytest.mark.slow
def test_a_database_that_computes_what_it_holds(tmp_path: Path) -> None:
    """A view would be evaluated for ever."""
    database(
        tmp_path / "a.db3",
        "CREATE TABLE topics(id INTEGER, name TEXT)",
        "CREATE VIEW messages AS WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x FROM c) "
        "SELECT x FROM c",
    )
    refused(tmp_path / "a.db3", "a view that computes what it holds")
    (tmp_path / "b?mode=rw.db3").write_bytes((tmp_path / "a.db3").read_bytes())
    refused(tmp_path / "b?mode=rw.db3", "a path without")


@pytest.mark.slow
def test_a_bag_takes_files_of_its_own_folder_only(tmp_path: Path) -> None:
    ros2_bag(tmp_path / "bag")
    (tmp_path / "bag" / "bag.db3").rename(tmp_path / "elsewhere.db3")
    about = tmp_path / "bag" / "metadata.yaml"
    about.write_text(about.read_text().replace("bag.db3", "../elsewhere.db3"))
    refused(tmp_path / "bag", "expected .* whole")
    (tmp_path / "bag" / "bag.db3").symlink_to(tmp_path / "elsewhere.db3")
    refused(tmp_path / "bag", "expected a regular file, got a link")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "expected a table of numbers, got an empty file"),
        ("a,b\nc,d\n", "expected a table of numbers"),
        ("time,y\n0,1\n1,2\n2,3\n3,4\n4\n", "expected 2 cells in every row, .* got 1 in line 6"),
        ("time,y\n" + "1" * 2**21, "lines of text of less than"),
        ("time,y\n0,1\n1,2\n\0,3\n", "a zero byte"),
        ("time,y\n0,1\n1e300,2\n", "before the year 2262"),
        ("time,y\n0,1\nnan,2\n", "a time in every row"),
        ("x,y\n2,1\n1,2\n", "expected a column of times"),
    ],
)
def test_text_that_is_no_table(text: str, match: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=match) as caught:
        list(text_tables.read(tmp_path / "a.csv", None, Clock()))
    assert "a.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_times_that_are_far_apart_take_no_memory(tmp_path: Path) -> None:
    """One stamp in the year 2100 would make a grid of 10¹¹ samples."""
    csv(tmp_path / "a.csv")
    with (tmp_path / "a.csv").open("a") as file:
        file.write("4102444800,0;1,0;0\n")
    settings = {"rate": 100.0, "outputs": {"y": {"signal": "speed"}}}
    with pytest.raises(InputError, match=r"expected values about 0\.01 s apart"):
        load(tmp_path / "a.csv", mapping=Mapping.model_validate(settings))
    cut = Mapping.model_validate({**settings, "cut": {"by": "gap", "gap": 1.0}})
    assert len(load(tmp_path / "a.csv", mapping=cut)) == 1


def test_the_memory_of_all_signals_is_limited(tmp_path: Path) -> None:
    csv(tmp_path / "a.csv")
    with pytest.raises(InputError, match=r"a\.csv: expected contents of at most 5 kB, as given"):
        read_log(tmp_path / "a.csv", budget=Budget("a.csv", 5000))


def test_a_library_that_crashes_ends_with_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from retwin.data.logs import reading
    from retwin.workers import process

    monkeypatch.setattr(process, "CODE", "import os; os.abort()  # {path}")
    monkeypatch.setattr(reading, "SAFE", 0)  # small tables of text are read here
    csv(tmp_path / "a.csv")
    refused(tmp_path / "a.csv", r"its reader failed: its process died \(signal 6\)")
