"""Logs of every format become trajectories by a mapping, and say what is missing in them."""

from __future__ import annotations

import json
import re
import textwrap
import tomllib
from datetime import UTC, datetime, timedelta
from itertools import pairwise, product
from pathlib import Path

import jsonschema
import numpy as np
import pyarrow
import pytest
from log_files import BEGIN, COUNT, HEATER, RATE, SPEED, SPEEDS, TIMES, mcap, ros2_bag
from pyarrow import parquet

import retwin as rt
from retwin.cases.twin_data import TwinData, log_case
from retwin.data import Provenance, load, propose_mapping, read_mapping, save
from retwin.data import tables as text_tables
from retwin.data.logs.channels import in_order
from retwin.data.logs.cutting import pieces
from retwin.data.logs.formats import arrow_tables
from retwin.data.logs.mapped import mapped
from retwin.data.logs.mapping import Cut, Mapping
from retwin.data.logs.messages import Series, Types
from retwin.data.logs.reading import read_log
from retwin.data.logs.signals import Clock, Log, Signal, Skipped, named_unit
from retwin.data.logs.units import compatible, converted, unit_in_name
from retwin.data.resampling import resample
from retwin.data.row_times import row_times
from retwin.errors import InputError
from retwin.report.figures.figure import Line, envelope
from retwin.serialisation.sizes import Budget


def written(folder: Path, name: str) -> Path:
    SPEEDS[name][0](folder / name)
    return folder / name


def mapping(speed: str, heater: str, **more) -> Mapping:
    return Mapping.model_validate(
        {
            "rate": float(RATE),
            "commands": {"heater": {"signal": heater}},
            "outputs": {"speed": {"signal": speed, "unit": "m/s"}},
            **more,
        }
    )


@pytest.mark.parametrize(
    "name",
    [each if each == "a.csv" else pytest.param(each, marks=pytest.mark.slow) for each in SPEEDS],
)
def test_a_log_of_the_reference_library_becomes_a_trajectory(name: str, tmp_path: Path) -> None:
    path = written(tmp_path, name)
    made = load(path, mapping=mapping(*SPEEDS[name][1:]))
    assert (len(made), made.rate) == (1, RATE)
    measured = made.mask[0, :, 0]
    assert measured.sum() >= COUNT - 2
    # Where topics have other times, the command comes first and the output is interpolated.
    lag = 0.004 if name == "a.mcap" else 0.0
    expected = 2 * np.maximum(np.arange(made.steps) / RATE - lag, 0)
    np.testing.assert_allclose(made.observed[0, measured, 0], expected[measured], atol=1e-5)
    np.testing.assert_allclose(made.commands[0, :COUNT, 0], HEATER[: made.steps])
    assert made.outputs.units == ("m/s",)
    (source,) = made.provenance
    assert [each.channel for each in source.sampling] == ["heater", "speed"]
    assert source.sampling[1].rate == pytest.approx(RATE)
    assert source.sampling[1].missing == pytest.approx(1 - measured.mean())


def log(**signals: tuple[np.ndarray, np.ndarray]) -> Log:
    """A log of signals with times in s."""
    found = {name: Signal(name, *map(np.asarray, each)) for name, each in signals.items()}
    return Log("run.csv", "", 0, found)


def made_of(found: Log, **settings):
    return mapped(found, mapping("y", "u", **settings), budget=Budget("run.csv"))


@pytest.mark.slow
def test_joints_are_found_by_their_names_in_any_order(tmp_path: Path) -> None:
    mcap(tmp_path / "a.mcap")
    found = read_log(tmp_path / "a.mcap", budget=Budget("a"))
    np.testing.assert_allclose(found.signals["/joint_states.position[elbow]"].values, -SPEED)
    np.testing.assert_allclose(found.signals["/plant.tanks[b].level"].values, SPEED)
    np.testing.assert_allclose(found.signals["/plant.flows[2]"].values, SPEED, rtol=1e-6)
    assert "protobuf" in found.skipped["/camera"]
    assert found.begin == BEGIN
    assert not any("header.stamp" in name for name in found.signals)


@pytest.mark.parametrize("name", ["a/msg/Unknown", "a/msg/Holder"])
def test_messages_of_unknown_types_are_skipped_with_the_reason(name: str) -> None:
    """Of the type itself, or of one inside it; the second message is not tried."""
    types, series = Types(), Series(None, Clock())
    types.define("a/msg/Holder", "Unknown inner\nfloat64 level")
    tries = []

    def decode() -> object:
        tries.append(name)
        return types.decode(bytes(40), name)

    for recorded in range(2):
        series.add("/a", name, recorded, decode)
    (skipped,) = series.found()
    assert skipped == Skipped("/a", f"messages of the type {name}, which the log does not define")
    assert len(tries) == 1


@pytest.mark.slow
def test_header_stamps_are_the_times_of_the_measurement(tmp_path: Path) -> None:
    mcap(tmp_path / "a.mcap")
    names = ["/plant.speed", "/heating.heater.power"]
    found = read_log(
        tmp_path / "a.mcap", wanted=names, clock=Clock(stamps="header"), budget=Budget("a")
    )
    for name in names:  # JSON without header was recorded at once
        np.testing.assert_allclose(found.signals[name].times, TIMES, atol=1e-9)
    assert "time of recording" in found.skipped["/heating"]
    proposal = propose_mapping(tmp_path / "a.mcap")
    assert proposal.mapping is not None
    assert proposal.mapping.time.stamps == "header"
    assert "0.004 s after their header stamps" in proposal.text


@pytest.mark.slow
def test_the_three_ways_to_write_a_ros_2_bag_hold_the_same(tmp_path: Path) -> None:
    ros2_bag(tmp_path / "sql")
    ros2_bag(tmp_path / "own", mcap=True)
    paths = [tmp_path / "sql", tmp_path / "own", tmp_path / "sql" / "sql.db3"]
    first, *others = (read_log(path, budget=Budget("a")) for path in paths)
    for other in others:
        assert other.signals.keys() == first.signals.keys()
        for name, signal in first.signals.items():
            np.testing.assert_array_equal(other.signals[name].values, signal.values)
            np.testing.assert_array_equal(other.signals[name].times, signal.times)


@pytest.mark.parametrize(
    ("text", "times", "unit", "last"),
    [
        ("t;v (m/s)\n0,0;1,5\n0,1;2,5\n", [0.0, 0.1], "m/s", 2.5),
        ("time\tv\n[ms]\t[V]\n0\t1\n100\t2.5\n", [0.0, 0.1], "V", 2.5),
        (
            "# bench\nTimestamp,v\n2024-01-01T00:00:00,1\n2024-01-01T00:00:00.25,x\n",
            [0, 0.25],
            "",
            None,
        ),
        ("time  v\n0  1e3\n1  -2.\n", [0, 1], "", -2.0),
        ("v,timestamp_ms\n1,0\n2.5,100\n", [0.0, 0.1], "", 2.5),
        ("\ufefftime,v,\n0,true,\n2,,\n", [0, 2], "", None),
        ("1700000000000,1\n1700000000500,2\n", [0, 0.5], "", 2.0),
    ],
    ids=[
        "decimal comma",
        "row of units",
        "iso",
        "blanks",
        "unit in name",
        "comma at the end",
        "no header",
    ],
)
def test_text_tables_of_any_kind(
    text: str, times: list[float], unit: str, last: float | None, tmp_path: Path
) -> None:
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    found = text_tables.read(tmp_path / "a.csv", None, Clock())
    (signal,) = (each for each in found if isinstance(each, Signal))
    np.testing.assert_allclose((signal.times - signal.times[0]) * 1e-9, times, atol=1e-9)
    assert signal.unit == unit
    assert signal.values[-1] == last or (last is None and np.isnan(signal.values[-1]))


@pytest.mark.parametrize("clock", [Clock(rate=10.0), Clock(otherwise=10.0)])
def test_a_row_of_empty_cells_is_a_sample_where_rows_come_at_a_rate(
    clock: Clock, tmp_path: Path
) -> None:
    (tmp_path / "a.csv").write_text("u,y\n1,5\n,\n3,7\n")
    signals = [
        each
        for each in text_tables.read(tmp_path / "a.csv", None, clock)
        if isinstance(each, Signal)
    ]
    for each, values in zip(signals, ([1, np.nan, 3], [5, np.nan, 7]), strict=True):
        np.testing.assert_array_equal(each.values, values)
        assert len(each.times) == 3


def test_columns_that_differ_by_their_unit_are_named_as_a_whole(tmp_path: Path) -> None:
    table = {"time": [0.0, 1.0], "T [K]": [280.0, 281.0], "T [°C]": [6.85, 7.85], "v [V]": [1, 2]}
    parquet.write_table(pyarrow.table(table), tmp_path / "a.parquet")
    text = "time,T [K],T [°C],v [V]\n0,280,6.85,1\n1,281,7.85,2\n"
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    readers = [(arrow_tables.read, "a.parquet"), (text_tables.read, "a.csv")]
    for (read, name), wanted in product(readers, (None, frozenset(["T [K]", "T [°C]"]))):
        found = read(tmp_path / name, wanted, Clock())
        values = {each.name: each.values[0] for each in found if isinstance(each, Signal)}
        assert values.items() >= {"T [K]": 280.0, "T [°C]": 6.85}.items()


def test_numbers_are_no_times_in_a_stated_format() -> None:
    cells = np.array(["1700000000.123456789", "1700000000,2"])
    assert row_times(cells, "", Clock(unit="s"), "a").tolist() == [
        1_700_000_000_123_456_789,
        1_700_000_000_200_000_000,
    ]
    for clock in (Clock(unit="iso"), Clock(format="%Y%m%d")):
        with pytest.raises(InputError, match=r"expected times.* got '20260101\.0'"):
            row_times(np.array([20260101.0]), "", clock, "a")


def test_a_gap_is_missing_and_never_bridged() -> None:
    at = np.arange(0, 10, 0.01)
    kept = (at < 4) | (at > 4.5)
    made = made_of(log(u=(at, np.ones(1000)), y=(at[kept], at[kept])))
    hole = (np.arange(made.steps) / RATE > 3.995) & (np.arange(made.steps) / RATE < 4.505)
    assert not made.mask[0, hole, 0].any()
    assert made.mask[0, ~hole, 0].all()
    own = made.provenance[0].sampling[1]
    assert own.missing == pytest.approx(hole.mean(), abs=2e-3)
    assert own.longest == pytest.approx(0.52, abs=0.02)
    assert own.bridged == pytest.approx(0.025)
    bridged = made_of(
        log(u=(at, np.ones(1000)), y=(at[kept], at[kept])),
        outputs={"speed": {"signal": "y", "max_gap": 0.6}},
    )
    assert bridged.mask.all()


def test_a_missing_command_ends_the_trajectory() -> None:
    at = np.arange(0, 10, 0.01)
    kept = (at < 4) | (at > 4.5)
    made = made_of(log(y=(at, at), u=(at[kept], np.ones(kept.sum()))))
    assert len(made) == 2
    assert made.ids.tolist() == ["run 0 s", "run 4.51 s"]
    assert "1 times a trajectory ends where a command is missing" in made.provenance[0].notes
    held = made_of(
        log(y=(at, at), u=(at[kept], np.ones(kept.sum()))),
        commands={"heater": {"signal": "u", "max_gap": 1.0}},
    )
    assert len(held) == 1


def test_held_commands_keep_the_area_of_their_pulses() -> None:
    at = np.arange(0, 10, 0.001)
    pulse = ((at >= 2.003) & (at < 2.007)).astype(float)
    made = made_of(log(u=(at, pulse), y=(at, at)))
    assert made.commands.sum() / RATE == pytest.approx(0.004, rel=1e-6)
    assert "not filtered" in made.provenance[0].sampling[1].note


def test_resampling_of_each_kind() -> None:
    at, values = np.array([0.0, 1.0, 2.0, 5.0]), np.array([0.0, 2.0, np.nan, 8.0])
    grid = np.arange(0, 7) * 1.0

    def of(how, **more):
        return resample(at, values, grid, 1.0, how, longest=2.0, **more)

    np.testing.assert_array_equal(of("linear"), [0, 2, *[np.nan] * 3, 8, np.nan])
    np.testing.assert_array_equal(of("hold", end=6.0), [0, 2, *[np.nan] * 3, 8, 8])
    np.testing.assert_array_equal(of("none"), [0, 2, *[np.nan] * 3, 8, np.nan])


@pytest.mark.parametrize(
    ("cut", "starts"),
    [
        ({"by": "none"}, [0.0]),
        ({"by": "gap", "gap": 1.0}, [0.0, 6.0]),
        ({"by": "length", "length": 3.0}, [0.0, 3.0, 6.0]),
        ({"by": "trigger", "signal": "u", "before": 0.5}, [0.5, 6.5]),
        ({"by": "trigger", "signal": "u", "edge": "falling", "length": 9.0}, [2.0, 8.0]),
    ],
)
def test_what_starts_a_trajectory(cut: dict, starts: list[float]) -> None:
    own = np.arange(400) / 100
    at = np.concatenate([own, 6 + own])
    u = Signal("u", at, np.tile((own >= 1) & (own < 2), 2).astype(float))
    found = pieces(Cut.model_validate(cut), [u], [u], u)
    np.testing.assert_allclose([each.start for each in found], starts, atol=1e-9)
    assert all(one.stop <= other.start for one, other in pairwise(found))


def test_units_offsets_and_clocks() -> None:
    at = np.arange(0, 10, 0.01)
    made = made_of(
        log(u=(at, at), y=(at + 0.5, 180 * at)),
        outputs={"speed": {"signal": "y", "from_unit": "deg", "unit": "rad", "clock_offset": -0.5}},
        commands={"heater": {"signal": "u", "scale": 2.0, "shift": 1.0, "resample": "linear"}},
    )
    np.testing.assert_allclose(made.observed[0, :, 0], np.pi * np.arange(made.steps) / RATE)
    np.testing.assert_allclose(made.commands[0, :, 0], 2 * np.arange(made.steps) / RATE + 1)
    assert "deg to rad; clock -0.5 s" in made.provenance[0].sampling[1].note
    for source, target, value in (("°C", "K", 274.15), ("rpm", "deg/s", 6.0), ("%", "1", 0.01)):
        assert converted(np.ones(1), source, target, "")[0] == pytest.approx(value)
    for source in ("9**9**9**9", "m", "rpm", "()." * 9):
        with pytest.raises(InputError, match="scale"):
            converted(np.ones(1), source, "Hz" if source == "rpm" else "W", "a log")
    with pytest.raises(InputError, match="no logarithm"):
        converted(np.ones(1), "dBm", "W", "a log")
    assert not compatible("V", "nonsense")


@pytest.mark.parametrize(
    ("source", "target", "value"),
    [
        *[("m3/h", "l/min", 1000 / 60), ("m³/h", "m3/s", 1 / 3600), ("lpm", "l/min", 1.0)],
        *[("Nm3/h", "Nl/min", 1000 / 60), ("Nm³/h", "Nm3/h", 1.0), ("kg/m3", "g/l", 1.0)],
        *[
            ("℃", "°C", 1.0),
            ("deg C", "degC", 1.0),
            ("DEGC", "K", 274.15),
            ("W/(m2 °C)", "W/(m2 K)", 1.0),
        ],
        *[("bar(g)", "kPa(g)", 100.0), ("psig", "barg", 0.0689476), ("bar(a)", "kPa", 100.0)],
        *[("kNm", "N m", 1000.0), ("m s-1", "km/h", 3.6), ("m/s2", "m/s^2", 1.0)],
        *[("RPM", "1/min", 1.0), ("pct", "%", 1.0), ("kvar", "var", 1000.0)],
    ],
)
def test_units_are_read_as_plants_spell_them(source: str, target: str, value: float) -> None:
    assert converted(np.ones(1), source, target, "")[0] == pytest.approx(value, rel=1e-5)
    assert compatible(source, target)


@pytest.mark.parametrize(
    ("source", "target"), [("Nm3/h", "m3/h"), ("Sm3", "Nm3"), ("bar(g)", "bar"), ("Nm2", "m2")]
)
def test_what_a_unit_does_not_determine_is_not_converted(source: str, target: str) -> None:
    """A normal volume is an amount of gas, and a gauge pressure is one above that of the air."""
    assert not compatible(source, target)
    remedy = r"set from_unit = … or a factor, scale = …, .* mapping file, which retwin data map"
    with pytest.raises(InputError, match=remedy):
        converted(np.ones(1), source, target, "a log")


@pytest.mark.slow
def test_nothing_is_left_in_the_folder_of_temporary_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """asammdf unpacks to a temporary file, which a damaged file makes it leave."""
    path = written(tmp_path, "a.mf4")
    path.write_bytes(path.read_bytes()[:-500])
    (tmp_path / "own").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "own"))
    with pytest.raises(InputError, match="whole"):
        read_log(path, budget=Budget("a"))
    assert not list((tmp_path / "own").iterdir())


def test_a_channel_may_be_the_mean_of_signals() -> None:
    at = np.arange(0, 10, 0.01)
    found = log(u=(at, at), y=(at, at), z=(at, 3 * at), late=(at + 0.1, at))
    made = made_of(found, outputs={"speed": {"signal": ["y", "z"]}})
    np.testing.assert_allclose(made.observed[0, :, 0], 2 * np.arange(made.steps) / RATE)
    assert made.provenance[0].sampling[1].signal == "y, z"
    with pytest.raises(InputError, match="the times and the unit of 'y'"):
        made_of(found, outputs={"speed": {"signal": ["y", "late"]}})


def test_times_out_of_order() -> None:
    """Messages may overtake each other; a clock that was set is refused."""
    at = np.arange(0, 1, 0.01)
    swapped = at.copy()
    swapped[[20, 21]] = swapped[[21, 20]]
    twice = np.append(at, at[-1])
    (note,) = in_order(Signal("y", swapped, at), "a")[1]
    assert note == "1 value put in order, up to 0.01 s earlier than one before"
    assert len(in_order(Signal("y", twice, twice), "a")[0].times) == 100
    with pytest.raises(InputError, match=r"a step back of 0\.5 s at 0\.99 s"):
        in_order(Signal("y", np.concatenate([at, at + 0.49]), np.zeros(200)), "a")


@pytest.mark.parametrize("period", [1.0, 60.0, 600.0, 1200.0])
def test_the_hour_that_winter_time_repeats_is_named(period: float) -> None:
    at = np.arange(0, 3 * 3600, period)
    with pytest.raises(InputError, match=r"one hour twice.*end of summer time; record UTC"):
        in_order(Signal("y", np.where(at < 5400, at, at - 3600), at), "a")


def test_rows_in_the_reverse_order_have_their_length(tmp_path: Path) -> None:
    rows = [f"{t:.1f},1,{np.sin(t):.4f}" for t in np.arange(30, 0, -0.1)]
    (tmp_path / "a.csv").write_text("\n".join(["time,u,y", *rows]))
    log = read_log(tmp_path / "a.csv", budget=Budget("a"))
    assert log.end == pytest.approx(29.9)
    assert made_of(log).provenance[0].notes[0].startswith("100.0% of the log's 29.9 s")


@pytest.mark.parametrize(
    ("first", "form"),
    [
        ("31.12.2026 11:59:58", "%d.%m.%Y %H:%M:%S"),
        ("12/31/2026 11:59:58 AM", "%m/%d/%Y %I:%M:%S %p"),
        ("12/31/2026, 11:59 AM", "%m/%d/%Y, %I:%M %p"),
        ("31/12/2026 11:59:58", "%d/%m/%Y %H:%M:%S"),
        ("2026/12/31 11:59:58.5", "%Y/%m/%d %H:%M:%S.%f"),
        ("31.12.2026 11:59:58,5", "%d.%m.%Y %H:%M:%S,%f"),
        ("03/04/2026 11:59:58", ""),
    ],
)
def test_dates_as_they_are_written_elsewhere(first: str, form: str) -> None:
    begin = datetime.strptime(first, form or "%d/%m/%Y %H:%M:%S").replace(tzinfo=UTC)
    moments = [begin + timedelta(minutes=i) for i in range(5)]
    cells = np.array([each.strftime(form or "%d/%m/%Y %H:%M:%S") for each in moments])
    if form:
        times = row_times(cells, "", Clock(), "a")
        assert times.tolist() == [round(each.timestamp() * 1e9) for each in moments]
    else:
        with pytest.raises(InputError, match=r"the day or the month may come first.*give format"):
            row_times(cells, "", Clock(), "a")


def test_a_picture_of_a_long_log_with_a_gap() -> None:
    """A part of the drawn line holds no value at all."""
    at = np.arange(5000.0)
    values = np.where((at > 1000) & (at < 3000), np.nan, np.sin(at))
    line = envelope(Line(at, values, "signal", "c0"))
    assert len(line.x) <= 4000
    assert np.isnan(line.y).any()
    assert np.nanmax(line.y) == np.nanmax(values)
    assert line.x[-1] > 4990


def test_a_clock_that_is_coarser_than_the_samples_is_refused() -> None:
    """Of most values nobody knows the time."""
    at = np.arange(0, 10, 0.1)
    with pytest.raises(InputError, match="got 90 of 100 at the time of the one before"):
        in_order(Signal("y", np.floor(at), at), "a")


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (["0.0", "0.1", "time", "0.3"], r"row 2: expected times.*got 'time'; repair or remove"),
        (["0.0", "0.1", "nan", "0.3"], r"got nan s in row 2; remove that row"),
    ],
)
def test_a_row_without_a_time_is_named(cells: list[str], message: str, tmp_path: Path) -> None:
    rows = [f"{cell},{place}" for place, cell in enumerate(cells)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["time,level", *rows, ""]))
    with pytest.raises(InputError, match=message):
        read_log(path, budget=Budget("a"))


def test_rows_of_several_topics_may_have_the_same_time() -> None:
    """Each holds a value of one of them: an empty cell replaces no value."""
    at = np.repeat(np.arange(0, 10, 0.1), 2)
    values = np.where(np.arange(200) % 2 == 0, at, np.nan)
    found, notes = in_order(Signal("y", at, values), "a")
    np.testing.assert_array_equal(found.values, at[::2])
    assert notes == []


@pytest.mark.slow
def test_what_does_not_suit_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "a.csv")
    for settings, message in (
        (mapping("sped", "heater"), r"expected the signal 'sped' of the mapping, got speed"),
        (mapping("speed", "heater", rate=1e6), r"expected values about 1e-06 s apart"),
        (
            mapping("speed", "heater", cut={"by": "trigger", "signal": "heater", "level": 7.0}),
            "a level that 'heater' crosses, rising, got 7, while its values are from 0 to 1",
        ),
        (mapping("speed", "heater", time={"column": "t"}), "a column of times 't'"),
        (mapping("speed", "heater", time={"column": "speed"}), "speed"),
    ):
        with pytest.raises(InputError, match=message) as caught:
            load(path, mapping=settings)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"make one: retwin data map a\.csv"):
        load(path)
    save(load(path, mapping=mapping("speed", "heater")), tmp_path / "a.npz")
    with pytest.raises(InputError, match="expected a log"):
        load(tmp_path / "a.npz", mapping=mapping("speed", "heater"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[", "expected a mapping.toml"),
        ("rate = 1.0", "outputs: expected a value, got none"),
        ("[outputs.y]\nsignal = ''", "outputs.y.signal"),
        ("[outputs.y]\nsignal = 'y'\ntopic = 1", "outputs.y.topic: expected a known key"),
        ("[outputs.y]\nsignal = 'y'\nresample = 'cubic'", "outputs.y.resample: expected 'hold'"),
        ("[outputs.y]\nsignal = 'y'\nmax_gap = -1.0", "outputs.y.max_gap"),
        ("rate = inf\n[outputs.y]\nsignal = 'y'", "rate: expected"),
        ("[cut]\nby = 'gap'\n[outputs.y]\nsignal = 'y'", "cut: expected `gap` with by"),
        ("[nominal.x]\nsignal = 'y'\n[outputs.y]\nsignal = 'y'", r"\[nominal\] for each"),
    ],
)
def test_mapping_files_that_are_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "mapping.toml").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_mapping(tmp_path / "mapping.toml")
    assert "mapping.toml" in str(caught.value)


class Reach:
    """A case of two commands and one output, whose twin adds them."""

    from retwin.data.trajectories import Channels

    inputs = Channels(("shoulder", "elbow"), ("rad", "rad"))
    outputs = Channels(("level",), ("m",))
    rate = 50.0
    classes = ("Healthy",)
    twin: Reach

    def complete(self, trajectories, *, progress=None):
        return trajectories

    def simulate(self, commands, *, seed):
        total = commands.sum(axis=2, keepdims=True)
        return self.Trajectories(commands, total, total, self.rate)

    from retwin.data.trajectories import Trajectories


def test_a_proposal_matches_the_channels_of_a_case_and_can_be_used(tmp_path: Path) -> None:
    at = np.arange(0, 20, 0.01)
    at = at[(at < 8) | (at > 12)]
    rows = [
        f"{t:.3f},{np.degrees(np.sin(t)):.5f},{np.degrees(np.cos(t)):.5f},{100 * t:.3f},{t:.3f},7"
        for t in at
    ]
    head = "time,cmd/shoulder [deg],cmd/elbow [deg],tank.level [cm],other,serial"
    (tmp_path / "run.csv").write_text("\n".join([head, *rows]))
    case = Reach()
    case.twin = case
    proposal = propose_mapping(tmp_path / "run.csv", case=case)
    assert not proposal.open_channels
    (tmp_path / "m.toml").write_text(proposal.text)
    assert read_mapping(tmp_path / "m.toml") == proposal.mapping.model_copy(
        update={"time": read_mapping(tmp_path / "m.toml").time}
    )
    made = load(tmp_path / "run.csv", case=case, mapping=tmp_path / "m.toml")
    assert (len(made), made.rate) == (2, 50.0)
    assert (made.inputs, made.outputs) == (case.inputs, case.outputs)
    np.testing.assert_allclose(made.observed[0, :100, 0], np.arange(100) / 50, atol=1e-6)
    np.testing.assert_allclose(made.nominal, made.commands.sum(axis=2, keepdims=True))
    assert "constant, 7" in proposal.text
    save(made, tmp_path / "a.npz")
    assert load(tmp_path / "a.npz").provenance == made.provenance


def test_identification_reads_a_log_by_its_mapping(tmp_path: Path) -> None:
    path = written(tmp_path, "a.csv")
    (tmp_path / "m.toml").write_text(
        '[commands.heater]\nsignal = "heater"\n[outputs.speed]\nsignal = "speed"\n'
    )
    inputs, outputs = rt.Channels(("heater",), ("1",)), rt.Channels(("speed",), ("m/s",))
    twin = rt.FunctionTwin(lambda commands: 3 * commands, inputs, outputs, 50.0)
    columns = rt.cases.Columns(mapping=tmp_path / "m.toml")
    assert rt.cases.LogReader(columns).measured_outputs([path], twin) == ("speed",)
    found = rt.cases.read_logs([path], twin, columns)
    assert found.trajectories.rate == 50.0
    np.testing.assert_allclose(found.trajectories.nominal, 3 * found.trajectories.commands)
    seen = found.trajectories.mask[0, :, 0]
    expected = 2 * np.arange(len(seen)) / 50
    np.testing.assert_allclose(found.trajectories.observed[0, seen, 0], expected[seen], atol=1e-9)
    assert "log's 2.99 s are in trajectories" in found.notes[0]
    assert not any("nominal" in note for note in found.notes)
    assert not any("states no units" in note for note in found.notes)
    bare = rt.FunctionTwin(
        lambda commands: 3 * commands, inputs, rt.Channels(("speed",), ("1",)), 50.0
    )
    notes = rt.cases.read_logs([path], bare, columns).notes
    assert any("the twin states no units of speed (m/s)" in note for note in notes)


def test_a_proposal_for_a_twin_has_the_rate_of_the_log_and_the_units_of_the_twin(
    tmp_path: Path,
) -> None:
    at = np.arange(0, 5, 0.02002)  # a clock that is slow by 0.1 %
    rows = [f"{t:.5f},{t:g},{60 * t:.5f},{-t:g}" for t in at]
    (tmp_path / "run.csv").write_text("\n".join(["time,motor/cmd,speed [rpm],other", *rows]))
    twin = TwinData(
        rt.Channels(("voltage",), ("V",)), rt.Channels(("speed", "current"), ("rad/s", "A"))
    )
    proposal = propose_mapping(tmp_path / "run.csv", case=twin)
    assert proposal.open_channels == ("current",)
    # The only command that is left, and the only signal that is named like one.
    assert proposal.channels == {"motor/cmd": "voltage", "speed": "speed"}
    head, open_table = proposal.text.split('[outputs."current"]')
    assert "rate = 50.0" in head
    assert "or delete this table" in open_table
    (tmp_path / "m.toml").write_text(head)
    made = load(tmp_path / "run.csv", mapping=tmp_path / "m.toml")  # as identify does: no case
    assert made.inputs == twin.inputs
    assert made.outputs == rt.Channels(("speed",), ("rad/s",))
    np.testing.assert_allclose(
        made.observed[0, :200, 0], 2 * np.pi * np.arange(200) / 50, atol=1e-3
    )


def test_a_function_a_case_and_an_object_give_the_channels_of_a_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = """
        import retwin as rt

        def filled(commands, gain=1.0):
            return gain * commands

        channels = rt.Channels(("valve",), ("V",)), rt.Channels(("level",), ("m",))
        tank = rt.FunctionTwin(filled, *channels, 10.0)
        state = rt.twins.State("level", "m")
        states = rt.twins.StateTwin(
            (state,), lambda x, u: x.level, *channels, 10.0, derivative=lambda x, u, p: (u.valve,)
        )
    """
    (tmp_path / "channels_of_logs.py").write_text(textwrap.dedent(code))
    monkeypatch.syspath_prepend(tmp_path)
    names = {"inputs": ["valve"], "outputs": ["level", "speed"]}
    function = log_case("channels_of_logs:filled", **names)
    assert (function.inputs.names, function.outputs.names) == (("valve",), ("level", "speed"))
    assert function.rate == 0
    with pytest.raises(InputError, match="expected the names of the channels"):
        log_case("channels_of_logs:filled")
    assert log_case("channels_of_logs:states").twin.rate == 10.0
    tank = log_case("channels_of_logs:tank")
    assert (tank.rate, tank.outputs) == (10.0, rt.Channels(("level",), ("m",)))
    assert log_case("retwin.cases.cascaded_tanks.case:tanks").classes == ("Healthy",)
    with pytest.raises(InputError, match="the case has its own"):
        log_case("tanks", **names)
    rows = [f"{t / 10},{t % 7},{t % 7}" for t in range(60)]
    (tmp_path / "run.csv").write_text("\n".join(["time,valve,level [cm]", *rows]))
    text = """
        rate = 10.0
        commands.valve = { signal = "valve" }
        outputs.level = { signal = "level" }
    """
    (tmp_path / "m.toml").write_text(textwrap.dedent(text))
    some = log_case("channels_of_logs:filled", **names, mapping=tmp_path / "m.toml")
    found = load(tmp_path / "run.csv", case=some, mapping=tmp_path / "m.toml")
    assert (found.rate, found.outputs) == (10, rt.Channels(("level",), ("cm",)))
    made = load(tmp_path / "run.csv", case=tank, mapping=tmp_path / "m.toml")
    assert made.outputs == tank.outputs
    assert made.observed.max() == pytest.approx(0.06), "cm"


def test_a_unit_in_the_name_of_a_signal_is_converted(tmp_path: Path) -> None:
    rows = [f"{t / 10},{t % 7},{10 * t}" for t in range(50)]
    (tmp_path / "run.csv").write_text("\n".join(["time,valve_pos_ref,level_mm", *rows]))
    twin = TwinData(rt.Channels(("valve",), ("1",)), rt.Channels(("level",), ("m",)))
    (tmp_path / "m.toml").write_text(propose_mapping(tmp_path / "run.csv", case=twin).text)
    made = load(tmp_path / "run.csv", mapping=tmp_path / "m.toml")
    assert made.outputs == twin.outputs
    assert made.observed.max() == pytest.approx(0.49)
    facts = propose_mapping(tmp_path / "run.csv").facts
    assert [each.unit for each in facts] == ["", "mm"], "a reference is in no unit"


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        *[("speed_m_s", "m/s"), ("a_m_s2", "m/s^2"), ("valve_pct", "%"), ("torque_Nm", "N m")],
        *[("mm", ""), ("x_cmd", ""), ("phase_A", ""), ("alarms", "")],
    ],
)
def test_units_at_the_end_of_names(name: str, unit: str) -> None:
    assert unit_in_name(name) == unit


def test_a_command_of_another_unit_is_not_taken_for_the_one_that_is_left(tmp_path: Path) -> None:
    rows = [f"{t},{t},{-t}" for t in range(50)]
    (tmp_path / "run.csv").write_text("\n".join(["time,valve_cmd [K],level", *rows]))
    twin = TwinData(rt.Channels(("voltage",), ("V",)), rt.Channels(("level",), ("m",)))
    assert propose_mapping(tmp_path / "run.csv", case=twin).open_channels == ("voltage",)


def test_a_unit_that_one_signal_alone_has_is_a_guess_at_its_channel(tmp_path: Path) -> None:
    """Names of tags are like no channel; two temperatures are not told apart by their unit."""
    rows = [f"{t},{t % 7},{t % 5},{t % 3},{t % 2},{t % 4}" for t in range(50)]
    head = "time,FIC1.PV [m3/h],EH1.OUT [%],TT1.PV [degC],TT2.PV [°C],P1.SP [bar]"
    (tmp_path / "run.csv").write_text("\n".join([head, *rows]))
    units = ("%", "l/min"), ("degC", "K", "kPa", "1")
    twin = TwinData(
        rt.Channels(("heater", "flow"), units[0]),
        rt.Channels(("low", "up", "press", "share"), units[1]),
    )
    found = propose_mapping(tmp_path / "run.csv", case=twin)
    assert found.channels == {"FIC1.PV": "flow", "EH1.OUT": "heater"}
    assert found.by_unit == ("heater", "flow")
    # A set point is no output, even where its unit fits.
    assert found.open_channels == ("low", "up", "press", "share")
    assert found.text.count("# a guess by its unit") == 2
    assert 'from_unit = "…" # if the log states none' in found.text
    assert "the log states none: taken as" not in found.text, "it states all of them"


@pytest.mark.slow
def test_a_channel_without_a_signal_stays_open(tmp_path: Path) -> None:
    at = np.arange(0, 5, 0.01)
    rows = [f"{t:.3f},{t},{-t}" for t in at]
    (tmp_path / "run.csv").write_text("\n".join(["time,shoulder,level", *rows]))
    proposal = propose_mapping(tmp_path / "run.csv", case=Reach())
    assert proposal.open_channels == ("elbow",)
    (tmp_path / "m.toml").write_text(proposal.text)
    with pytest.raises(InputError, match=r"commands\.elbow\.signal: expected the name of a"):
        read_mapping(tmp_path / "m.toml")


def test_names_and_units_of_titles() -> None:
    for title, expected in (
        ("T1 [°C]", ("T1", "°C")),
        ("v (m/s)", ("v", "m/s")),
        ("f(x)", ("f(x)", "")),
        ("q[3]", ("q[3]", "")),
        ("P1 [bar(g)]", ("P1", "bar(g)")),
        ("speed", ("speed", "")),
    ):
        assert named_unit(title) == expected


def test_provenance_of_other_files_stays_as_it_was() -> None:
    plain = Provenance("a.mat", "0" * 64)
    assert plain.plain() == {"name": "a.mat", "sha256": "0" * 64}
    assert Provenance.of(plain.plain()) == plain
    assert re.fullmatch("0+", plain.sha256)


def test_the_mapping_of_the_documentation_is_read_and_follows_the_schema(tmp_path: Path) -> None:
    docs = Path(__file__).parents[2] / "docs"
    text = (docs / "data.md").read_text("utf-8").split("```toml\n")[1].split("```")[0]
    (tmp_path / "mapping.toml").write_text(text)
    found = read_mapping(tmp_path / "mapping.toml")
    assert found.cut.signal in found.signals
    assert found.outputs["elbow"].from_unit == "deg"
    jsonschema.validate(tomllib.loads(text), json.loads((docs / "mapping.schema.json").read_text()))


@pytest.mark.parametrize(
    ("factor", "unit", "remedy"),
    [
        (1000.0, "ms", r"name the column of the times time_ms, or write unit = \"ms\" in \[time\]"),
        (1 / 86400, "days", "write the times in s, or as dates with hours, minutes and seconds"),
    ],
)
def test_times_in_another_unit_are_named(
    factor: float, unit: str, remedy: str, tmp_path: Path
) -> None:
    """As the median interval shows, which is a sample period in that unit."""
    path = tmp_path / "a.csv"
    rows = [f"{45000 + factor * place / 100:.12f},0,{place % 7}" for place in range(500)]
    path.write_text("\n".join(["time,heater,speed", *rows, ""]))
    with pytest.raises(InputError, match=f"as if times in {unit} were read as s; {remedy}"):
        load(path, mapping=mapping("speed", "heater", rate=100.0))
