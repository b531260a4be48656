"""Reading and writing: every layout, every kind of bad input, damaged files, the same bytes."""

import io
import json
import os
import shutil
import struct
import subprocess
import sys
import warnings
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import loadmat, savemat

from retwin.data.io import check_target, load, save
from retwin.data.io.mat import mat_reader, mat_variables
from retwin.data.trajectories import Channels, Provenance, Trajectories
from retwin.errors import InputError
from retwin.serialisation.files import sha256, write_atomically
from retwin.serialisation.sizes import Budget

INPUTS = Channels(("left", "right"), ("V", "V"))
OUTPUTS = Channels(("x", "y", "z"), ("m", "m", "m"))
ARRAYS = ("commands", "nominal", "observed", "mask", "labels", "ids")


@dataclass
class Case:
    """A small case: two commands, three outputs, recovery that is easy to recognise."""

    inputs: Channels = INPUTS
    outputs: Channels = OUTPUTS
    rate: float = 100.0
    classes: tuple[str, ...] = ("Healthy", "Broken")

    def complete(self, trajectories, *, progress=None):
        """Commands are the first two nominal outputs."""
        if progress is not None:
            progress(1.0)
        return trajectories.replace(commands=trajectories.nominal[..., :2], inputs=self.inputs)


def cells(values):
    row = np.empty((1, len(values)), object)
    for i, value in enumerate(values):
        row[0, i] = value
    return row


def blocks(n=4, steps=20, columns=6, dtype=np.float64, seed=0):
    return list(np.random.default_rng(seed).normal(size=(n, steps, columns)).astype(dtype))


def write_mat(path, arrays=None, labels=("Healthy", "Broken", "Healthy", "Broken"), prefix="X_"):
    arrays = blocks() if arrays is None else arrays
    keys = {"X_": ("X_array", "y_array"), "X_test_": ("X_test_array", "y_test_array")}[prefix]
    savemat(path, dict(zip(keys, (cells(arrays), cells(list(labels))), strict=True)))
    return arrays


def example(**changes):
    rng = np.random.default_rng(1)
    observed = rng.normal(size=(4, 20, 3))
    observed[0, 3, 1] = np.nan
    parts = {
        "commands": rng.normal(size=(4, 20, 2)),
        "nominal": rng.normal(size=(4, 20, 3)),
        "observed": observed,
        "rate": 100.0,
        "labels": ["Healthy", "Broken", "", "Moteur cassé"],
        "ids": list("abcd"),
        "inputs": Channels(("left", "right"), ("V", "V")),
        "outputs": Channels(("x", "y", "z"), ("m", "m", "°")),
        "provenance": (Provenance("made", "00"), Provenance("by hand")),
        "emulated": True,
    }
    return Trajectories(**(parts | changes))


def assert_same(one, other):
    for name in ARRAYS:
        first, second = getattr(one, name), getattr(other, name)
        assert first.shape == second.shape, name
        np.testing.assert_array_equal(first, second)
        if name not in ("labels", "ids"):
            assert first.dtype == second.dtype, name
    for name in ("rate", "inputs", "outputs", "provenance", "emulated"):
        assert getattr(one, name) == getattr(other, name), name


def refused(match, path, **options):
    """`load` refuses `path` in one line that has `match` in it; the message."""
    with pytest.raises(InputError, match=match) as caught:
        load(path, **options)
    assert "\n" not in str(caught.value)
    assert "expected" in str(caught.value)
    return str(caught.value)


# --- MAT ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("prefix", ["X_", "X_test_"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_mat_of_both_key_pairs(tmp_path, prefix, dtype):
    file = tmp_path / "a.mat"
    arrays = write_mat(file, blocks(dtype=dtype), prefix=prefix)
    read = load(file, rate=50)
    np.testing.assert_array_equal(read.nominal, np.stack(arrays)[..., :3])
    np.testing.assert_array_equal(read.observed, np.stack(arrays)[..., 3:])
    assert read.nominal.dtype == read.observed.dtype == dtype
    assert read.labels.tolist() == ["Healthy", "Broken", "Healthy", "Broken"]
    assert read.commands.shape == (4, 20, 0)
    assert read.rate == 50
    assert read.provenance == (Provenance("a.mat", sha256(file)),)
    assert not read.emulated


def test_mat_cells_of_whole_numbers_become_floats(tmp_path):
    write_mat(tmp_path / "a.mat", [np.arange(12).reshape(2, 6)] * 4)
    read = load(tmp_path / "a.mat", rate=1)
    assert read.nominal.dtype == np.float64
    assert read.nominal[0].tolist() == [[0, 1, 2], [6, 7, 8]]


def test_mat_with_case_gets_channels_rate_and_commands(tmp_path):
    arrays = write_mat(tmp_path / "a.mat")
    done = []
    read = load(tmp_path / "a.mat", case=Case(), progress=done.append)
    assert read.inputs == Case.inputs
    assert read.outputs == Case.outputs
    assert read.rate == 100
    np.testing.assert_array_equal(read.commands, np.stack(arrays)[..., :2])
    assert done == [1.0]


def test_mat_with_commands_first_needs_the_case(tmp_path):
    arrays = write_mat(tmp_path / "a.mat", blocks(columns=8))
    read = load(tmp_path / "a.mat", case=Case())
    np.testing.assert_array_equal(read.commands, np.stack(arrays)[..., :2])
    np.testing.assert_array_equal(read.observed, np.stack(arrays)[..., 5:])


def test_mat_cells_of_different_lengths_are_padded(tmp_path):
    arrays = [block[:steps] for block, steps in zip(blocks(), (20, 7, 15, 20), strict=True)]
    write_mat(tmp_path / "a.mat", arrays)
    read = load(tmp_path / "a.mat", case=Case())
    assert read.steps == 20
    np.testing.assert_array_equal(read.nominal[1, :7], arrays[1][:, :3])
    assert (read.nominal[1, 7:] == arrays[1][-1, :3]).all()
    assert (read.commands[1, 7:] == arrays[1][-1, :2]).all()
    assert read.mask[1, :7].all()
    assert not read.mask[1, 7:].any()
    assert (read.observed[1, 7:] == 0).all()
    assert read.mask[[0, 3]].all()


def test_mat_nan_in_observed_is_missing(tmp_path):
    arrays = blocks()
    arrays[2][5, 4] = np.nan
    write_mat(tmp_path / "a.mat", arrays)
    read = load(tmp_path / "a.mat", rate=100)
    assert np.argwhere(~read.mask).tolist() == [[2, 5, 1]]
    assert read.observed[2, 5, 1] == 0


def test_mat_empty_text_is_no_label(tmp_path):
    write_mat(tmp_path / "a.mat", labels=["Healthy", "", "", "Broken"])
    assert load(tmp_path / "a.mat", case=Case()).labels.tolist() == ["Healthy", "", "", "Broken"]


def with_value(column, value):
    arrays = blocks()
    arrays[1][3, column] = value
    return arrays


@pytest.mark.parametrize(
    ("match", "arrays", "labels"),
    [
        ("even number of columns", blocks(columns=5), None),
        ("trajectory 2.*6|3 columns of nominal", blocks(3) + blocks(1, columns=4), None),
        ("table of real numbers", [np.ones((20, 6), complex)] * 4, None),
        ("table of real numbers", ["text"] * 4, None),
        ("table of real numbers", [np.ones((4, 20, 6))] * 4, None),
        ("table of real numbers", [np.ones((0, 6))] * 4, None),
        ("at least two samples", blocks(steps=1), None),
        ("trajectory 1.*finite values of nominal.*nan in sample 3, col", with_value(2, np.nan), 0),
        ("trajectory 1.*finite values of nominal.*inf", with_value(0, np.inf), None),
        ("trajectory 1.*finite values of observed.*-inf", with_value(4, -np.inf), None),
        ("one class name for each, 4.*got 2", blocks(), ["a", "b"]),
        ("a class name.*float64|a class name.*int", blocks(), [1, 2, 3, 4]),
        ("a class name", blocks(), [np.array(["a", "b"])] * 4),
    ],
)
def test_mat_with_bad_contents(tmp_path, match, arrays, labels):
    write_mat(tmp_path / "a.mat", arrays, labels or ["Healthy", "Broken", "Healthy", "Broken"])
    assert "a.mat" in refused(match, tmp_path / "a.mat", rate=100) or "two samples" in match


def test_mat_with_other_variables_says_which_came(tmp_path):
    savemat(tmp_path / "a.mat", {"X_array": cells(blocks()), "speed": 1.0})
    refused("X_array with y_array.*got the variables X_array, speed", tmp_path / "a.mat", rate=1)
    both = {key: cells(blocks()) for key in ("X_array", "X_test_array")}
    names = {key: cells(["a"] * 4) for key in ("y_array", "y_test_array")}
    savemat(tmp_path / "b.mat", both | names)
    refused("one pair", tmp_path / "b.mat", rate=1)


def test_mat_that_is_no_row_of_cells(tmp_path):
    names = cells(["a"] * 4)
    savemat(tmp_path / "a.mat", {"X_array": np.ones((4, 20, 6)), "y_array": names})
    refused("a row of cells", tmp_path / "a.mat", rate=1)
    square = cells(blocks()).reshape(2, 2)
    savemat(tmp_path / "b.mat", {"X_array": square, "y_array": names})
    refused("a row of cells", tmp_path / "b.mat", rate=1)
    savemat(tmp_path / "c.mat", {"X_array": cells([]), "y_array": cells([])})
    refused("at least one trajectory", tmp_path / "c.mat", rate=1)


def test_mat_of_version_73_says_how_to_save_it(tmp_path):
    header = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    (tmp_path / "a.mat").write_bytes(header + bytes(600))
    refused("'-v7'", tmp_path / "a.mat", rate=1)


def test_mat_without_rate_and_case_says_what_to_give(tmp_path):
    write_mat(tmp_path / "a.mat")
    assert "--rate or --case" in refused("sample rate", tmp_path / "a.mat")


@pytest.mark.parametrize("rate", [0, -1, float("nan"), "fast"])
def test_rate_must_be_a_rate(tmp_path, rate):
    write_mat(tmp_path / "a.mat")
    refused("positive number of Hz", tmp_path / "a.mat", rate=rate)


def test_class_that_the_case_does_not_know(tmp_path):
    write_mat(tmp_path / "a.mat", labels=["Healthy", "Melted", "Broken", "Broken"])
    refused("Healthy, Broken.*'Melted'", tmp_path / "a.mat", case=Case())


def test_case_of_other_width_or_rate(tmp_path):
    write_mat(tmp_path / "a.mat", blocks(columns=4))
    refused(
        r"6 columns .* or 8 \(commands, nominal, observed\), got 4",
        tmp_path / "a.mat",
        case=Case(),
    )
    write_mat(tmp_path / "b.mat")
    refused("one sample rate, 50 Hz.*100 Hz", tmp_path / "b.mat", case=Case(), rate=50)


# --- folders of CSV ----------------------------------------------------------------------------


def write_csv(folder, arrays, names):
    for array, name in zip(arrays, names, strict=True):
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savetxt(file, array, delimiter=",")


NAMES = ("Healthy/run_10.csv", "Broken/run_1.csv", "Healthy/run_9.csv", "Broken/run_2.csv")


def test_csv_folder(tmp_path):
    arrays = blocks()
    arrays[0][2, 5] = np.nan
    write_csv(tmp_path / "set", arrays, NAMES)
    (tmp_path / "set" / "notes.txt").write_text("by hand")
    (tmp_path / "set" / ".cache").mkdir()
    (tmp_path / "set" / ".cache" / "x.csv").write_text("not data")
    done = []
    read = load(tmp_path / "set", rate=10, progress=done.append)
    assert read.ids.tolist() == [
        "Broken/run_1",
        "Broken/run_2",
        "Healthy/run_9",
        "Healthy/run_10",
    ]
    assert read.labels.tolist() == ["Broken", "Broken", "Healthy", "Healthy"]
    np.testing.assert_array_equal(read.nominal[3], arrays[0][:, :3])
    assert np.argwhere(~read.mask).tolist() == [[3, 2, 2]]
    assert read.provenance == (Provenance("set", sha256(tmp_path / "set")),)
    assert done == [0.25, 0.5, 0.75, 1.0]
    assert load(tmp_path / "set", case=Case()).inputs == Case.inputs


def test_csv_with_commands_first(tmp_path):
    arrays = blocks(columns=8)
    write_csv(tmp_path, arrays, NAMES)
    read = load(tmp_path, case=Case())
    np.testing.assert_array_equal(read.commands[0], arrays[1][:, :2])
    np.testing.assert_array_equal(read.nominal[0], arrays[1][:, 2:5])


@pytest.mark.parametrize(
    ("match", "text"),
    [
        ("'x' in line 1", "x,y\n1,2\n"),
        ("'oops' in line 3", "1,2\n3,4\n5,oops\n"),
        ("'' in line 2", "1,2\n3,\n"),
        ("3 columns in line 3 after 2 before", "1,2\n\n3,4,5\n"),
        ("'1;2' in line 1", "1;2\n3;4\n"),
        ("no rows", ""),
        ("no rows", "\n \n"),
        ("'# 1' in line 1", "# 1,2\n1,2\n"),
        ("even number of columns.*got 3", "1,2,3\n4,5,6\n"),
        ("finite values of nominal", "nan,2\n1,2\n"),
        ("finite values of observed", "1,2\n1,inf\n"),
    ],
)
def test_csv_error_names_file_and_line(tmp_path, match, text):
    (tmp_path / "Healthy").mkdir()
    (tmp_path / "Healthy" / "a.csv").write_text(text)
    assert "Healthy/a.csv" in refused(match, tmp_path, rate=1)


def test_csv_that_is_no_text(tmp_path):
    (tmp_path / "Healthy").mkdir()
    (tmp_path / "Healthy" / "a.csv").write_bytes(bytes(range(256)))
    refused("Healthy/a.csv", tmp_path, rate=1)


def test_csv_with_byte_order_mark_and_windows_lines(tmp_path):
    (tmp_path / "Healthy").mkdir()
    (tmp_path / "Healthy" / "a.csv").write_bytes(b"\xef\xbb\xbf1,2\r\n3,4\r\n")
    assert load(tmp_path, rate=1).nominal.ravel().tolist() == [1, 3]


def test_csv_widths_that_differ_between_files(tmp_path):
    write_csv(tmp_path, blocks(1) + blocks(1, columns=4), NAMES[1:3])
    refused("3 columns of nominal, as in Broken/run_1.csv, got 2", tmp_path, rate=1)


def test_empty_and_flat_and_mixed_folders(tmp_path):
    refused("folder per class.*no such file", tmp_path, rate=1)
    (tmp_path / "a.csv").write_text("1,2\n3,4\n")
    refused("folder above the class folders", tmp_path, rate=1)
    write_csv(tmp_path, blocks(), NAMES)
    write_dataset(tmp_path, "Healthy/dataset_1.mat")
    refused("both kinds", tmp_path, rate=1)


# --- the authors' folders ----------------------------------------------------------------------


def write_dataset(folder, name, *, steps=20, seed=0, turned=False, **variables):
    desired, realised = np.random.default_rng(seed).normal(size=(2, steps, 3))
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    paths = {"trajCmds": desired, "trajResps": realised}
    if turned:
        paths = {key: value.T for key, value in paths.items()}
    savemat(file, paths | variables)
    return desired, realised


def test_dataset_folder_without_commands_is_completed(tmp_path):
    desired, realised = write_dataset(tmp_path, "Healthy/dataset_10.mat", seed=1)
    write_dataset(tmp_path, "Healthy/dataset_9.mat", seed=2, turned=True)
    write_dataset(tmp_path, "Broken/dataset_1.mat", seed=3)
    # The authors keep these beside the data; they are no trajectories.
    savemat(tmp_path / "Healthy" / "hidden_dataset_9.mat", {"motorRespsRadius": 1.0})
    read = load(tmp_path, case=Case())
    assert read.ids.tolist() == ["Broken/dataset_1", "Healthy/dataset_9", "Healthy/dataset_10"]
    assert read.labels.tolist() == ["Broken", "Healthy", "Healthy"]
    np.testing.assert_array_equal(read.nominal[2], desired)
    np.testing.assert_array_equal(read.observed[2], realised)
    turned = np.random.default_rng(2).normal(size=(2, 20, 3))[0]
    np.testing.assert_array_equal(read.nominal[1], turned)
    np.testing.assert_array_equal(read.commands, read.nominal[..., :2])


def test_older_dataset_of_six_columns(tmp_path):
    both = blocks(1)[0]
    (tmp_path / "Healthy").mkdir()
    savemat(tmp_path / "Healthy" / "dataset_1.mat", {"dataset": both})
    read = load(tmp_path, rate=100)
    np.testing.assert_array_equal(read.nominal[0], both[:, :3])
    np.testing.assert_array_equal(read.observed[0], both[:, 3:])


motors = np.random.default_rng(5).uniform(-1, 1, (20, 5))
clock = np.arange(20) / 100


@pytest.mark.parametrize(
    "stored",
    [
        motors,
        motors.T,
        cells([motors[:, i : i + 1] for i in range(5)]),
        cells([motors[:, i] for i in range(5)]),
        cells([motors[:, i].reshape(1, 1, 20) for i in range(5)]),
        cells([{"Data": motors[:, i : i + 1], "Time": clock[:, None]} for i in range(5)]),
        cells([{"Data": motors[:, i : i + 1]} for i in range(5)]),
    ],
    ids=["table", "turned", "columns", "rows", "deep", "structs", "structs without time"],
)
def test_dataset_commands_in_radians(tmp_path, stored):
    write_dataset(tmp_path, "Healthy/dataset_1.mat", motorCmdsRadius=stored)
    plain = load(tmp_path, rate=100)
    np.testing.assert_array_equal(plain.commands[0], motors)
    assert plain.inputs == Channels.numbered("motor_", 5, "rad")
    # A case in volts recovers its commands instead.
    recovered = load(tmp_path, case=Case())
    np.testing.assert_array_equal(recovered.commands, recovered.nominal[..., :2])
    in_rad = Case(inputs=Channels.numbered("motor_", 5, "rad"))
    np.testing.assert_array_equal(load(tmp_path, case=in_rad).commands[0], motors)


def element(kind, data):
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def opaque_cells(name, count):
    """A variable of `count` cells with MATLAB objects, as MATLAB writes `timeseries`."""
    flags, sizes, text, whole, any_matrix = 6, 5, 1, 6, 14
    words = np.array([0xDD000000, 2, 1, 1, 1, 1], "<u4").tobytes()
    numbers = element(flags, struct.pack("<II", 13, 0)) + element(sizes, struct.pack("<ii", 6, 1))
    numbers += element(text, b"") + element(whole, words)
    thing = element(flags, struct.pack("<II", 17, 0)) + element(text, b"")
    thing += element(text, b"MCOS") + element(text, b"timeseries") + element(any_matrix, numbers)
    body = element(flags, struct.pack("<II", 1, 0)) + element(sizes, struct.pack("<ii", 1, count))
    body += element(text, name.encode()) + count * element(any_matrix, thing)
    return element(any_matrix, body)


def test_dataset_with_timeseries_objects_is_completed(tmp_path):
    desired, _ = write_dataset(tmp_path, "Healthy/dataset_1.mat")
    file = tmp_path / "Healthy" / "dataset_1.mat"
    file.write_bytes(file.read_bytes() + opaque_cells("motorCmdsRadius", 5))
    stored = loadmat(file)["motorCmdsRadius"]  # the reader does meet what it would in earnest
    assert stored.shape == (1, 5)
    assert "timeseries" in str(stored[0, 0])
    read = load(tmp_path, case=Case())
    np.testing.assert_array_equal(read.commands[0], desired[:, :2])
    assert load(tmp_path, rate=100).commands.shape == (1, 20, 0)


def test_dataset_clock_tells_the_rate_and_must_agree(tmp_path):
    def structs(rate):
        times = np.arange(20)[:, None] / rate
        return cells([{"Data": motors[:, i : i + 1], "Time": times} for i in range(5)])

    write_dataset(tmp_path, "Healthy/dataset_1.mat", motorCmdsRadius=structs(100))
    assert load(tmp_path).rate == pytest.approx(100)
    refused("one sample rate, 50 Hz as in the argument, got 100 Hz", tmp_path, rate=50)
    write_dataset(tmp_path, "Healthy/dataset_2.mat", motorCmdsRadius=structs(50))
    refused("one sample rate.*got 50 Hz in Healthy/dataset_2", tmp_path)
    refused("one sample rate, 100 Hz as in the case", tmp_path, case=Case())


def uneven(times):
    return cells([{"Data": motors[:, i : i + 1], "Time": times[:, None]} for i in range(5)])


@pytest.mark.parametrize(
    ("match", "variables"),
    [
        ("20 samples per motor", {"motorCmdsRadius": cells([np.ones(19)] * 5)}),
        ("constant sample rate", {"motorCmdsRadius": uneven(clock**2)}),
        ("growing time", {"motorCmdsRadius": uneven(clock[::-1])}),
        ("growing time", {"motorCmdsRadius": uneven(clock[:-1])}),
        ("table of real numbers", {"motorCmdsRadius": cells(["a"] * 5)}),
        ("samples by 3 columns", {"trajCmds": np.ones((3, 3))}),
        ("samples by 3 columns", {"trajCmds": np.ones((20, 4))}),
        ("20 samples, as trajCmds.*got 21", {"trajResps": np.ones((21, 3))}),
        ("table of real numbers", {"trajResps": "text"}),
        ("finite values of commands", {"motorCmdsRadius": motors * np.nan}),
    ],
)
def test_dataset_with_bad_contents(tmp_path, match, variables):
    write_dataset(tmp_path, "Healthy/dataset_1.mat", **variables)
    assert "Healthy/dataset_1.mat" in refused(match, tmp_path, rate=100)


def test_dataset_with_other_variables_or_commands_in_some(tmp_path):
    (tmp_path / "a" / "Healthy").mkdir(parents=True)
    savemat(tmp_path / "a" / "Healthy" / "dataset_1.mat", {"speed": 1.0})
    refused("trajCmds and trajResps, or dataset, got speed", tmp_path / "a", rate=1)
    write_dataset(tmp_path / "b", "Healthy/dataset_1.mat", motorCmdsRadius=motors)
    write_dataset(tmp_path / "b", "Healthy/dataset_2.mat")
    refused("in every trajectory or in none", tmp_path / "b", rate=1)


# --- NPZ and Zarr ------------------------------------------------------------------------------

SUFFIXES = (".npz", ".zarr")
EMPTY_COMMANDS = {"commands": np.zeros((4, 20, 0)), "inputs": None}
SINGLE = {name: getattr(example(), name).astype(np.float32) for name in ("nominal", "observed")}


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("changes", [{}, EMPTY_COMMANDS, SINGLE, {"labels": None}])
def test_what_is_saved_comes_back(tmp_path, suffix, changes):
    made = example(**changes)
    save(made, tmp_path / f"a{suffix}")
    assert_same(load(tmp_path / f"a{suffix}"), made)


def test_what_is_no_set_of_trajectories_is_not_saved(tmp_path):
    with pytest.raises(InputError, match="trajectories: expected Trajectories"):
        save(None, tmp_path / "set.npz")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_set_without_trajectories_comes_back(tmp_path, suffix):
    save(example()[[]], tmp_path / f"a{suffix}")
    assert_same(load(tmp_path / f"a{suffix}"), example()[[]])


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_same_trajectories_same_bytes(tmp_path, suffix, monkeypatch):
    # Parts of a set carry the text width of the whole, and other strides: the bytes must not.
    part = example()[::3][[0]]
    anew = Trajectories(
        **{name: np.array(getattr(part, name).tolist()) for name in ARRAYS},
        rate=part.rate,
        inputs=part.inputs,
        outputs=part.outputs,
        provenance=part.provenance,
        emulated=part.emulated,
    )
    assert part.labels.dtype != anew.labels.dtype
    save(part, tmp_path / f"a{suffix}")
    monkeypatch.setattr("time.time", lambda: 2e9)
    save(anew, tmp_path / f"b{suffix}")
    save(load(tmp_path / f"a{suffix}"), tmp_path / f"c{suffix}")
    sums = {sha256(tmp_path / f"{name}{suffix}") for name in "abc"}
    assert len(sums) == 1
    save(part.replace(rate=99.0), tmp_path / f"a{suffix}")
    assert sha256(tmp_path / f"a{suffix}") not in sums


def test_npz_needs_no_retwin_to_be_read(tmp_path):
    save(example(), tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        header = json.loads(archive["header"].tobytes())
        np.testing.assert_array_equal(archive["nominal"], example().nominal)
    assert header["schema"] == 1
    assert header["rate"] == 100
    assert header["outputs"] == {"names": ["x", "y", "z"], "units": ["m", "m", "°"]}
    assert header["provenance"][0] == {"name": "made", "sha256": "00"}
    assert header["emulated"] is True


def rewritten(file, **changes):
    """`file` (NPZ) with another header or other arrays; None leaves one out."""
    with np.load(file) as archive:
        contents = dict(archive.items())
    contents |= changes
    with zipfile.ZipFile(file, "w") as archive:
        for name, array in contents.items():
            if array is not None:
                buffer = io.BytesIO()
                np.lib.format.write_array(buffer, array, allow_pickle=True)
                archive.writestr(f"{name}.npy", buffer.getvalue())


def header_with(file, **changes):
    with np.load(file) as archive:
        header = json.loads(archive["header"].tobytes()) | changes
    return np.frombuffer(json.dumps(header).encode(), np.uint8)


def test_npz_of_a_newer_schema_or_another_kind(tmp_path):
    file = tmp_path / "a.npz"
    save(example(), file)
    rewritten(file, header=header_with(file, schema=2))
    refused("schema 1 or older, got schema 2; upgrade", file)
    rewritten(file, header=header_with(file, schema="1"))
    refused("saved by retwin", file)
    rewritten(file, header=header_with(file, schema=1, format="other"))
    refused("saved by retwin", file)
    np.savez(file, a=np.ones(3))
    refused("with a header", file)
    np.save(tmp_path / "b.npy", np.ones(3))
    os.replace(tmp_path / "b.npy", file)
    refused("damaged or of another kind", file)


@pytest.mark.parametrize(
    "changes",
    [
        {"nominal": None},
        {"nominal": np.ones((4, 20, 3))},
        {"labels": np.array(["a", "b", "c", "d"])},
        {"labels": np.array(["a", "b", "c", "d"], object)},
        {"header": np.frombuffer(b"{}", np.uint8)},
        {"header": np.frombuffer(b"\xff", np.uint8)},
        {"header": np.frombuffer(b"[1]", np.uint8)},
    ],
)
def test_npz_with_bad_contents(tmp_path, changes):
    file = tmp_path / "a.npz"
    save(example(), file)
    rewritten(file, **changes)
    refused("a.npz", file)


class Bomb:
    """Unpickling this would leave a mark."""

    fired = False

    def __reduce__(self):
        """What pickle would call."""
        return setattr, (Bomb, "fired", True)


def test_pickled_objects_are_refused_and_never_run(tmp_path):
    file = tmp_path / "a.npz"
    save(example(), file)
    rewritten(file, labels=np.array([Bomb()] * 4, object))
    refused("without pickled objects", file)
    assert not Bomb.fired


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_own_format_held_against_a_case_and_a_rate(tmp_path, suffix):
    file = tmp_path / f"a{suffix}"
    fitting = example(labels=["Healthy", "", "", "Broken"], outputs=Case.outputs)
    save(fitting, file)
    assert_same(load(file, case=Case(), rate=100), fitting)
    refused("rate: expected 100 Hz, the sample rate of the file, got 50 Hz", file, rate=50)
    refused("50 Hz, the sample rate of the case", file, case=Case(rate=50))
    refused("'Broken'", file, case=Case(classes=("Healthy",)))
    others = Case(inputs=Channels(("left", "right"), ("A", "A")))
    refused(r"left \[A\].*got left \[V\]", file, case=others)
    refused("outputs", file, case=Case(outputs=Channels(("x", "y"), ("m", "m"))))
    save(fitting.replace(inputs=None, outputs=None), file)
    assert load(file, case=Case()).outputs == Case.outputs
    bare = fitting.replace(inputs=None, commands=np.zeros((4, 20, 0)))
    save(bare, file)
    np.testing.assert_array_equal(load(file, case=Case()).commands, bare.nominal[..., :2])


def test_zarr_of_another_kind_or_newer(tmp_path):
    import zarr

    refused("damaged or of another kind", (tmp_path / "a.zarr").mkdir() or tmp_path / "a.zarr")
    group = zarr.open_group(str(tmp_path / "b.zarr"), mode="w")
    refused("saved by retwin", tmp_path / "b.zarr")
    save(example(), tmp_path / "c.zarr")
    group = zarr.open_group(str(tmp_path / "c.zarr"), mode="a")
    group.attrs["retwin"] = dict(group.attrs["retwin"]) | {"schema": 9}
    refused("schema 9", tmp_path / "c.zarr")


def test_zarr_with_a_lost_or_damaged_chunk(tmp_path):
    save(example(), tmp_path / "a.zarr")
    chunk = next(file for file in (tmp_path / "a.zarr/nominal/c").rglob("*") if file.is_file())
    kept = chunk.read_bytes()
    chunk.unlink()  # zarr itself reads zeros there
    refused("array 'nominal' as it was written", tmp_path / "a.zarr")
    chunk.write_bytes(kept[:-9])
    refused("a.zarr", tmp_path / "a.zarr")


@pytest.mark.parametrize("part", ["shape", "chunk_shape"])
def test_zarr_of_a_size_that_was_not_written_takes_no_memory(tmp_path, part):
    save(example(), tmp_path / "a.zarr")
    file = tmp_path / "a.zarr/nominal/zarr.json"
    stored = json.loads(file.read_text())
    (stored if part == "shape" else stored["chunk_grid"]["configuration"])[part] = [10**9, 20, 3]
    file.write_text(json.dumps(stored))
    refused(r"nominal.*\(4, 20, 3\), got.*1000000000", tmp_path / "a.zarr")


def test_zarr_folder_by_any_name_and_case_of_suffix(tmp_path):
    save(example(), tmp_path / "a.zarr")
    os.rename(tmp_path / "a.zarr", tmp_path / "renamed")
    assert_same(load(tmp_path / "renamed"), example())


def test_without_zarr_one_line_says_how_to_install_it(tmp_path, monkeypatch):
    save(example(), tmp_path / "a.zarr")
    monkeypatch.setitem(sys.modules, "zarr", None)
    refused(r'pip install .*\[scale\]"', tmp_path / "a.zarr")
    with pytest.raises(InputError, match=r'pip install .*\[scale\]"'):
        save(example(), tmp_path / "b.zarr")
    assert not (tmp_path / "b.zarr").exists()
    save(example(), tmp_path / "b.npz")  # nothing else needs it


# --- paths and writing -------------------------------------------------------------------------


def test_missing_and_unknown_paths(tmp_path):
    refused("existing file or folder", tmp_path / "none.mat", rate=1)
    (tmp_path / "a.dat").write_text("1")
    refused(r"\*.mat or \*.npz", tmp_path / "a.dat", rate=1)
    (tmp_path / "b.zarr").write_text("1")
    refused(r"\*.zarr", tmp_path / "b.zarr")
    for name in ("a", "a.mat", "a.csv", "a.zip"):
        with pytest.raises(InputError, match=r"\.npz or \.zarr"):
            save(example(), tmp_path / name)
    assert check_target("A.NPZ") == ".npz"


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_interrupted_save_leaves_what_was_there(tmp_path, suffix, monkeypatch):
    file = tmp_path / f"a{suffix}"
    save(example(), file)
    before = sha256(file)

    def half(_, part):
        part.mkdir() if suffix == ".zarr" else part.touch()
        raise KeyboardInterrupt

    kind = {".npz": "npz", ".zarr": "zarr_folder"}[suffix]
    monkeypatch.setattr(f"retwin.data.io.{kind}.write_{suffix[1:]}", half)
    with pytest.raises(KeyboardInterrupt):
        save(example(rate=7.0), file)
    assert sha256(file) == before
    assert os.listdir(tmp_path) == [file.name]


def test_write_atomically_file(tmp_path):
    target = tmp_path / "deep" / "results.json"
    with write_atomically(target) as part:
        assert part.parent == target.parent
        assert part.suffix == ".json"
        part.write_text("one")
        assert not target.exists()
    assert target.read_text() == "one"
    with pytest.raises(ZeroDivisionError), write_atomically(target) as part:
        part.write_text("two")
        raise ZeroDivisionError
    with pytest.raises(FileNotFoundError, match="nothing was written"), write_atomically(target):
        pass
    assert target.read_text() == "one"
    with write_atomically(target) as part:
        part.write_text("three")
    assert target.read_text() == "three"
    assert os.listdir(target.parent) == ["results.json"]


def test_write_atomically_folder(tmp_path):
    target = tmp_path / "model"

    def fill(text, *names):
        with write_atomically(target) as part:
            part.mkdir()
            for name in names:
                (part / name).write_text(text)

    fill("one", "config.json", "weights")
    fill("two", "config.json", "weights")
    assert (target / "weights").read_text() == "two"
    (target / "thesis.tex").write_text("ten years")
    with pytest.raises(InputError, match=r"also holds thesis\.tex"):
        fill("three", "config.json", "weights")
    assert (target / "thesis.tex").read_text() == "ten years"
    assert (target / "weights").read_text() == "two"
    assert os.listdir(tmp_path) == ["model"]


def test_write_atomically_puts_the_old_folder_back(tmp_path, monkeypatch):
    target = tmp_path / "model"
    target.mkdir()
    (target / "a").write_text("old")
    real = os.replace
    monkeypatch.setattr("retwin.serialisation.files._exchange", lambda *_: False)

    def failing(source, goal):
        if Path(goal) == target and not str(source).endswith(".former"):
            raise OSError("no")
        real(source, goal)

    monkeypatch.setattr(os, "replace", failing)
    with pytest.raises(OSError, match="no"), write_atomically(target) as part:
        part.mkdir()
        (part / "a").write_text("new")
    assert (target / "a").read_text() == "old"
    assert os.listdir(tmp_path) == ["model"]


def test_write_atomically_never_changes_kind_and_follows_links(tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="a folder"), write_atomically(tmp_path / "folder") as part:
        part.write_text("x")
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="a file"), write_atomically(tmp_path / "file") as part:
        part.mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "file")
    with write_atomically(tmp_path / "link") as part:
        part.write_text("y")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "file").read_text() == "y"
    with (
        pytest.raises(InputError, match="place that can be written"),
        write_atomically(tmp_path / "file" / "below"),
    ):
        pass


def test_sha256_of_files_and_folders(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "one").write_text("abc")
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert sha256(tmp_path / "a" / "one") == known
    (tmp_path / "a" / "b" / "two").write_text("x")
    before = sha256(tmp_path / "a")
    (tmp_path / "a" / ".hidden").write_text("noise")
    assert sha256(tmp_path / "a") == before
    os.rename(tmp_path / "a" / "b" / "two", tmp_path / "a" / "b" / "three")
    renamed = sha256(tmp_path / "a")
    (tmp_path / "a" / "one").write_text("abd")
    assert len({before, renamed, sha256(tmp_path / "a")}) == 3
    with pytest.raises(InputError, match="existing file"):
        sha256(tmp_path / "none")


# --- damaged files -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """Sound files by suffix: their bytes."""
    folder = tmp_path_factory.mktemp("sound")
    write_mat(folder / "a.mat")
    compressed = {"X_array": cells(blocks()), "y_array": cells(["Healthy"] * 4)}
    savemat(folder / "b.mat", compressed, do_compression=True)
    save(example(), folder / "c.npz")
    return {file.name: file.read_bytes() for file in sorted(folder.iterdir())}


damage = st.tuples(st.sampled_from(["cut", "flip", "fill"]), st.floats(0, 1), st.integers(0, 7))


def damaged(data, what, place, bit):
    at = min(int(place * len(data)), len(data) - 1)
    if what == "cut":
        return data[:at]
    if what == "fill":
        return data[:at] + bytes([255 * (bit % 2)]) * min(64, len(data) - at) + data[at + 64 :]
    return data[:at] + bytes([data[at] ^ (1 << bit)]) + data[at + 1 :]


def refused_or_read(file, data):
    """What a damaged file holds, None if it was refused."""
    file.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            read = load(file, rate=100.0)
        except InputError as error:
            assert "\n" not in str(error)
            return None
    assert np.isfinite(read.nominal).all()
    assert read.nominal.shape == read.observed.shape
    return read


@settings(
    max_examples=300,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(how=damage)
def test_damaged_npz_files_are_refused_or_read(tmp_path, sound, how):
    read = refused_or_read(tmp_path / "c.npz", damaged(sound["c.npz"], *how))
    if read is not None:
        assert_same(read, example())  # checksums leave no wrong numbers


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.mat", "b.mat"])
@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(how=damage)
def test_damaged_mat_files_are_refused_or_read(tmp_path, sound, name, how):
    refused_or_read(tmp_path / name, damaged(sound[name], *how))


@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(which=st.integers(0, 8), how=damage)
def test_damaged_zarr_folders_are_refused_or_read(tmp_path, which, how):
    folder = tmp_path / "a.zarr"
    save(example(), folder)
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    assert len(files) == 9
    files[which].write_bytes(damaged(files[which].read_bytes(), *how))
    try:
        read = load(folder)
    except InputError as error:
        assert "\n" not in str(error)
        return
    finally:
        shutil.rmtree(folder)
    for name in ("commands", "nominal", "observed"):
        np.testing.assert_array_equal(getattr(read, name), getattr(example(), name))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.mat", "b.mat", "c.npz"])
def test_every_truncation_near_the_ends_is_refused(tmp_path, sound, name):
    file, data = tmp_path / name, sound[name]
    step = 1 if name == "c.npz" else 10  # each MAT file takes a process
    for size in [*range(0, 160, 7 * step), *range(len(data) - 20, len(data) - 4, step)]:
        file.write_bytes(data[:size])
        refused("readable MAT|damaged|with a header|as it was written", file, rate=100)


def variables_of(file, names=None):
    with mat_reader() as reader:
        return mat_variables(file, Budget(file.name), reader, names)


def test_a_flipped_bit_that_crashes_scipy_is_refused_in_one_line(tmp_path):
    file = tmp_path / "a.mat"
    variables = {"X_array": cells(blocks(2, 3)), "s": {"Data": np.ones(2), "Time": "now"}}
    savemat(file, variables, do_compression=False)
    data = file.read_bytes()
    outcomes = set()
    for at, bit in [(144, 2), (144, 3), (201, 3), (433, 2)]:
        file.write_bytes(data[:at] + bytes([data[at] ^ (1 << bit)]) + data[at + 1 :])
        try:
            variables_of(file)
        except InputError as error:
            assert str(error).startswith("a.mat: expected a readable MAT file, got ")
            assert str(error).endswith("; get the file again")
            outcomes.add("crashed" if "(signal " in str(error) else "refused")
    assert "crashed" in outcomes


def assert_like_scipy(mine, theirs):
    if isinstance(mine, dict):
        assert theirs.size == 1
        assert set(mine) == set(theirs.dtype.names)
        for name, value in mine.items():
            assert_like_scipy(value, theirs[name].item())
        return
    assert mine.shape == theirs.shape
    if mine.dtype == object:
        for one, other in zip(mine.ravel(), theirs.ravel(), strict=True):
            assert_like_scipy(one, other)
        return
    assert mine.dtype.kind == theirs.dtype.kind
    assert mine.dtype.kind == "U" or mine.dtype == theirs.dtype
    np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("compressed", [False, True])
def test_the_process_sends_what_scipy_reads(tmp_path, compressed):
    kinds = ("f4", "f8", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "c16")
    tables = [np.arange(6).reshape(2, 3).astype(kind) for kind in kinds]
    tables.append(np.zeros((0, 3)))
    inner = {"Data": tables[0], "Time": "now", "longer": cells(["Motor ä", cells(tables[:2])])}
    variables = {"a": cells(tables), "b1": inner, "rows": ["one", "two"], "empty": ""}
    file = tmp_path / "a.mat"
    savemat(file, variables, do_compression=compressed)
    mine = variables_of(file)
    theirs = {k: v for k, v in loadmat(file).items() if not k.startswith("__")}
    assert set(mine) == set(theirs) == set(variables)
    for name in variables:
        assert_like_scipy(mine[name], theirs[name])
    assert set(variables_of(file, ["b1", "other"])) == {"b1"}


def test_one_process_reads_several_files_and_what_only_matlab_knows_is_none(tmp_path):
    body = struct.pack(">IIII", 6, 8, 6, 0) + struct.pack(">IIii", 5, 8, 1, 2)
    body += struct.pack(">HH", 1, 1) + b"x\0\0\0" + struct.pack(">IIdd", 9, 16, 1.5, -2.0)
    header = b"MATLAB".ljust(124) + b"\x01\x00MI"
    files = [tmp_path / name for name in ("a.mat", "b.mat", "c.mat")]
    files[0].write_bytes(header + struct.pack(">II", 14, len(body)) + body)
    files[1].write_bytes(b"MATLAB".ljust(124) + b"\x00\x01IM" + opaque_cells("m", 1))
    savemat(files[2], {"s": scipy.sparse.eye_array(3)})
    with mat_reader() as reader:
        first, second, third = (mat_variables(file, Budget("a"), reader) for file in files)
    assert first["x"].tolist() == [[1.5, -2.0]]
    assert second["m"][0, 0] is None
    assert third == {"s": None}


# --- the real files ----------------------------------------------------------------------------

needs_data = pytest.mark.skipif(
    "RETWIN_DATA" not in os.environ, reason="RETWIN_DATA names the folder of the real data"
)
CLASSES = {"Healthy"} | {
    f"Motor_{i}_{fault}" for i in range(1, 5) for fault in ("Stuck", "Steady_state_error")
}


@pytest.mark.slow
@needs_data
@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "n", "dtype"), [("sim.mat", 3600, np.float32), ("real_a.mat", 54, np.float64)]
)
def test_the_arms_files(tmp_path, name, n, dtype):
    file = Path(os.environ["RETWIN_DATA"]) / "armpi" / name
    if not file.exists():
        pytest.skip(f"{name} is not in RETWIN_DATA")
    mine, theirs = variables_of(file), loadmat(file)
    for key, value in mine.items():
        assert_like_scipy(value, theirs[key])
    read = load(file, rate=100)
    assert read.nominal.shape == read.observed.shape == (n, 1000, 3)
    assert read.nominal.dtype == read.observed.dtype == dtype
    assert read.known_labels == CLASSES
    assert {(read.labels == label).sum() for label in CLASSES} == {n // 9}
    assert read.mask.all()
    # The arm stands straight up at first, and both paths stay within its reach of 0.31 m.
    np.testing.assert_allclose(read.nominal[:, 0, 2], 0.3105, atol=1e-2)
    assert np.linalg.norm(read.observed, axis=2).max() < 0.35
    save(read[:9], tmp_path / "part.npz")
    assert_same(load(tmp_path / "part.npz"), read[:9])


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_data_need_no_learning_library(tmp_path, suffix):
    save(example(), tmp_path / f"a{suffix}")
    code = f"""
import sys
import retwin as rt
from retwin.serialisation import configs, files, identity, models

first, second = rt.load({str(tmp_path / f"a{suffix}")!r}).split(0.5, seed=0)
rt.Segments.from_commands(first.commands)
rt.save(rt.Trajectories.concatenate([first, second]), {str(tmp_path / f"b{suffix}")!r})
loaded = {{"torch", "scipy", "sklearn", "lightning", "matplotlib"}} & set(sys.modules)
assert not loaded, loaded
"""
    subprocess.run([sys.executable, "-c", code], check=True)
