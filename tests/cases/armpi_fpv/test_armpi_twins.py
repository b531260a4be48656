"""The MuJoCo arm beside its kinematics and its URDF, and the arm that stands in for the real."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

import retwin as rt
from retwin.cases.armpi_fpv.emulator import EmulatedArmPi
from retwin.cases.armpi_fpv.twin import ARM, KINEMATIC, MODEL, ArmPiTwin

DATA = Path(os.environ.get("RETWIN_DATA", "")) / "armpi"
needs_data = pytest.mark.skipif(not os.environ.get("RETWIN_DATA"), reason="RETWIN_DATA is not set")


@pytest.fixture(scope="module")
def commands(case: rt.Case) -> np.ndarray:
    return case.sampler.sample(8, rng=np.random.default_rng(3))


def rms(difference: np.ndarray) -> np.ndarray:
    return np.sqrt(np.square(difference, dtype=float).mean(axis=(0, 1)))


def test_the_model_has_the_arms_kinematics(commands: np.ndarray) -> None:
    hidden: dict[str, np.ndarray] = {}
    made = ArmPiTwin().simulate(commands, seed=0, hidden=hidden)
    assert hidden["positions"].shape == (8, 1000, 5)
    expected = ARM.position(hidden["positions"][..., :4])
    np.testing.assert_allclose(made.observed, expected, atol=1e-6)
    # Joint 5 rolls about the last link: it is held, and would not move the end-effector.
    assert np.abs(hidden["positions"][..., 4]).max() < 1e-3
    np.testing.assert_array_equal(made.nominal, KINEMATIC.position(commands))


def test_the_model_follows_as_the_closed_form_does(commands: np.ndarray) -> None:
    made = ArmPiTwin().simulate(commands, seed=0)
    closed = KINEMATIC.simulate(commands, seed=0)
    assert (rms(made.observed - closed.observed) < 4e-4).all()


@pytest.mark.parametrize("step", [0.001, 0.002, 0.01])
def test_steps_agree(commands: np.ndarray, step: float) -> None:
    fine = ArmPiTwin().simulate(commands, seed=0)
    other = ArmPiTwin(step=step).simulate(commands, seed=0)
    assert (rms(fine.observed - other.observed) < 1e-4).all()


@needs_data
@pytest.mark.real_data
def test_the_model_has_the_masses_of_the_urdf() -> None:
    spec = mujoco.MjSpec.from_file(str(DATA / "armpi_fpv.urdf"))
    for each in (*spec.geoms, *spec.meshes, *spec.equalities):
        spec.delete(each)
    # The gripper's links hang on joints of their own, which the model does not have.
    for joint in list(spec.joints):
        if not joint.name.startswith("joint"):
            spec.delete(joint)
    robot, model = spec.compile(), mujoco.MjModel.from_xml_path(str(MODEL))
    holding = []
    for each in (robot, model):
        data = mujoco.MjData(each)
        data.qpos[:] = [0.4, -0.3, 0.7, 0.5, 0.2]
        mujoco.mj_forward(each, data)
        holding.append(data.qfrc_bias.copy())
    base = model.body("link_1").id
    assert robot.body_subtreemass[1] == pytest.approx(model.body_subtreemass[base], rel=1e-9)
    # The torque that holds the arm against gravity depends on the masses and their positions.
    np.testing.assert_allclose(holding[0], holding[1], atol=1e-6)


@needs_data
@pytest.mark.real_data
def test_the_model_follows_as_the_published_twin_does() -> None:
    """At most 0.5 mm RMS per axis; benchmarks/twins.py takes all 400."""
    case = rt.cases.armpi()
    published = rt.load(DATA / "sim.mat", rate=100.0).with_label("Healthy")[:12]
    published = case.complete(published)
    made = case.twin.simulate(published.commands, seed=0)
    assert (rms(made.observed - published.observed) <= 5e-4).all()


def test_the_emulated_arm_tells_what_went_wrong(commands: np.ndarray) -> None:
    hidden: dict[str, np.ndarray] = {}
    made = EmulatedArmPi().simulate(commands, seed=5, hidden=hidden)
    assert made.emulated
    movements = rt.Segments.from_commands(commands).start.shape
    assert hidden["delay"].shape == movements
    assert hidden["offset"].shape == hidden["missed"].shape == (*movements, 4)
    assert hidden["angles"].shape == (8, 1000, 4)
    assert (hidden["delay"] > 0).all()
    # Readings are rounded and joined linearly: away from glitches within a unit of the joints.
    error = np.linalg.norm(made.observed - KINEMATIC.position(hidden["angles"]), axis=2)
    assert np.median(error[:, ::10]) < 1e-3


PERFECT = EmulatedArmPi(
    delay=0.0, jitter=0.0, offset=0.0, bias=0.0, missed=0.0, dead_zone=0.0, backlash=0.0,
    sensor_rate=100.0, noise=0.0, resolution=0.0, glitch=0.0,
)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sensor_rate", 0.0),
        ("sensor_rate", 30.0),
        ("missed", 1.1),
        ("jitter", -1.0),
        ("noise", float("nan")),
    ],
)
def test_effects_that_cannot_be_are_refused(name: str, value: float) -> None:
    with pytest.raises(rt.InputError, match=f"^{name}: expected .*, got {value}\\b"):
        EmulatedArmPi(**{name: value})


def test_without_any_effect_it_is_the_plain_arm(commands: np.ndarray) -> None:
    made = PERFECT.simulate(commands, seed=0)
    plain = ArmPiTwin().simulate(commands, seed=0)
    np.testing.assert_allclose(made.observed, plain.observed, atol=2e-6)


def test_every_effect_does_what_it_says(commands: np.ndarray) -> None:
    held: dict[str, np.ndarray] = {}
    PERFECT.simulate(commands, seed=0, hidden=held)
    plain = held["angles"]

    def angles(**effect: float) -> np.ndarray:
        found: dict[str, np.ndarray] = {}
        replace(PERFECT, **effect).simulate(commands, seed=0, hidden=found)
        return found["angles"]

    delayed = angles(delay=0.04, jitter=1e-8)
    np.testing.assert_allclose(delayed[:, 4:], plain[:, :-4], atol=0.5)
    steady = np.abs(angles(dead_zone=2.0) - plain)[:, 190]
    assert steady.max() == pytest.approx(2.0, abs=0.05)
    play = np.abs(angles(backlash=3.0) - plain)
    assert play.max() <= 1.5 + 1e-9
    assert play[:, 190].max() == pytest.approx(1.5, abs=0.05)
    offset = (angles(offset=2.0) - plain)[:, 190::200]
    assert 1.0 < np.sqrt(np.mean(offset**2)) < 4.0
    bias = (angles(bias=2.0) - plain)[:, 190::200]
    np.testing.assert_allclose(bias.std(axis=1), 0, atol=0.05)
    assert bias.std() > 1.0
    missed: dict[str, np.ndarray] = {}
    replace(PERFECT, missed=1.0).simulate(commands, seed=0, hidden=missed)
    assert missed["missed"].all()
    assert np.abs(missed["angles"] - 500).max() < 0.5


def test_readings_are_polled_rounded_and_spiked(commands: np.ndarray) -> None:
    rounded = replace(PERFECT, sensor_rate=10.0, resolution=1.0).simulate(commands, seed=0)
    yaw = np.arctan2(rounded.observed[:, ::10, 0], -rounded.observed[:, ::10, 1])
    far = np.hypot(rounded.observed[:, ::10, 0], rounded.observed[:, ::10, 1]) > 0.05
    units = np.degrees(yaw[far].astype(float)) / 0.24
    assert np.abs(units - np.round(units)).max() < 0.01
    spiked = replace(PERFECT, sensor_rate=10.0, glitch=1.0).simulate(commands, seed=0)
    clean = replace(PERFECT, sensor_rate=10.0).simulate(commands, seed=0)
    away = np.linalg.norm(spiked.observed - clean.observed, axis=2)[:, ::10] > 1e-4
    assert set(away.sum(axis=1).tolist()) <= {0, 1, 2}
    assert away.sum(axis=1).max() >= 1


def test_a_stuck_joints_readings_stand_still(commands: np.ndarray) -> None:
    """As in the real data, where stuck joints are frozen in software."""
    faults = [rt.Stuck(0)] * len(commands)
    steady = replace(EmulatedArmPi(), glitch=0.0)
    made = steady.simulate(commands, faults=faults, seed=0)
    far = np.hypot(made.observed[..., 0], made.observed[..., 1]) > 0.03
    for path, there in zip(made.observed[:, 60:], far[:, 60:], strict=True):
        yaw = np.unwrap(2 * np.arctan2(path[there, 0], -path[there, 1]).astype(float)) / 2
        assert np.ptp(np.round(yaw % np.pi, 4)) < 2e-3


def test_emulated_data_say_so(case: rt.Case, emulated: rt.Trajectories) -> None:
    assert emulated.emulated
    assert not rt.generate(case.twin, case, per_class=1, seed=0).emulated


@needs_data
@pytest.mark.real_data
@pytest.mark.slow
def test_the_emulated_arm_errs_as_the_real_one(tmp_path: Path) -> None:
    """All figures of benchmarks/emulation.py lie inside the intervals of the real ones."""
    benchmark = Path(__file__).parents[3] / "benchmarks" / "emulation.py"
    run = [sys.executable, "-W", "error::RuntimeWarning", str(benchmark)]
    results = tmp_path / "results.json"
    environment = {**os.environ, "RETWIN_RESULTS": str(results)}
    done = subprocess.run(run, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = json.loads(results.read_text("utf-8"))["emulation"]["rows"]
    assert len(rows) == 11
    outside = [name for name, row in rows.items() if not row["inside"]]
    assert not outside
