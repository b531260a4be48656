"""`retwin data`: what is printed and written, and that bad input passes on as InputError."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from retwin.cases import data_case
from retwin.cli import data
from retwin.data import download
from retwin.data.io import load, save
from retwin.data.trajectories import Channels, Provenance, Trajectories
from retwin.errors import InputError
from retwin.serialisation.files import sha256

CLASSES = ("Healthy", "Broken [red]")


class Case:
    """The attributes that reading needs of a case."""

    inputs = Channels(("left", "right"), ("V", "V"))
    outputs = Channels(("x", "y", "z"), ("m", "m", "m"))
    rate = 100.0
    classes = CLASSES

    def complete(self, trajectories, *, progress=None):
        """Commands are the first two nominal outputs."""
        return trajectories.replace(commands=trajectories.nominal[..., :2], inputs=self.inputs)


@pytest.fixture
def file(tmp_path):
    rng = np.random.default_rng(0)
    observed = rng.normal(size=(10, 20, 3))
    observed[0, :6] = np.nan
    made = Trajectories(
        commands=np.zeros((10, 20, 0)),
        nominal=rng.normal(size=(10, 20, 3)),
        observed=observed,
        rate=100.0,
        labels=[CLASSES[i % 2] for i in range(10)],
        provenance=(Provenance("robot.mat", "ab12"),),
    )
    save(made, tmp_path / "set.npz")
    return tmp_path / "set.npz"


@pytest.fixture
def cases(monkeypatch):
    """`retwin.cases.get` that knows one case."""
    import retwin

    requested = []

    def get(name):
        requested.append(name)
        return Case()

    module = SimpleNamespace(data_case=get)
    monkeypatch.setitem(sys.modules, "retwin.cases", module)
    monkeypatch.setattr(retwin, "cases", module, raising=False)
    return requested


def run(*arguments, fails=None):
    result = CliRunner(env={"COLUMNS": "120"}).invoke(data.app, [str(a) for a in arguments])
    if fails is None:
        assert result.exception is None, result.output
        assert result.exit_code == 0
    else:
        assert isinstance(result.exception, fails)
    return result


def test_info_prints_a_table(file):
    shown = run("info", file).output
    for fact in (
        sha256(file),
        "Broken [red]",
        "20 (0.2 s)",
        "100 Hz",
        "y1 [1], y2 [1], y3 [1]",
        "3.00%",
        "robot.mat ab12",
    ):
        assert fact in shown


def test_info_as_json(file, cases):
    (facts,) = json.loads(run("info", file, "--case", "armpi", "--json").stdout)
    assert cases == ["armpi"]
    assert facts["sha256"] == sha256(file)
    assert facts["trajectories"] == 10
    assert facts["per_class"] == {"Broken [red]": 5, "Healthy": 5}
    assert (facts["samples"], facts["rate"]) == (20, 100)
    assert facts["inputs"] == [{"name": "left", "unit": "V"}, {"name": "right", "unit": "V"}]
    assert facts["missing"] == pytest.approx(18 / 600)
    assert facts["emulated"] is False
    assert facts["provenance"] == [{"name": "robot.mat", "sha256": "ab12"}]


def test_info_of_several_files_and_unlabelled_ones(file, tmp_path):
    save(load(file).replace(labels=None), tmp_path / "bare.npz")
    facts = json.loads(run("info", file, tmp_path / "bare.npz", "--json").stdout)
    assert [one["per_class"] for one in facts] == [{"Broken [red]": 5, "Healthy": 5}, {"": 10}]
    assert "unlabelled" in run("info", tmp_path / "bare.npz").output


@pytest.mark.parametrize("suffix", [".npz", ".zarr"])
def test_convert_keeps_everything_and_completes(file, tmp_path, suffix, cases):
    target = tmp_path / f"new{suffix}"
    result = run("convert", file, target, "--case", "armpi")
    assert (result.stdout, str(target) in result.stderr) == ("", True)
    written = load(target)
    assert written.outputs == Case.outputs
    np.testing.assert_array_equal(written.commands, written.nominal[..., :2])
    np.testing.assert_array_equal(written.observed, load(file).observed)
    assert written.provenance == (Provenance("robot.mat", "ab12"),)


def test_convert_of_csv_takes_a_rate(tmp_path):
    (tmp_path / "set" / "Healthy").mkdir(parents=True)
    (tmp_path / "set" / "Healthy" / "a.csv").write_text("1,2\n3,4\n")
    run("convert", tmp_path / "set", tmp_path / "a.npz", "--rate", 4)
    assert load(tmp_path / "a.npz").rate == 4
    result = run("convert", tmp_path / "set", tmp_path / "b.npz", fails=InputError)
    assert "--rate or --case" in str(result.exception)
    assert not (tmp_path / "b.npz").exists()


def test_bad_targets_are_refused_before_anything_is_read(tmp_path):
    nowhere = tmp_path / "none.npz"
    result = run("convert", nowhere, tmp_path / "a.csv", fails=InputError)
    assert ".npz or .zarr" in str(result.exception)
    (tmp_path / "b-rest.npz").mkdir()
    result = run("convert", nowhere, tmp_path / "b.npz", "--split", 0.5, fails=InputError)
    assert "b-rest.npz" in str(result.exception)


def test_a_split_writes_two_disjoint_parts(file, tmp_path):
    parts = tmp_path / "a.npz", tmp_path / "a-rest.npz"
    words = ("convert", file, parts[0], "--seed", 3, "--split")
    run(*words, 0.6)
    first, second = map(load, parts)
    expected, _ = load(file).split(0.6, seed=3)
    assert first.ids.tolist() == expected.ids.tolist()
    assert len(first) == 6
    assert sorted([*first.ids, *second.ids]) == load(file).ids.tolist()
    sums = [sha256(part) for part in parts]
    run(*words, 0.6)
    assert [sha256(part) for part in parts] == sums
    result = run(*words, 1.5, fails=InputError)
    assert "fraction" in str(result.exception)


def test_a_public_file_is_fetched_and_read_by_its_case(tmp_path, monkeypatch):
    arm, requested, file = data_case("armpi"), [], tmp_path / "fetched.npz"
    zeros = np.zeros((2, 20, 3))
    commands = np.zeros((2, 20, 0))
    made = Trajectories(commands, zeros, zeros, arm.rate, outputs=arm.outputs)
    save(made, file)

    def fetch(name, *, progress, max_bytes):
        requested.append((name, max_bytes))
        progress(1.0)
        return file

    monkeypatch.setattr(download, "fetch", fetch)
    run("convert", tmp_path / "real.npz", "--public", "armpi")
    assert requested == [("armpi", download.MAX_BYTES)]
    assert load(tmp_path / "real.npz").inputs == arm.inputs
    result = run("convert", tmp_path / "real.npz", fails=InputError)
    assert "--public NAME" in str(result.exception)


def test_input_errors_pass_on_to_the_caller(tmp_path):
    result = run("info", tmp_path / "none.mat", fails=InputError)
    assert "existing file or folder" in str(result.exception)


def test_nothing_but_the_result_is_printed(file):
    result = run("info", file, "--json")
    assert json.loads(result.stdout)
    assert result.stderr == ""


@pytest.fixture
def bench(tmp_path):
    """A log of a bench that paused, and lost its sensor for a second."""
    at = np.concatenate([np.arange(0, 5, 0.02), np.arange(9, 15, 0.02)])
    rows = [
        f"{t:.2f};{int(t) % 2};{'' if 2 < t < 3 else round(100 * t, 1)};7".replace(".", ",")
        for t in at
    ]
    path = tmp_path / "bench.csv"
    path.write_text("\n".join(["time [s];pump_cmd [V];level [cm];serial", *rows]))
    return path


def test_a_log_is_mapped_drawn_and_described(bench, call):
    code, out, err = call("data", "info", str(bench))
    assert (code, out) == (2, "")
    assert "make one: retwin data map bench.csv --out mapping.toml" in err
    out_file = bench.with_name("mapping.toml")
    code, out, err = call("data", "map", str(bench), "--out", str(out_file))
    assert code == 0, err
    assert "pump_cmd" in out
    assert "constant" in out
    assert out_file.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    code, out, _ = call("data", "info", str(bench), "--mapping", str(out_file), "--json")
    assert code == 0
    (facts,) = json.loads(out)
    assert (facts["trajectories"], facts["rate"]) == (2, 50.0)
    (source,) = facts["provenance"]
    command, level = source["sampling"]
    assert (command["method"], command["missing"]) == ("hold", 0.0)
    assert level["missing"] == pytest.approx(facts["missing"])
    assert 0.08 < level["missing"] < 0.1
    code, out, _ = call("data", "info", str(bench), "--mapping", str(out_file))
    assert "in trajectories" in " ".join(out.split())
    assert "linear" in out


@pytest.mark.parametrize(
    ("back", "remark"),
    [
        (0.0, "1 trajectory at 50 Hz: 100.0% of the log's"),
        (0.06, "pump_cmd, level: 2 values put in order, up to 0.04 s earlier than one before"),
        (3.0, "makes no trajectories yet: bench.csv, pump_cmd: expected times that increase"),
    ],
)
def test_what_a_mapping_makes_of_a_log_is_said(back, remark, tmp_path, call):
    at = np.arange(0, 10, 0.02)
    at[250:] -= back
    rows = [f"{t:.2f},{int(t) % 2},{t:.2f}" for t in at]
    log, out = tmp_path / "bench.csv", tmp_path / "mapping.toml"
    log.write_text("\n".join(["time,pump_cmd,level", *rows]))
    code, made, err = call("data", "map", str(log), "--out", str(out), "--json")
    assert code == 0
    assert any(remark in each for each in json.loads(made)["notes"])
    assert remark in " ".join(err.split())


def test_a_log_is_mapped_to_the_channels_of_a_twin(bench, call):
    robot = bench.with_name("robot.xml")
    robot.write_text(
        """<mujoco><worldbody><body><joint name="lift" type="slide"/><geom size="1"/></body>
        </worldbody><actuator><motor name="pump" joint="lift"/></actuator>
        <sensor><jointpos name="level" joint="lift"/></sensor></mujoco>"""
    )
    words = ("data", "map", str(bench), "--out", str(bench.with_name("m.toml")), "--case")
    code, out, err = call(*words, str(robot), "--json")
    assert code == 0, err
    made = json.loads(out)
    assert (made["channels"], made["open"]) == ({"pump_cmd": "pump", "level": "level"}, [])
    assert "rate = 50.0" in bench.with_name("m.toml").read_text("utf-8")
    code, _, err = call(*words, str(robot.with_name("other.xml")))
    assert code == 2
    assert "no file of that name" in err


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("mapping.csv", "expected a name that ends in .toml"),
        ("bench.csv/m.toml", "expected a place that can be written"),
    ],
)
def test_a_mapping_is_written_to_a_good_place_or_not_at_all(name, message, bench, call):
    before = sorted(bench.parent.iterdir())
    code, out, err = call("data", "map", str(bench), "--out", str(bench.parent / name))
    assert (code, out) == (2, "")
    assert message in err
    assert sorted(bench.parent.iterdir()) == before
