"""Samples from files that appear, grow, and are replaced."""

from __future__ import annotations

import copy
import os
import time
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from collecting import CollectingGate, running, wait
from pyarrow import parquet

import retwin as rt
from retwin.data.logs.mapping import Mapping
from retwin.data.logs.signals import Clock
from retwin.data.row_times import row_times
from retwin.errors import InputError
from retwin.monitor.settings import FolderSource
from retwin.monitor.sources.folder import Folder
from retwin.monitor.sources.tables import CHUNK, Layout, layout_of, mapped_layout

SECOND = 10**9
CHANNELS = ("heater", "T1")
HEADER = "time,heater,T1\n"


def settings(pattern: object, **more: object) -> FolderSource:
    given = {"type": "folder", "files": str(pattern), "every": 0.02, **more}
    return FolderSource.model_validate(given)


def source(folder: Path, lines: list[str], newest: int | None = None, **more: object) -> Folder:
    own = settings(folder / "{asset}" / "*.csv", **more)
    known = {} if newest is None else {"line1": newest}
    return Folder(own, {"line1": layout_of(own, CHANNELS, None)}, known, lines.append)


def seconds(gate: CollectingGate) -> list[float]:
    return [each / SECOND for each in gate.order.get("line1", [])]


def test_a_folder_of_one_of_two_machines_is_missing_once_and_then_back(tmp_path: Path) -> None:
    lines: list[str] = []
    own = settings(tmp_path / "{asset}" / "*.csv")
    layout = layout_of(own, CHANNELS, None)
    (tmp_path / "line1").mkdir()
    gate = CollectingGate()
    with running(Folder(own, {"line1": layout, "line2": layout}, {}, lines.append), gate):
        (tmp_path / "line1" / "a.csv").write_text(HEADER + "1,1,1\n")
        wait(lambda: seconds(gate) == [1], lines)  # the other machine is read
        time.sleep(0.3)  # ten rounds and more
        assert len(lines) == 1, lines
        assert f"there is no folder {tmp_path / 'line2'}" in lines[0]
        (tmp_path / "line2").mkdir()
        wait(lambda: len(lines) == 2, lines)
        time.sleep(0.3)
    assert [line.rpartition(": ")[2] for line in lines[1:]] == ["back"]


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    (tmp_path / "line1").mkdir()
    return tmp_path / "line1"


def test_files_appear_and_grow_and_only_complete_rows_count(logs: Path) -> None:
    lines: list[str] = []
    gate = CollectingGate()
    (logs / "b.csv").write_text(HEADER + "10,1,20\n11,1,21\n12,")
    (logs / "c.csv").write_text("\ufeffT1,other,time,heater\r\n5,x,7,True\r\n,x,8,0\r\n")
    with running(source(logs.parent, lines), gate):
        wait(lambda: len(seconds(gate)) == 4, lines)
        assert seconds(gate) == [7, 8, 10, 11], "files in the order of their rows"
        with (logs / "b.csv").open("a") as file:
            file.write("0,nan\n13,1,inf\n\n14,1")
        wait(lambda: len(seconds(gate)) == 6, lines)
        (logs / "a.csv").write_text(HEADER + "20,1,1\n")
        wait(lambda: seconds(gate)[-1] == 20, lines)
    nan = float("nan")
    expected = [[1, 5], [0, nan], [1, 20], [1, 21], [0, nan], [1, nan], [1, 1]]
    np.testing.assert_array_equal(gate.values("line1"), expected)
    assert len(lines) == 1


def test_a_table_without_a_mapping_is_read_as_logs_are(logs: Path) -> None:
    """Separator, decimal comma and lines above the titles are found; units are not converted."""
    lines: list[str] = []
    gate = CollectingGate()
    (logs / "a.csv").write_text("Export 7\n\nT1 [°C];time;heater\n")
    with running(source(logs.parent, lines), gate):
        time.sleep(0.1)
        with (logs / "a.csv").open("a") as file:
            file.write("20,5;1,5;1\n;;\n21;2,5;x\n22;3,5;on\n")
        wait(lambda: len(seconds(gate)) == 2, lines)
    assert seconds(gate) == [1.5, 3.5]
    np.testing.assert_array_equal(gate.values("line1"), [[1, 20.5], [1, 22]])
    assert "'x' in a.csv, column 'heater'" in lines[-1]


def test_rows_that_cannot_be_read_are_counted_and_stop_nothing(logs: Path) -> None:
    lines: list[str] = []
    gate = CollectingGate()
    hostile = ["x,1,2", "1,2", "1,1,\x1b[2J", "1,1,2,3", "nan,1,2", "1e30,1,2", "\x00,1,2"]
    hostile.append('1,"1,2')
    (logs / "a.csv").write_text(HEADER + "\n".join(hostile) + "\n9,1,2\n")
    (logs / "none.csv").write_text("time,heater\n1,1\n")
    (logs / "empty.csv").write_text("")
    (logs / "long.csv").write_text("x" * (2 * CHUNK))
    own = source(logs.parent, lines)
    with running(own, gate):
        wait(lambda: seconds(gate) == [9] and len(lines) == 4, lines)
    assert own.refused == len(hostile) + 2
    assert any("no column T1" in line for line in lines)


@pytest.mark.parametrize("how", ["replaced", "truncated", "rewritten"])
def test_a_file_that_is_another_one_is_read_from_its_begin(how: str, logs: Path) -> None:
    lines: list[str] = []
    gate = CollectingGate()
    file = logs / "a.csv"
    file.write_text(HEADER + "1,1,1\n2,1,2\n")
    with running(source(logs.parent, lines), gate):
        wait(lambda: seconds(gate) == [1, 2], lines)
        if how == "replaced":
            (logs / "new").write_text(HEADER + "1,1,1\n2,1,2\n3,1,3\n4,1,4\n")
            os.replace(logs / "new", file)
        elif how == "truncated":
            file.write_text(HEADER + "3,1,3\n")
        else:  # in place, to the same size and more
            file.write_text("time,T1,heater\n4,4,1\n5,5,1\n6,6,1\n")
        newest = {"replaced": 4, "truncated": 3, "rewritten": 6}[how]
        wait(lambda: seconds(gate)[-1] == newest, lines)
    assert gate.values("line1")[-1].tolist() == [1, newest]
    if how == "replaced":
        assert seconds(gate) == [1, 2, 3, 4], "what is the same is not read again"


def test_after_a_restart_old_rows_are_left_out(logs: Path) -> None:
    lines: list[str] = []
    gate = CollectingGate()
    rows = "".join(f"{number},1,{number}\n" for number in range(1, 201))
    (logs / "a.csv").write_text(HEADER + rows)
    with running(source(logs.parent, lines, newest=150 * SECOND), gate):
        wait(lambda: bool(seconds(gate)) and seconds(gate)[-1] == 200, lines)
    assert seconds(gate) == list(range(91, 201))


def test_what_the_store_refuses_is_sent_again(logs: Path, monkeypatch) -> None:
    monkeypatch.setattr("retwin.monitor.sources.source.AGAIN", 0.05)
    lines: list[str] = []
    gate = CollectingGate(failing=3)
    (logs / "a.csv").write_text(HEADER + "1,1,1\n2,1,2\n")
    with running(source(logs.parent, lines), gate):
        wait(lambda: seconds(gate) == [1, 2], lines)
        wait(lambda: len(lines) == 3, lines)
    assert "not stored" in lines[1]
    assert "stored again" in lines[2]


def test_a_folder_that_is_away_is_lost_and_back(logs: Path) -> None:
    lines: list[str] = []
    gate = CollectingGate()
    logs.rename(logs.parent / "away")
    with running(source(logs.parent, lines), gate):
        wait(lambda: "lost" in "".join(lines))
        (logs.parent / "away").rename(logs)
        (logs / "a.csv").write_text(HEADER + "1,1,1\n")
        wait(lambda: seconds(gate) == [1], lines)
    assert "back" in lines[1]


def test_large_files_come_in_parts_with_their_times_exact(logs: Path) -> None:
    lines: list[str] = []
    gate = CollectingGate()
    begin, count = 1_700_000_000_123_456_789, 20_000
    rows = "".join(f"{begin + i},1,{i}\n" for i in range(count))
    (logs / "a.csv").write_text(HEADER + rows)
    with running(source(logs.parent, lines, unit="ns"), gate):
        wait(lambda: len(seconds(gate)) == count, lines)
    assert gate.order["line1"] == [begin + i for i in range(count)]


def test_parquet_files_are_read_and_continued(tmp_path: Path) -> None:
    lines: list[str] = []
    gate = CollectingGate()
    stamp = pyarrow.timestamp("us", tz="UTC")

    def write(count: int) -> None:
        times = pyarrow.array(range(0, count * 10**6, 10**6), stamp)
        table = {"when": times, "a": [1.0] * count, "b": [None, *range(1, count)]}
        parquet.write_table(pyarrow.table(table), tmp_path / "part")
        os.replace(tmp_path / "part", tmp_path / "x.parquet")

    columns = {"heater": "a", "T1": ["a", "b"]}
    own = settings(tmp_path / "*.parquet", asset="line1", time="when", columns=columns)
    write(3)
    (tmp_path / "broken.parquet").write_bytes(b"PAR1")
    layout = layout_of(own, CHANNELS, None)
    with running(Folder(own, {"line1": layout}, {}, lines.append), gate):
        wait(lambda: seconds(gate) == [0, 1, 2], lines)
        write(5)
        wait(lambda: len(seconds(gate)) == 5, lines)
    assert seconds(gate) == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(gate.values("line1")[:3], [[1, float("nan")], [1, 1], [1, 1.5]])
    assert any("broken.parquet" in line for line in lines)


def test_columns_are_those_of_the_case_unless_they_are_given() -> None:
    case = rt.cases.get("incubator")
    names = (*case.inputs.names, *case.outputs.names)
    with pytest.raises(InputError, match="give `unit`"):
        layout_of(settings("a.csv", asset="line1"), names, case)
    found = layout_of(settings("a.csv", asset="line1", unit="ns"), names, case)
    assert found == Layout("time", "ns", (("heater_on",), ("t1",), ("t2", "t3")))
    with pytest.raises(InputError, match="a column for each of heater, room, air"):
        layout_of(settings("a.csv", asset="line1", columns={"heater": "x"}), names, case)


@pytest.mark.parametrize(
    ("unit", "cell", "expected"),
    [
        ("s", "1700000000.123456789", 1_700_000_000_123_456_789),
        ("ms", " 5 ", 5_000_000),
        ("ns", "-7", -7),
        ("iso", "1970-01-01T00:00:01", SECOND),
        ("iso", "1970-01-01T01:00:01.000001+01:00", SECOND + 1000),
    ],
)
def test_times_are_read_exactly(unit: str, cell: str, expected: int) -> None:
    assert row_times(np.array([cell]), "", Clock(unit=unit), "a").tolist() == [expected]


TWIN = {
    "inputs": rt.Channels(("heater",), ("1",)),
    "outputs": rt.Channels(("T1", "flow"), ("K", "m^3/s")),
    "rate": 1.0,
    "case": None,
}
MAPPING = {
    "rate": 1.0,
    "time": {"column": "Zeit"},
    "cut": {"by": "gap", "gap": 60.0},
    "commands": {
        "heater": {"signal": "on", "resample": "hold", "max_gap": 2.5, "clock_offset": -0.5}
    },
    "outputs": {
        "T1": {"signal": ["upper", "lower"], "clock_offset": -0.5},
        "flow": {"signal": "Q", "from_unit": "l/min", "clock_offset": -0.5, "max_gap": 3.0},
    },
}
"""As `retwin data map` writes it, completed for a table of other units and another clock."""
TABLE = """Export of plant 7
on;Zeit;upper [°C];lower [°C];Q;note
1;2023-11-14 22:13:20,5;20;21,0;60;a
0;2023-11-14 22:13:21,5;20,5;21,5;30;b
"""
BEGIN = 1_700_000_000


def changed(place: str, value: object) -> dict:
    """The mapping with another value at a place such as time.rate."""
    *tables, name = place.split(".")
    made = copy.deepcopy(MAPPING)
    own = made
    for each in tables:
        own = own[each]
    own[name] = value
    return made


def mapped(pattern: object, lines: list[str]) -> Folder:
    own = settings(pattern, asset="line1")
    layout = mapped_layout(Mapping.model_validate(MAPPING), **TWIN)
    return Folder(own, {"line1": layout}, {}, lines.append)


def test_a_mapping_renames_converts_and_shifts_rows_as_they_appear(tmp_path: Path) -> None:
    lines: list[str] = []
    gate = CollectingGate()
    file = tmp_path / "a.csv"
    title, *rows = TABLE.splitlines(keepends=True)
    file.write_text(title + rows[0], encoding="latin-1")
    own = mapped(tmp_path / "*.csv", lines)
    with running(own, gate):
        for text in (rows[1], rows[2][:20], rows[2][20:], "x;2023-11-14 22:13:22,5;;1;0,6;c\n"):
            with file.open("a", encoding="latin-1") as out:
                out.write(text)
            time.sleep(0.05)
        more = [";2023-11-14 22:13:23,5;20;20;0;", "1;yesterday;1;1;1;d", "1;2"]
        more += [";2023-11-14 22:13:25,5;20;20;0;", "1;2023-11-14 22:13:26,5;20;20;0;"]
        with file.open("a") as out:
            out.write("\n".join(more) + "\n")
        wait(lambda: len(seconds(gate)) == 6, lines)
    assert seconds(gate) == [BEGIN + k for k in (0, 1, 2, 3, 5, 6)]
    flow, nan = 1e-3 / 60, np.nan
    expected = [
        [1, 293.65, 60 * flow],
        [0, 294.15, 30 * flow],
        [nan, nan, 0.6 * flow],
        [nan, 293.15, 0],
        [nan, nan, nan],  # the command is missing for longer than max_gap
        [1, 293.15, 0],
    ]
    np.testing.assert_allclose(gate.values("line1"), expected)
    assert own.refused == 3, "a cell, a time, and a row"
    log = tmp_path / "log.csv"
    log.write_text(TABLE, encoding="utf-8")
    whole = rt.load(log, mapping=Mapping.model_validate(MAPPING), case=Channelled())
    stream = np.concatenate([whole.commands, whole.observed], axis=2)[0]
    np.testing.assert_allclose(gate.values("line1")[:2], stream, rtol=1e-6)


class Channelled:
    """What reading a log needs of a case."""

    inputs, outputs, rate = TWIN["inputs"], TWIN["outputs"], TWIN["rate"]
    classes: tuple[str, ...] = ()


def test_a_mapping_reads_parquet_files_that_are_written_anew(tmp_path: Path) -> None:
    lines: list[str] = []
    gate = CollectingGate()

    def write(count: int) -> None:
        stamps = [(BEGIN * 1000 + 500) * 10**6 + k * 10**9 for k in range(count)]
        columns = {
            "Zeit": pyarrow.array(stamps, pyarrow.timestamp("ns")),
            "on": [1.0] * count,
            "upper [°C]": [20.0 + k for k in range(count)],
            "lower [°C]": [20.0] * count,
            "Q": [60.0] * count,
        }
        parquet.write_table(pyarrow.table(columns), tmp_path / "part")
        os.replace(tmp_path / "part", tmp_path / "x.parquet")

    write(2)
    (tmp_path / "broken.parquet").write_bytes(b"PAR1")
    with running(mapped(tmp_path / "*.parquet", lines), gate):
        wait(lambda: len(seconds(gate)) == 2, lines)
        write(3)
        wait(lambda: len(seconds(gate)) == 3, lines)
    assert seconds(gate) == [BEGIN, BEGIN + 1, BEGIN + 2]
    np.testing.assert_allclose(gate.values("line1")[:, 1], [293.15, 293.65, 294.15])
    assert any("broken.parquet" in line for line in lines)


def test_tables_that_a_mapping_does_not_fit_are_reported_by_name(tmp_path: Path) -> None:
    lines: list[str] = []
    gate = CollectingGate()
    hostile = {
        "other": TABLE.replace("lower", "lowest"),
        "units": TABLE.replace("lower [°C]", "lower [K]"),
        "quantity": TABLE.replace("°C", "m"),
        "clock": TABLE.replace("Zeit", "when"),
        "text": "nothing at all\n" * 3,
        "zero": "\0" * 500 + "\n",
    }
    for name, text in hostile.items():
        (tmp_path / f"{name}.csv").write_text(text)
    (tmp_path / "wide.csv").write_text(TABLE, encoding="utf-16")
    own = mapped(tmp_path / "*.csv", lines)
    with running(own, gate):
        wait(lambda: own.refused == len(hostile) + 1, lines)
    assert not seconds(gate)
    for name in (*hostile, "wide"):
        assert any(f"{name}.csv" in line for line in lines), name


@pytest.mark.parametrize(
    ("place", "value", "reason"),
    [
        ("rate", 2.0, "that of the twin, 1 Hz"),
        ("time.rate", 1.0, "a column of times"),
        ("cut", {"by": "length", "length": 5.0}, "all rows of a stream"),
        ("cut", {"by": "trigger", "signal": "on"}, "all rows of a stream"),
        ("cut.min_length", 5.0, "all rows of a stream"),
        ("commands.heater.resample", "linear", "held until the next row"),
        ("outputs.T1.resample", "hold", "what was not measured is missing"),
        ("outputs.T1.clock_offset", 0.0, "a row of a stream has one time"),
        ("outputs", {"T1": {"signal": "upper"}}, "T1, flow"),
    ],
)
def test_what_a_stream_cannot_do_is_refused_with_the_reason(
    place: str, value: object, reason: str
) -> None:
    with pytest.raises(InputError, match=reason):
        mapped_layout(Mapping.model_validate(changed(place, value)), **TWIN)


def test_a_unit_that_neither_the_twin_nor_the_mapping_states_is_refused(tmp_path: Path) -> None:
    outputs = rt.Channels(("T1", "flow"), ("1", "m^3/s"))
    layout = mapped_layout(Mapping.model_validate(MAPPING), **(TWIN | {"outputs": outputs}))
    (tmp_path / "a.csv").write_text(TABLE)
    with pytest.raises(InputError, match=r"write unit = … for T1"):
        list(layout.table(tmp_path / "a.csv").rows())
    with pytest.raises(ValueError, match="either a mapping, or columns, time and unit"):
        settings("a.csv", asset="line1", mapping="m.toml", time="Zeit")
