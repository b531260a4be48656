"""Logs without a mapping: signals that have the names of a twin's channels, read as they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from log_files import BEGIN
from numpy.typing import NDArray

import retwin as rt
from retwin.cases import Columns, LogReader, read_logs
from retwin.data.logs.mapping import TimeSettings
from retwin.errors import InputError

INPUTS, OUTPUTS = rt.Channels(("valve",), ("V",)), rt.Channels(("speed", "level"), ("rad/s", "m"))


def doubled(commands: NDArray) -> NDArray:
    return np.concatenate([commands, 2 * commands], axis=2)


TWIN = rt.FunctionTwin(doubled, INPUTS, OUTPUTS, 10.0)


def table(path: Path, head: str, rows: list[str]) -> Path:
    path.write_text("\n".join([head, *rows, ""]), encoding="utf-8")
    return path


def test_semicolons_decimal_commas_and_a_row_of_units(tmp_path: Path) -> None:
    rows = [f"{k / 10:.1f};{k % 3},5;{60 * k};{k},25".replace(".", ",") for k in range(30)]
    path = table(tmp_path / "a.csv", "Zeit;valve;speed;level\ns;V;rpm;cm", rows)
    found = read_logs([path], TWIN)
    made = found.trajectories
    assert (made.inputs, made.outputs, made.ids.tolist()) == (INPUTS, OUTPUTS, ["a"])
    np.testing.assert_allclose(made.commands[0, :, 0], np.arange(30) % 3 + 0.5)
    np.testing.assert_allclose(made.observed[0, :, 0], 2 * np.pi * np.arange(30))
    np.testing.assert_allclose(made.observed[0, :, 1], (np.arange(30) + 0.25) / 100)
    np.testing.assert_allclose(made.nominal, doubled(made.commands))
    assert any("rpm to rad/s" in note for note in found.notes)


def test_iso_times_with_a_zone_and_pauses_between_three_runs(tmp_path: Path) -> None:
    begins = (0.0, 20.0, 50.0)
    at = np.concatenate([begin + np.arange(20) / 10 for begin in begins])
    stamps = np.datetime64("2026-03-29T00:59:50") + (at * 1000).astype("timedelta64[ms]")
    rows = [f"{stamp}+01:00,{k % 4},{k}" for k, stamp in enumerate(stamps)]
    found = read_logs([table(tmp_path / "a.csv", "timestamp,valve,speed", rows)], TWIN)
    assert (len(found.trajectories), found.trajectories.steps) == (3, 20)
    assert found.trajectories.observed[:, 0, 0].tolist() == [0, 20, 40]
    assert any("No log holds level" in note for note in found.notes)


def test_times_that_step_back_or_repeat_are_named(tmp_path: Path) -> None:
    at = np.round(np.arange(400) / 10 - 0.3 * (np.arange(400) >= 200), 1)  # a clock set back
    rows = [f"{t:.1f},{k // 50},{k}" for k, t in enumerate(at)]
    found = read_logs([table(tmp_path / "a.csv", "time,valve,speed", rows)], TWIN)
    (note,) = [each for each in found.notes if "put in order" in each]
    assert note.startswith("a.csv: valve, speed: 2 values put in order, up to 0.2 s earlier")
    assert "3 values with the time of another left out" in note


def test_rows_that_are_left_out_are_no_pause(tmp_path: Path) -> None:
    """A row in five lost: the record was cut into eight, each from the twin's start on."""
    keep = np.sort(np.random.default_rng(0).permutation(400)[:320])
    rows = [f"{k / 10:.1f},{k // 50},{k}" for k in keep]
    found = read_logs([table(tmp_path / "a.csv", "time,valve,speed", rows)], TWIN)
    made = found.trajectories
    assert made.ids.tolist() == ["a"]
    kept = np.isin(np.arange(keep[0], keep[-1] + 1), keep)
    np.testing.assert_allclose(made.commands[0, kept[: made.steps], 0], keep // 50)
    longest = np.diff(keep).max() / 10
    assert longest > 0.25, "more than one lost row"
    assert any(f"for {longest:.2g} s at most" in note for note in found.notes)
    assert not made.mask[0, :, 0].all(), "measurements are not joined over as long"


def test_a_last_column_with_empty_cells_keeps_its_title_and_its_first_rows(tmp_path: Path) -> None:
    rows = [f"{k / 10},{k % 4},{'' if k in (1, 3, 4) else k}" for k in range(25)]
    made = read_logs([table(tmp_path / "a.csv", "time,valve,level", rows)], TWIN).trajectories
    assert made.steps == 25
    assert np.flatnonzero(~made.mask[0, :, 1]).tolist() == [3, 4], "one cell alone is bridged"
    trailing = [f"{k / 10},{k % 4},{k}," for k in range(25)]
    again = read_logs([table(tmp_path / "b.csv", "time,valve,level,", trailing)], TWIN)
    assert again.trajectories.mask[0, :, 1].all()


def test_topics_at_several_rates_are_found_by_their_last_names(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    import json

    from mcap.writer import Writer

    signals = {"/plc": ("valve", 2.0), "/encoder": ("speed", 50.0), "/tank": ("level", 5.0)}
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("", "test")
        for topic, (field, rate) in signals.items():
            schema = writer.register_schema(topic, "jsonschema", b"{}")
            channel = writer.register_channel(topic, "json", schema)
            for k in range(int(10 * rate)):
                stamp = BEGIN + round(k / rate * 1e9)
                writer.add_message(channel, stamp, json.dumps({field: k / rate}).encode(), stamp)
        writer.finish()
    reader = LogReader()
    assert reader.rate(tmp_path / "a.mcap", (*TWIN.inputs.names, *TWIN.outputs.names)) == 5
    assert reader.measured_outputs([tmp_path / "a.mcap"], TWIN) == ("speed", "level")
    made = reader.trajectories([tmp_path / "a.mcap"], TWIN).trajectories
    np.testing.assert_allclose(made.observed[0, :90, 0], np.arange(90) / 10, atol=1e-6)
    np.testing.assert_allclose(made.commands[0, :95, 0], np.arange(95) // 5 / 2, atol=1e-6)


@pytest.mark.parametrize(
    ("head", "row", "columns", "said"),
    [
        ("time,Valve,level", "{t},{k},{k}", {}, "none for valve; .* identify --column"),
        ("time,a.valve,b.valve,level", "{t},{k},{k},{k}", {}, "got a.valve, b.valve; give"),
        ("valve,level", "{t},{k}", {}, "give --time COLUMN, or --rate HZ"),
        ("time,valve,level [kg]", "{t},{k},{k}", {}, "a unit that is converted to 'm'"),
        ("time,valve,level", "{t},{k},{k}", {"level": "depth"}, "expected a column 'depth'"),
        ("time,valve,level", "{t},,{k}", {}, "a number for every command"),
        ("time,valve,level", "{t},on or off,{k}", {}, "numbers in columns valve, got text"),
        ("time,valve,level", "0.0,{k},{k}", {}, "29 of 30 at the time of the one before"),
    ],
)
def test_what_is_not_certain_is_refused(
    tmp_path: Path, head: str, row: str, columns: dict[str, str], said: str
) -> None:
    rows = [row.format(t=k / 10, k=k) for k in range(30)]
    path = table(tmp_path / "a.csv", head, rows)
    with pytest.raises(InputError, match=said):
        LogReader(Columns(columns)).trajectories([path], TWIN, rows_at_rate=False)


def test_a_hole_in_a_command_is_refused_and_a_row_of_another_unit_of_time_is_read(
    tmp_path: Path,
) -> None:
    rows = [f"{100 * k},{'' if k == 12 else k},{k}" for k in range(30)]
    path = table(tmp_path / "a.csv", "stamp [ms],valve,level", rows)
    with pytest.raises(InputError, match=r"29 of 30, none at 1\.2 s"):
        read_logs([path], TWIN)
    path = table(tmp_path / "b.csv", "n,valve,level", [each.replace(",,", ",0,") for each in rows])
    named = Columns(time=TimeSettings(column="n", unit="ms"))
    assert read_logs([path], TWIN, named).trajectories.steps == 30


def test_channels_that_never_change_are_named_and_their_commands_can_be_drawn(
    tmp_path: Path,
) -> None:
    path = table(tmp_path / "a.csv", "time,valve,level", [f"{k / 10},0.5,{k}" for k in range(30)])
    found = read_logs([path], TWIN)
    assert any(note.startswith("valve: constant in what was read") for note in found.notes)
    sampler = rt.twins.sampler_from(found.trajectories.commands, 10.0)
    drawn = sampler.sample(3, rng=np.random.default_rng(0))
    assert np.isfinite(drawn).all()
