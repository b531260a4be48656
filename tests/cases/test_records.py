"""Records of several files with a time column: their samples, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import retwin as rt
from retwin.cases import ColumnRecords, Record, TimeColumn, read_logs

U, Y = rt.Channels(("u",), ("V",)), rt.Channels(("y",), ("V",))
COLUMNS = {"u": "in", "y": ("a", "b")}


def ideal(commands: np.ndarray) -> np.ndarray:
    return commands


TWIN = rt.FunctionTwin(ideal, U, Y, 10.0)


def write(file: Path, time: Any, command: Any, a: Any, b: Any = None) -> None:
    rows = zip(time, command, a, a if b is None else b, strict=True)
    text = "\n".join(",".join("" if each is None else str(each) for each in row) for row in rows)
    file.write_text(f"time,in,a,b\n{text}\n")


def read(path: Path, **settings: Any) -> rt.Trajectories:
    """The one calibration record, of the file first.csv in a folder."""
    time = TimeColumn(**{"column": "time", **settings})
    write(path / "other.csv", [0, 0.1], [0, 0], [0, 0])
    calibration = Record(COLUMNS, files="first.csv", time=time)
    test = Record(COLUMNS, files="other.csv", time="time")
    return ColumnRecords(TWIN, calibration, test)(path)[0]


def test_irregular_rows_come_to_the_sample_rate(tmp_path: Path) -> None:
    """A held pulse keeps its area; measurements are on straight lines, the mean of two columns."""
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.05, 0.13, 200)).round(9)  # whole ns, as times are read
    on = rng.random(200) < 0.2
    write(tmp_path / "first.csv", time, on, 3 * time, 3 * time + 2)
    made = read(tmp_path)
    grid = np.arange(made.steps) / 10
    assert made.steps == int((time[-1] - time[0]) * 10 + 1e-9) + 1
    np.testing.assert_allclose(made.observed[0, :, 0], 3 * (time[0] + grid) + 1, atol=1e-9)
    assert made.commands.min() >= 0
    assert made.commands.max() <= 1
    until = time[0] + grid[-1]
    area = np.sum(on * np.diff(np.minimum(np.append(time, until), until), append=until)[:200])
    assert made.commands[0, :-1].sum() / 10 == pytest.approx(area, abs=1e-9)
    straight = read(tmp_path, commands="linear")
    np.testing.assert_allclose(
        straight.commands[0, :, 0], np.interp(time[0] + grid, time, on), atol=1e-9
    )


def test_outputs_are_left_open_between_rows_that_are_fewer_than_the_samples(tmp_path: Path) -> None:
    """Interpolated samples hold no information, and show no noise."""
    time = 0.5 * np.arange(20)
    write(tmp_path / "first.csv", time, time > 4, 3 * time, 3 * time)
    made = read(tmp_path)
    assert np.flatnonzero(made.mask[0].all(axis=1)).tolist() == list(range(0, made.steps, 5))
    np.testing.assert_allclose(made.observed[0, ::5, 0], 3 * time, atol=1e-9)
    assert np.isfinite(made.commands).all()


@pytest.mark.parametrize(
    ("unit", "times"),
    [
        ("s", [1.6e9 + 0.1 * k for k in range(30)]),
        ("ms", [100 * k for k in range(30)]),
        ("us", [100_000 * k for k in range(30)]),
        ("ns", [1_600_000_000_000_000_000 + 100_000_000 * k for k in range(30)]),
        ("iso", [f"2026-01-01T00:00:0{k / 10}+01:00" for k in range(30)]),
        ("iso", [f"2026-01-01 00:00:0{k / 10}" for k in range(30)]),
    ],
)
def test_regular_rows_are_samples_in_every_unit(tmp_path: Path, unit: Any, times: Any) -> None:
    values = np.random.default_rng(0).normal(size=30)
    write(tmp_path / "first.csv", times, values, values)
    made = read(tmp_path, unit=unit)
    np.testing.assert_allclose(made.commands[0, :, 0], values, atol=1e-4)
    np.testing.assert_allclose(made.observed[0, :, 0], values, atol=1e-4)
    assert made.mask.all()


def test_what_was_not_measured_is_missing(tmp_path: Path) -> None:
    """One lost sample is bridged, two are not; what is bridged can be declared."""
    lost = [None if k in (3, 8, 9, 29) else k for k in range(30)]
    write(tmp_path / "first.csv", [k / 10 for k in range(30)], range(30), lost)
    made = read(tmp_path)
    assert np.flatnonzero(~made.mask[0, :, 0]).tolist() == [8, 9, 29]
    assert made.observed[0, 3, 0] == pytest.approx(3)
    assert read(tmp_path, max_gap=0.31).mask[0, :29].all()
    assert np.flatnonzero(~read(tmp_path, max_gap=0.1).mask[0, :, 0]).tolist() == [3, 8, 9, 29]


@pytest.mark.parametrize(
    ("times", "settings", "message"),
    [
        ([0, 0.1, 0.05, 0.2], {}, "an earlier time in data row 2, -0.05 s"),
        ([0, 0.1, 0.1, 0.2], {}, "the same time in data row 2"),
        ([0, 100, 200, 300], {}, "a median of 100 s with unit 's'; give the unit of column 'time'"),
        ([0, 0.1, 0.2, 0.3], {"unit": "ms"}, "a median of 0.0001 s with unit 'ms'"),
        ([0, 0.1, "x", 0.3], {}, r"row 2: expected times: numbers, ISO 8601.* got 'x'"),
        ([0, 0.1, 0.2, 0.3], {"unit": "iso"}, r"row 0: expected times: numbers, ISO 8601.* got '0"),
        ([0, 0.1, "nan", 0.3], {}, "got nan s in row 2"),
        ([0, 0.1, 1.2, 1.3], {}, r"none at 0.2 s.*the rows before and after them as two"),
        ([0, 0.1, 0.2, 1e9], {}, r"an interval of 1e\+09 s before data row 3"),
        (
            [0, 0.1, 0.2, 0.3],
            {"column": "when"},
            "a header with the columns in, a, b, when, got no column when",
        ),
    ],
)
def test_times_that_cannot_be_meant_are_refused(
    tmp_path: Path, times: Any, settings: Any, message: str
) -> None:
    write(tmp_path / "first.csv", times, [1, 2, 3, 4], [1, 2, 3, 4])
    with pytest.raises(rt.InputError, match=rf"first\.csv.*{message}"):
        read(tmp_path, **settings)


def test_a_table_is_read_as_logs_are(tmp_path: Path) -> None:
    """Separator, decimal commas and lines before the titles are found; an empty row is a sample."""
    (tmp_path / "first.csv").write_text(
        "recorded on a bench\n\ntime;in;a;b;\n0;0,5;1;1;\n0,1;0,5;;;\n0,2;1;3,5;3;\n"
    )
    made = read(tmp_path, max_gap=0.1)
    np.testing.assert_allclose(made.commands[0, :, 0], [0.5, 0.5, 1])
    assert made.mask[0, :, 0].tolist() == [True, False, True]
    np.testing.assert_allclose(made.observed[0, [0, 2], 0], [1, 3.25])
    titles = "time [ms]\tin [V]\ta\tb (V)\nms\tV\tV\tV\n"
    (tmp_path / "first.csv").write_text(titles + "0\t1\t2\t4\n0.1\ton\tNA\t4\n")
    made = read(tmp_path)
    assert made.commands.ravel().tolist() == [1, 1]
    assert made.observed[0, 0, 0] == 3
    assert made.mask[0, :, 0].tolist() == [True, False], "a row of units is no sample"
    rows = "in,a,b\n1,2,2\n,,\n3,4,4\n"
    (tmp_path / "rows.csv").write_text(rows)
    two = [Record(COLUMNS, rows=each) for each in ((2, 4), (0, 2))]
    with pytest.raises(rt.InputError, match=r"rows\.csv: expected a number for every command"):
        ColumnRecords(TWIN, *two)(tmp_path / "rows.csv")
    (tmp_path / "rows.csv").write_text(rows + '5,6,"7\n')
    with pytest.raises(rt.InputError, match="check quotation marks"):
        ColumnRecords(TWIN, *two)(tmp_path / "rows.csv")


def test_records_of_a_folder(tmp_path: Path) -> None:
    """A pattern is a record for each file; no measurement may be in both sets."""
    for k in range(4):
        write(tmp_path / f"day-{k}.csv", [0, 0.1, 0.2, 0.3], [k] * 4, [k] * 4)

    def split(calibration: Any, test: Any, path: Path = tmp_path, **part: Any) -> Any:
        records = [Record(COLUMNS, files=each, time="time", **part) for each in (calibration, test)]
        return ColumnRecords(TWIN, *records)(path)

    calibration, test = split("day-[01].csv", ("day-3.csv", "day-2.csv"))
    assert calibration.ids.tolist() == ["calibration-1", "calibration-2"]
    assert calibration.commands[:, 0, 0].tolist() == [0, 1]
    assert test.commands[:, 0, 0].tolist() == [3, 2]
    assert [each.name for each in test.provenance] == ["day-3.csv", "day-2.csv"]
    with pytest.raises(rt.InputError, match="columns: expected the column of each channel"):
        Record({"u": "in", "y": ()})
    for refused, message in [
        (lambda: split("day-*.csv", "day-3.csv"), "measurements that are in no calibration record"),
        (lambda: split("day-0.csv", "*.txt"), r"expected files \*\.txt, got none"),
        (lambda: split("day-0.csv", "day-9.csv"), r"expected files day-9\.csv, got none"),
        (lambda: split("/nowhere/*.csv", "day-1.csv"), r"expected files /nowhere/\*\.csv"),
        (lambda: split("**.txt", "day-1.csv"), r"expected files \*\*\.txt, got none"),
        (lambda: split((), "day-1.csv"), "one file, got a folder"),
        (lambda: split("a", "b", tmp_path / "day-0.csv"), "a folder with the files"),
        (lambda: split("day-0.csv", "day-1.csv", transient=9), "after its transient, got none"),
        (lambda: split("day-0.csv", "day-1.csv", rows=(4, 9)), "two rows at least.* 0 rows"),
    ]:
        with pytest.raises(rt.InputError, match=message):
            refused()


def test_one_file_of_a_folder_is_read_by_its_columns(tmp_path: Path) -> None:
    """All its rows, as a user's own file of the same columns is."""
    for name, own in (("day-0", 0), ("last", 5), ("mine", 9)):
        write(tmp_path / f"{name}.csv", [0, 0.1, 0.2, 0.3], [own] * 4, [own] * 4, [own + 2] * 4)
    first = Record(COLUMNS, files="day-*.csv", time="time", rows=(0, 3), transient=0.1)
    records = ColumnRecords(TWIN, first, Record(COLUMNS | {"y": "b"}, files="last.csv"))
    for name, command, output in (("day-0", 0, 1), ("last", 5, 7), ("mine", 9, 10)):
        alone = records.of_file(tmp_path / f"{name}.csv")
        assert alone.ids.tolist() == [name]
        assert alone.commands[0, :, 0].tolist() == [command] * 4
        assert alone.observed[0, alone.mask[0, :, 0], 0].tolist() == [output] * 4
    case = rt.cases.get("incubator")
    rows = [f"{each / case.twin.rate},1,20,{30 + each},{32 + each}" for each in range(60)]
    (tmp_path / "own.csv").write_text("\n".join(["time,heater_on,t1,t2,t3", *rows]))
    read = read_logs([tmp_path / "own.csv"], case.twin, case=case)
    assert read.trajectories.ids.tolist() == ["own"]
    np.testing.assert_allclose(read.trajectories.observed[0, :3, 0], [31, 32, 33], atol=1e-6)
    assert read.test is None


def test_a_case_file_has_the_same_keys(tmp_path: Path) -> None:
    (tmp_path / "records_module.py").write_text("def ideal(commands):\n    return commands\n")
    (tmp_path / "case.toml").write_text("""
name = "days"
twin = "records_module:ideal"
rate = 10
correction = "additive"
inputs.u = { unit = "V", low = -9, high = 9 }
outputs.y = { unit = "V" }
commands = { file = "." }
[records.calibration]
columns = { u = "in", y = ["a", "b"] }
files = ["day-*.csv"]
time = { column = "time", unit = "ms", commands = "linear", max_gap = 1 }
[records.test]
columns = { u = "in", y = "a" }
files = "last.csv"
time = "time"
""")
    rng = np.random.default_rng(0)
    for name, unit in (("day-0", 100), ("day-1", 100), ("last", 0.1)):
        write(tmp_path / f"{name}.csv", unit * np.arange(60), *rng.normal(size=(2, 60)))
    case = rt.cases.get(str(tmp_path / "case.toml"))
    assert case.records is not None
    calibration, test = case.records(tmp_path)
    assert (len(calibration), len(test), test.steps) == (2, 1, 60)
    assert case.sampler.sample(1, rng=rng).shape[2] == 1
