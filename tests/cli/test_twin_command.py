"""`retwin twin` and the names of twins: every kind is found, bad input is one line."""

from __future__ import annotations

import json
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fmus import c_fmu, described

import retwin as rt
from retwin import twins
from retwin.catalog import TWINS
from retwin.cli import main
from retwin.serialisation.files import sha256
from retwin.twins.function import FunctionTwin

PENDULUM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="hinge" axis="0 1 0" damping="0.5"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
      <site name="tip" pos="0 0 -0.5"/>
    </body>
  </worldbody>
  <actuator><position name="push" joint="hinge" kp="20" ctrlrange="-1 1"/></actuator>
</mujoco>
"""

MODULE = """
import numpy as np
import retwin as rt
from retwin.twins.function import FunctionTwin
from retwin.twins.twin import simulate_in_chunks

CHANNELS = rt.Channels(("u",), ("V",))


def double(commands):
    return 2 * commands


def flat(commands):
    return commands[:, :, 0]


def holes(commands):
    return commands * np.nan


def raises(commands):
    return np.linalg.inv(commands[0, :1, :1] * 0)  # the line that is named


def shouts(commands):
    raise KeyError("no [such]\\n  valve")


LIMITED = FunctionTwin(double, CHANNELS, CHANNELS, 50.0, limits=rt.Limits((0.0,), (10.0,)))


def make():
    return LIMITED


def other():
    return 3


class Fragile:
    inputs = outputs = CHANNELS
    rate = 50.0
    limits = rt.Limits((0.0,), (10.0,))

    def simulate(self, commands, *, faults=None, seed, progress=None):
        def run(chunk):
            for i in np.flatnonzero(chunk.commands[:, -1, 0] > 8):
                chunk.failed[int(i)] = "melted"
            return chunk.commands, chunk.commands

        return simulate_in_chunks(self, run, commands, faults, seed=seed, progress=progress)
"""


@pytest.fixture
def call(call):
    """Run `retwin twin …` in this process; exit code, stdout, stderr."""
    return lambda *words: call("twin", *words)


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a module of the user's, which can be imported."""
    (tmp_path / "my_twins.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_twins", raising=False)
    return "my_twins"


@pytest.fixture
def pendulum(tmp_path: Path) -> Path:
    (tmp_path / "pendulum.xml").write_text(PENDULUM)
    return tmp_path / "pendulum.xml"


def refused(call, match: str, *words: object) -> None:
    """One line on stderr, exit code 2, and nothing in the folder of the outputs."""
    code, _, err = call(*words)
    assert code == 2, err
    assert re.search(match, err), err
    assert len(err.splitlines()) == 1


# --- names ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in TWINS if "armpi" in name])
def test_built_in_twins_fit_the_arms_case(name: str, case: rt.Case) -> None:
    found = twins.get(name)
    assert isinstance(found, rt.Twin)
    assert (found.inputs, found.outputs, found.rate) == (case.inputs, case.outputs, case.rate)


def test_twins_of_a_users_module(mine: str) -> None:
    for name in ("LIMITED", "make"):
        found = twins.get(f"{mine}:{name}")
        assert isinstance(found, FunctionTwin)
        assert found.rate == 50.0
    assert type(twins.get(f"{mine}:Fragile")).__name__ == "Fragile"
    double = twins.get(f"{mine}:double", inputs=["u"], outputs=["y"], rate=20.0)
    made = double.simulate(np.ones((2, 5, 1)), seed=0)
    np.testing.assert_array_equal(made.observed, np.full((2, 5, 1), 2.0))
    assert double.outputs == rt.Channels(("y",), ("1",))


def test_a_mujoco_file(pendulum: Path) -> None:
    found = twins.get(str(pendulum), outputs=["tip"], rate=50.0, outside="clip")
    assert found.inputs.names == ("push",)
    assert len(found.outputs) == 3
    assert found.rate == 50.0
    assert getattr(found, "limits", None) == rt.Limits((-1.0,), (1.0,), "clip")


@pytest.mark.slow
def test_a_module_in_the_current_folder(mine: str, tmp_path: Path) -> None:
    """By the command that is installed, which Python runs without the current folder."""
    command = [Path(sys.executable).with_name("retwin"), "twin", "simulate", f"{mine}:LIMITED"]
    more = ["--n", "6", "--duration", "4", "--chunk", "2", "--workers", "2", "--out", "a.zarr"]
    done = subprocess.run([*command, *more], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for name in ("numpy", "zarr"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('not the real one')")
    done = subprocess.run([*command, *more], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_table_of_channels_has_an_end(call, mine: str, tmp_path: Path) -> None:
    names = ",".join(f"u{i}" for i in range(300))
    words = ("info", f"{mine}:double", "--rate", 9, "--inputs", names, "--outputs", "y")
    code, out, _ = call(*words)
    assert code == 0
    assert "… and 201 more channels, which --json lists" in out
    assert sum(line.startswith("input") for line in out.splitlines()) < 110
    assert len(json.loads(call(*words, "--json")[1])["inputs"]) == 300


def test_an_fmu_without_inputs_simulates(call, tmp_path: Path) -> None:
    alone = described(c_fmu(tmp_path), "alone", 'causality="input"', 'causality="local"')
    out = tmp_path / "a.npz"
    options = ("--n", 2, "--outputs", "sums", "--duration", 10, "--out", out)
    code, _, err = call("simulate", alone, *options)
    assert code == 0, err
    assert rt.load(out).observed.shape == (2, 1000, 2)


def test_the_options_of_a_model_file(call, tmp_path: Path) -> None:
    """Those that the messages name."""
    mesh = '<collision><geometry><mesh filename="gone.stl"/></geometry></collision>'
    inertia = '<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/>'
    (tmp_path / "arm.urdf").write_text(
        f'<robot name="a"><link name="base"/><link name="arm">{mesh}<inertial><mass value="1"/>'
        f'{inertia}</inertial></link><joint name="hip" type="revolute"><parent link="base"/>'
        '<child link="arm"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" '
        'velocity="1"/></joint></robot>'
    )
    file = tmp_path / "arm.urdf"
    refused(call, "--no-meshes", "info", file)
    words = ("info", file, "--no-meshes", "--outputs", "joint:hip")
    refused(call, "--servo JOINT=STIFFNESS,DAMPING", *words)
    refused(call, "--servo: expected", "info", file, "--no-meshes", "--servo", "hip")
    words = ("info", file, "--no-meshes", "--servo", "hip=500,40")
    refused(call, "joint:NAME.* joint:hip, body:arm", *words)
    code, out, _ = call(*words, "--outputs", "joint:hip,body:arm")
    assert code == 0
    assert "joint:hip" in out
    refused(call, "options of another kind|no such options", "info", "armpi", "--no-meshes")


QUITTER = """
import sys


def quits(commands):
    if len(commands) < 99:
        sys.exit(0)
    return commands
"""
QUITTING = """
name = "quitter"
twin = "quitter:quits"
rate = 10
[inputs]
u = { low = 0, high = 1 }
[outputs]
y = {}
[commands]
duration = 10
segments = 2
"""


def test_code_that_ends_the_program_is_a_failure(call, tmp_path: Path) -> None:
    (tmp_path / "quitter.py").write_text(QUITTER)
    (tmp_path / "case.toml").write_text(QUITTING)
    code, out, err = call("info", tmp_path / "case.toml")
    assert code == 0
    assert f"runs {tmp_path / 'quitter.py'} with your rights" in out.replace("\n", " ")
    code, _, err = call("simulate", tmp_path / "case.toml", "--out", tmp_path / "a.npz")
    assert code == 1
    assert re.search(r"error: \S+quitter\.py:7: this line ended the program \(SystemExit: 0\)", err)
    (tmp_path / "quitting.py").write_text("raise SystemExit")
    (tmp_path / "case.toml").write_text(QUITTING.replace("quitter:", "quitting:"))
    code, _, err = call("info", tmp_path / "case.toml")
    assert code == 1
    assert "quitting.py:1: this line ended the program" in err


@pytest.mark.parametrize(
    ("match", "name"),
    [
        ("expected armpi, .*package.module:object.*got no such twin", "nonsense"),
        ("got No module named 'nowhere'", "nowhere:twin"),
        ("has no attribute 'none'", "my_twins:none"),
        ("got a int", "my_twins:other"),
        ("got Empty module name", ":twin"),
        ("inputs, outputs and rate, which a function does not have", "my_twins:double"),
        ("no file of that name", "none.fmu"),
        ("no file of that name", "none.xml"),
    ],
)
def test_names_that_are_none(mine: str, match: str, name: str) -> None:
    with pytest.raises(rt.InputError, match=match) as caught:
        twins.get(name)
    assert "\n" not in str(caught.value)


def test_a_twin_has_its_own_channels(mine: str) -> None:
    for name in ("armpi-kinematic", f"{mine}:LIMITED"):
        with pytest.raises(rt.InputError, match="neither channels nor a rate"):
            twins.get(name, rate=10.0)


# --- list and info -------------------------------------------------------------------------------


def test_info_without_a_name_lists_all(call) -> None:
    code, out, _ = call("info")
    assert code == 0
    for name in (*TWINS, "FILE.fmu", "FILE.urdf", "package.module:object", "FOLDER"):
        assert name in out


def test_info_tells_channels_units_limits_and_rate(call, mine: str, pendulum: Path) -> None:
    code, out, _ = call("info", "armpi-kinematic")
    assert code == 0
    assert "the same arm in closed form" in out
    assert re.search(r"input.*motor_4.*0.24 deg.*0 .*1000", out)
    assert re.search(r"output.*z.*m", out)
    assert "100 samples per second" in out
    code, out, _ = call("info", pendulum, "--outputs", "tip", "--rate", 50)
    assert code == 0
    assert "pendulum.xml (MuJoCoTwin): A rigid-body model" in out
    assert re.search(r"push.*-1 .*1", out)
    code, out, _ = call("info", f"{mine}:double", "--inputs", "u", "--outputs", "y", "--rate", 5)
    assert code == 0
    assert "5 samples per second" in out
    refused(call, "got no such twin", "info", "nonsense")


# --- simulate ------------------------------------------------------------------------------------


def test_simulate_to_both_kinds_of_files(call, tmp_path: Path, case: rt.Case) -> None:
    words = ("simulate", "armpi-kinematic", "--seed", 3, "--n", 20, "--fault", "all")
    for name in ("a.npz", "a.zarr"):
        code, _, err = call(*words, "--out", tmp_path / name)
        assert code == 0, err
        assert "Wrote 20 trajectories" in err
    one, other = (rt.load(tmp_path / name, case=case) for name in ("a.npz", "a.zarr"))
    np.testing.assert_array_equal(one.observed, other.observed)
    assert one.labels.tolist() == (3 * list(case.classes))[:20]
    assert call(*words, "--out", tmp_path / "a.zarr")[0] == 0
    refused(call, "another n;", *words, "--n", 21, "--out", tmp_path / "a.zarr")


def test_simulate_one_class_or_none(call, tmp_path: Path) -> None:
    file = tmp_path / "a.npz"
    for fault, label in (("Motor_2_Stuck", "Motor_2_Stuck"), ("none", "Healthy")):
        assert call("simulate", "armpi-kinematic", "--fault", fault, "--out", file)[0] == 0
        assert rt.load(file).labels.tolist() == [label]
    refused(
        call,
        "--fault: expected none, all, Healthy, Motor_1_Stuck.*got Broken",
        *("simulate", "armpi-kinematic", "--fault", "Broken", "--out", tmp_path / "b.npz"),
    )


def test_simulate_commands_from_a_file(call, tmp_path: Path, twin_set: rt.Trajectories) -> None:
    rt.save(twin_set[:4], tmp_path / "given.npz")
    code, _, err = call(
        *("simulate", "armpi-kinematic", "--commands", tmp_path / "given.npz"),
        *("--out", tmp_path / "a.npz"),
    )
    assert code == 0, err
    assert "Wrote 4 trajectories" in err
    np.testing.assert_array_equal(rt.load(tmp_path / "a.npz").commands, twin_set[:4].commands)


def test_simulate_a_twin_without_a_case(call, mine: str, pendulum: Path, tmp_path: Path) -> None:
    file = tmp_path / "a.npz"
    for twin in (f"{mine}:LIMITED", pendulum):
        more = ("--outputs", "tip") if twin == pendulum else ()
        words = ("simulate", twin, *more, "--n", 3, "--out", file)
        code, _, err = call(*words, "--duration", 8)
        assert code == 0, err
        made = rt.load(file)
        assert np.ptp(made.commands, axis=1).min() > 0
        assert made.steps == 8 * made.rate
    refused(call, "--duration: expected the duration of a trajectory in seconds", *words)
    function = ("simulate", f"{mine}:double", "--inputs=u", "--outputs=y", "--rate=50", "--n=3")
    refused(call, "not all inputs have limits", *function, "--out", tmp_path / "b.npz")
    refused(
        call,
        "--fault: expected none, got all; give --case",
        *("simulate", f"{mine}:LIMITED", "--fault", "all", "--out", tmp_path / "b.npz"),
    )
    assert not (tmp_path / "b.npz").exists()


def test_simulate_saved_models(
    call, tmp_path: Path, updated: rt.CorrectedTwin, case: rt.Case
) -> None:
    updated.save(tmp_path / "model")
    updated.surrogate.save(tmp_path / "ibg")
    words = ("--fault", "all", "--out", tmp_path / "a.npz")
    code, _, err = call("simulate", tmp_path / "model", *words)
    assert code == 0, err
    assert rt.load(tmp_path / "a.npz", case=case).labels.tolist() == list(case.classes)
    code, _, err = call("simulate", tmp_path / "ibg", *words, "--case", "armpi", "--workers", 1)
    assert code == 2, "workers are for Zarr"
    code, _, err = call("simulate", tmp_path / "ibg", *words, "--case", "armpi")
    assert code == 0, err
    refused(
        call,
        "not all inputs have limits",
        "simulate",
        tmp_path / "ibg",
        "--out",
        tmp_path / "b.npz",
    )
    (tmp_path / "ibg" / "model.json").write_text("{")
    refused(call, "a corrected model", "simulate", tmp_path / "ibg", "--out", tmp_path / "b.npz")


def test_failed_trajectories_are_named_and_the_others_written(
    call, mine: str, tmp_path: Path
) -> None:
    file = tmp_path / "a.npz"
    words = ("simulate", f"{mine}:Fragile", "--duration", 8, "--n", 40, "--out", file)
    code, _, err = call(*words)
    assert code == 1
    made = rt.load(file)
    assert 20 < len(made) < 40
    assert made.commands[:, -1].max() <= 8
    assert f"Wrote {len(made)} trajectories" in err
    assert re.search(rf"{40 - len(made)} of 40 simulations failed: trajectory \d+: melted", err)


def test_bad_input_is_one_line_and_leaves_nothing(
    call, mine: str, tmp_path: Path, twin_set: rt.Trajectories
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    rt.save(twin_set[:2].replace(commands=twin_set.commands[:2] + 600), tmp_path / "far.npz")
    far = ("simulate", "armpi-kinematic", "--commands", tmp_path / "far.npz")
    refused(call, "from 0 to 1000", *far, "--out", out / "a.zarr")
    refused(call, r"\.npz or \.zarr", "simulate", "armpi-kinematic", "--out", out / "a.csv")
    narrow = ("--commands", tmp_path / "far.npz", "--out", out / "a.zarr")
    refused(call, "inputs of the twin|that of the twin", "simulate", f"{mine}:LIMITED", *narrow)
    for function, match in (("flat", "to return numbers of shape"), ("holes", "finite numbers")):
        words = (f"{mine}:{function}", "--inputs=u", "--outputs=y", "--rate=50")
        rt.save(twins.get(f"{mine}:LIMITED").simulate(np.ones((3, 9, 1)), seed=0), out / "u.npz")
        for name in ("a.zarr", "a.npz"):
            given = rt.load(out / "u.npz").replace(inputs=None)
            rt.save(given, tmp_path / "given.npz")
            given = ("--commands", tmp_path / "given.npz", "--out", out / name)
            refused(call, match, "simulate", *words, *given)
        (out / "u.npz").unlink()
    refused(
        call,
        "for more than 512 MB",
        *("simulate", "armpi-kinematic", "--n", 10**6, "--out", out / "a.npz"),
    )
    refused(
        call,
        r"--case\.inputs: expected that of the twin, u \[",
        *("simulate", f"{mine}:LIMITED", "--case", "armpi", "--out", out / "a.npz"),
    )
    words = ("simulate", "armpi-kinematic", "--duration", 8, "--out", out / "a.npz")
    refused(call, "--duration: expected none with commands of a case", *words)
    assert not list(out.iterdir())
    code, _, err = call(*far, "--clip", "--out", out / "a.zarr")
    assert code == 0, err
    assert rt.load(out / "a.zarr").commands.max() == 1000


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "match"),
    [
        ("raises", r"error: LinAlgError: Singular matrix \(.*my_twins\.py:(\d+), in traj"),
        ("shouts", r"error: KeyError: 'no \[such\].*valve' \(.*:(\d+), in traj.* \d to \d\)"),
    ],
)
@pytest.mark.parametrize("workers", [0, 1, 2])
def test_what_a_function_raises_is_one_line(
    call,
    mine: str,
    tmp_path: Path,
    function: str,
    match: str,
    workers: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = twins.get(f"{mine}:LIMITED").simulate(np.ones((4, 9, 1)), seed=0)
    rt.save(made.replace(inputs=None), tmp_path / "given.npz")
    out = ("--out", tmp_path / "a.zarr", "--workers", workers)
    words = (
        *("simulate", f"{mine}:{function}", "--inputs=u", "--outputs=y", "--rate=50"),
        *("--commands", tmp_path / "given.npz", "--chunk", 2),
        *(out if workers else ("--out", tmp_path / "a.npz")),
    )
    code, _, err = call(*words)
    assert code == 1
    (message,) = err.splitlines()
    found = re.match(match, message)
    assert found, message
    line = MODULE.replace("\\\\", "\\").splitlines()[int(found[1]) - 1]
    assert "linalg" in line or "KeyError" in line
    if workers < 2:
        monkeypatch.setenv("RETWIN_TRACEBACK", "1")
        monkeypatch.setattr(sys, "argv", ["retwin", "twin", *map(str, words)])
        with pytest.raises((KeyError, np.linalg.LinAlgError)):
            main()


@pytest.mark.parametrize(
    ("match", "words"),
    [
        ("Invalid value for '--rate': .*; see `retwin twin simulate --help`", ["--rate", "nan"]),
        ("No such option: --nonsense", ["--nonsense"]),
        ("Invalid value for '--chunk'", ["--chunk", "many"]),
    ],
)
def test_words_that_are_no_command_are_one_line(
    call, match: str, words: list[str], tmp_path: Path
) -> None:
    refused(call, match, "simulate", "armpi-kinematic", "--out", tmp_path / "a.npz", *words)
    refused(call, "Missing argument 'TWIN'", "simulate")
    code, out, err = call()
    assert (code, err) == (2, "")
    assert "Usage" in out


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_says_how_to_go_on(
    call, start, tmp_path: Path, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["simulate", "armpi-kinematic", "--n", "600", "--chunk", "4", "--workers", "1"]
    done = tmp_path / "a.zarr.part" / "done"
    running = start("twin", *words, "--out", tmp_path / "a.zarr")
    line = running.interrupt(lambda: done.exists() and any(done.glob("[0-9]*")), number)
    match = re.search(r"interrupted; give the same command again to go on: retwin twin (.*)", line)
    assert match, line
    finished = len(list(done.glob("[0-9]*")))
    assert 0 < finished < 150
    monkeypatch.setattr("retwin.cli.terminal.LOG_DELAY", 0.0)
    code, _, err = call(*shlex.split(match[1]))
    assert code == 0
    assert f"simulate: {4 * finished} of 600" in err, "begun anew"
    assert "Wrote 600 trajectories" in err
    assert call(*words, "--out", tmp_path / "b.zarr")[0] == 0
    assert sha256(tmp_path / "a.zarr") == sha256(tmp_path / "b.zarr")


def test_what_has_no_meaning_is_refused_before_the_work(call, tmp_path: Path) -> None:
    film = ("--film", tmp_path / "arm.gif")
    refused(call, "give --out FILE", "simulate", "armpi-kinematic", *film)
    refused(
        call,
        "--fps: expected none without --film",
        "simulate",
        "armpi",
        "--fps",
        5,
        "--out",
        "a.npz",
    )
    words = ("simulate", "armpi", "--commands", "no.npz", *film)
    refused(call, "--clip: expected none without --out", *words, "--clip")
