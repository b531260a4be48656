"""`MuJoCoTwin` on models with a known answer, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from test_readme import section

import retwin as rt
from retwin.twins.mujoco.twin import MuJoCoTwin, Servo

PENDULUM = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body name="bob">
      <joint name="hinge" axis="0 1 0" {joint}/>
      <geom type="sphere" size="0.01" pos="0 0 -1" mass="2"/>
      <site name="tip" pos="0 0 -1"/>
    </body>
  </worldbody>
  <actuator>{actuator}</actuator>
  <sensor><jointpos name="angle" joint="hinge"/><jointvel name="speed" joint="hinge"/></sensor>
  <keyframe><key name="raised" qpos="0.1"/><key name="hanging" qpos="0"/></keyframe>
</mujoco>"""
MOTOR = '<motor name="motor" joint="hinge"/>'
SERVO = '<position name="servo" joint="hinge" kp="400" kv="40" ctrlrange="-1 1"/>'


@pytest.fixture
def make(tmp_path: Path):
    def write(actuator: str = MOTOR, joint: str = "", **options: object) -> MuJoCoTwin:
        path = tmp_path / "model.xml"
        path.write_text(PENDULUM.format(actuator=actuator, joint=joint), encoding="utf-8")
        return MuJoCoTwin.from_file(path, **options)

    return write


def test_names_units_and_limits_come_from_the_model(make) -> None:
    twin = make(SERVO, outputs=("angle", "tip", "bob"))
    assert twin.inputs == rt.Channels(("servo",), ("rad",))
    assert twin.outputs.names == ("angle", "tip_x", "tip_y", "tip_z", "bob_x", "bob_y", "bob_z")
    assert twin.outputs.units == ("rad", *("m",) * 6)
    assert twin.limits == rt.Limits((-1.0,), (1.0,))
    assert make().limits is None
    assert make().inputs.units == ("N m",)
    assert make().outputs == rt.Channels(("angle", "speed"), ("rad", "rad/s"))


def test_a_small_swing_has_the_period_of_a_pendulum(make) -> None:
    made = make(keyframe="raised").simulate(np.zeros((1, 400, 1)), seed=0)
    time = np.arange(400) / 100
    # A bob of radius 1 cm at 1 m, amplitude 0.1 rad: period longer than the linear one by 1/1600.
    omega = np.sqrt(9.81 / (1 + 0.4 * 0.01**2)) / (1 + 0.1**2 / 16)
    np.testing.assert_allclose(made.observed[0, :, 0], 0.1 * np.cos(omega * time), atol=2e-4)


def test_a_constant_torque_turns_a_rotor_as_newton_says(make) -> None:
    """Samples are at their times: q = t^2 tau / (2 J), to the integrator's first order."""
    twin = make(joint='damping="0"', keyframe="hanging")
    made = twin.simulate(np.full((1, 20, 1), 0.5), seed=0, parameters={"opt.gravity[2]": 0.0})
    time = np.arange(20) / 100
    expected = 0.5 * 0.5 / (2 * (1 + 0.4 * 0.01**2)) * time**2
    np.testing.assert_allclose(made.observed[0, :, 0], expected, atol=3e-5)
    assert made.observed[0, 0, 0] == 0.0


def test_parameters_differ_from_simulation_to_simulation(make) -> None:
    twin = make(keyframe="raised")
    gravity = np.array([-9.81, -1.62, -3.71])
    made = twin.simulate(np.zeros((3, 100, 1)), seed=0, parameters={"opt.gravity[2]": gravity})
    swung = 0.1 - made.observed[:, 20, 0]
    np.testing.assert_allclose(swung / swung[0], gravity / gravity[0], rtol=0.05)
    alone = twin.simulate(np.zeros((1, 100, 1)), seed=0, parameters={"opt.gravity[2]": -3.71})
    assert alone.observed[0].tobytes() == made.observed[2].tobytes()
    heavy = twin.simulate(
        np.full((2, 50, 1), 1.0), seed=0, parameters={"joint.hinge.damping": [0.0, 50.0]}
    )
    assert abs(heavy.observed[1, -1, 0] - 0.1) < abs(heavy.observed[0, -1, 0] - 0.1) / 2


def test_parameters_of_a_tendon_differ_like_those_of_a_joint(make) -> None:
    """A tendon along one joint, with its stiffness, is a spring of that joint."""
    tendon = '<tendon><fixed name="spring"><joint joint="hinge" coef="1"/></fixed></tendon>'
    model = PENDULUM.format(actuator=MOTOR, joint="")
    path = make().path.with_name("with_a_tendon.xml")
    path.write_text(model.replace("<actuator>", f"{tendon}<actuator>"), encoding="utf-8")
    twin = MuJoCoTwin.from_file(path, keyframe="raised")
    values, free = [3.0, 40.0], np.zeros((2, 100, 1))
    by_tendon, by_joint = (
        twin.simulate(free, seed=0, parameters={f"{place}.stiffness": values}).observed
        for place in ("tendon.spring", "joint.hinge")
    )
    np.testing.assert_allclose(by_tendon, by_joint, atol=1e-4)
    assert not np.allclose(by_tendon[0], by_tendon[1], atol=0.01)
    with pytest.raises(rt.InputError, match=r"tendon\.spring\.nothing"):
        twin.simulate(free, seed=0, parameters={"tendon.spring.nothing": values})


def test_a_servo_starts_at_rest_at_its_first_command(make) -> None:
    twin = make(SERVO)
    made = twin.simulate(np.full((2, 50, 1), [[[0.0]], [[0.5]]]), seed=0)
    assert made.observed[:, 0, 0].tolist() == [0.0, 0.5]
    # It sags under gravity to where 400 N m/rad hold 2 kg at 1 m.
    settled = make(SERVO, settle=3.0).simulate(np.full((1, 50, 1), 0.5), seed=0).observed[0, :, 0]
    assert np.ptp(settled) < 1e-6
    assert settled[0] == pytest.approx(0.5 - 2 * 9.81 * np.sin(settled[0]) / 400, abs=1e-6)


def test_a_velocity_actuator_starts_where_the_model_does(make) -> None:
    """The integral of the control acts, so the command determines no start position."""
    twin = make('<intvelocity name="speed" joint="hinge" kp="400" actrange="-3 3"/>')
    assert twin.inputs.units == ("1",)
    made = twin.simulate(np.full((1, 50, 1), 0.5), seed=0)
    assert made.observed[0, 0, 0] == 0.1
    still = twin.simulate(np.zeros((1, 50, 1)), seed=0)
    assert made.observed[0, 10:, 0].mean() > still.observed[0, 10:, 0].mean()


def test_sensors_without_names_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "model.xml"
    unnamed = PENDULUM.replace('jointpos name="angle"', "jointpos")
    path.write_text(unnamed.format(actuator=f'<motor joint="hinge"/>{MOTOR}', joint=""))
    twin = MuJoCoTwin.from_file(path)
    assert (twin.inputs.names, twin.outputs.names) == (("hinge", "motor"), ("speed",))
    path.write_text(unnamed.format(actuator="", joint=""))
    with pytest.raises(rt.InputError, match=r"a model with actuators, .* --servo JOINT"):
        MuJoCoTwin.from_file(path)


def test_a_tendon_of_joints_has_no_length(tmp_path: Path) -> None:
    path = tmp_path / "model.xml"
    tendon = '<tendon><fixed name="sum"><joint joint="hinge" coef="2"/></fixed></tendon><keyframe>'
    model = PENDULUM.replace("<keyframe>", tendon)
    model = model.replace("<sensor>", '<sensor><tendonpos name="sum" tendon="sum"/>')
    path.write_text(model.format(actuator=MOTOR, joint=""))
    twin = MuJoCoTwin.from_file(path, outputs=["sum"])
    assert twin.outputs.units == ("1",)
    made = twin.simulate(np.zeros((1, 10, 1)), seed=0)
    assert made.observed[0, 0, 0] == pytest.approx(0.2)


def test_a_step_may_be_rounded_in_the_file(make) -> None:
    commands = np.zeros((1, 60, 1))
    rounded = make(keyframe="raised", rate=60.0, step=0.00208333).simulate(commands, seed=0)
    exact = make(keyframe="raised", rate=60.0, step=1 / 480).simulate(commands, seed=0)
    np.testing.assert_allclose(rounded.observed, exact.observed, atol=1e-5)


def test_native_delay_shifts_the_response(make) -> None:
    commands = np.zeros((1, 100, 1))
    commands[0, 20:] = 0.3
    delayed = SERVO.replace("/>", ' nsample="60" interp="linear" delay="0.05"/>')
    now = make(SERVO, interpolate=False).simulate(commands, seed=0).observed[0, :, 0]
    shifted = make(delayed, interpolate=False).simulate(commands, seed=0).observed[0, :, 0]
    np.testing.assert_allclose(shifted[25:], now[20:-5], atol=2e-3)
    # Its history before sample 0 is the first command, not zero.
    held = make(delayed).simulate(np.full((1, 30, 1), 0.5), seed=0).observed[0, :, 0]
    assert np.abs(held - 0.5).max() < 0.05


def test_interpolated_commands_are_ramps_and_held_ones_are_steps(make) -> None:
    ramp = np.linspace(0, 0.5, 60)[None, :, None]
    smooth = make(SERVO).simulate(ramp, seed=0).observed[0]
    steps = make(SERVO, interpolate=False).simulate(ramp, seed=0).observed[0]
    # Held commands are delayed by 4.5 of 10 steps of a sample on average.
    lead = (smooth[50:, 0] - steps[50:, 0]).mean() / (0.5 / 59)
    assert lead == pytest.approx(0.45, abs=0.05)


@pytest.mark.parametrize("onset", [0, 1, 37, 98, 99])
def test_a_stuck_joint_stays_where_it_was_at_the_onset(make, onset: int) -> None:
    commands = 0.8 * np.sin(np.arange(100) / 15)[None, :, None]
    twin = make(SERVO)
    hidden: dict[str, np.ndarray] = {}
    free = twin.simulate(commands, seed=0).observed[0, :, 0]
    made = twin.simulate(commands, faults=[rt.Stuck(0, onset / twin.rate)], seed=0, hidden=hidden)
    stuck = made.observed[0, :, 0]
    np.testing.assert_array_equal(stuck[: onset + 1], free[: onset + 1])
    np.testing.assert_allclose(stuck[onset:], free[onset], atol=1e-5)
    np.testing.assert_allclose(hidden["positions"][0, :, 0], made.observed[0, :, 0], atol=1e-12)
    assert hidden["velocities"].shape == (1, 100, 1)
    np.testing.assert_array_equal(made.nominal[0, :, 0], free)


def test_a_heavy_load_does_not_creep(make) -> None:
    twin = make(joint='armature="1e5"', keyframe="raised")
    made = twin.simulate(np.full((1, 1000, 1), 1e5), faults=[rt.Stuck(0, 0.2)], seed=0)
    assert np.ptp(made.observed[0, 21:, 0]) < 1e-5
    assert made.nominal[0, -1, 0] > 10


def test_onsets_of_a_batch_do_not_disturb_each_other(make) -> None:
    commands = np.tile(0.8 * np.sin(np.arange(80) / 15)[None, :, None], (4, 1, 1))
    twin = make(SERVO)
    faults = [rt.Stuck(0, 0.5), None, rt.Stuck(0, 0.1), rt.Stuck(0, 0.5)]
    together = twin.simulate(commands, faults=faults, seed=0)
    for i, fault in enumerate(faults):
        alone = twin.simulate(commands[:1], faults=[fault], seed=0)
        assert alone.observed[0].tobytes() == together.observed[i].tobytes()


def test_threads_do_not_change_the_result(make) -> None:
    commands = np.random.default_rng(0).normal(size=(40, 50, 1))
    one = make(threads=1).simulate(commands, seed=0)
    two = make(threads=2).simulate(commands, seed=0)
    assert one.observed.tobytes() == two.observed.tobytes()


def test_an_unstable_simulation_ends_alone(
    make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    commands = np.zeros((6, 50, 1))
    commands[3, 20:] = 1e13
    with pytest.raises(rt.SimulationError, match=r"1 of 6 .* trajectory 3: .*CTRL") as caught:
        make().simulate(commands, seed=0)
    assert list(caught.value.failed) == [3]
    assert caught.value.finished.ids.tolist() == ["00000", "00001", "00002", "00004", "00005"]
    with pytest.raises(rt.SimulationError, match=r"2 of 2 .* Inertia matrix"):
        make().simulate(commands[:2], seed=0, parameters={"body.bob.mass": -1.0})
    assert [path.name for path in tmp_path.iterdir()] == ["model.xml"], "MuJoCo left its log"


def test_urdf_gets_servos(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(
        """<robot name="r"><link name="base"/><link name="arm"><inertial><origin xyz="0 0 0.5"/>
        <mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>
        </inertial><collision><geometry><mesh filename="package://gone/arm.stl"/></geometry></collision>
        </link><joint name="hip" type="revolute"><parent link="base"/><child link="arm"/>
        <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="9" velocity="9"/></joint>
        <link name="hand"><inertial><mass value="0.1"/><inertia ixx="0.01" iyy="0.01" izz="0.01"
        ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="wrist" type="revolute">
        <parent link="arm"/><child link="hand"/><origin xyz="0 0 1"/><axis xyz="0 1 0"/>
        <limit lower="-2" upper="2" effort="9" velocity="9"/></joint></robot>""",
        encoding="utf-8",
    )
    path = tmp_path / "arm.urdf"
    servos = (("hip", Servo(500, 40)), ("wrist", Servo(100, 10)))
    twin = MuJoCoTwin.from_file(path, servos=servos, outputs=["hand"], meshes=False)
    assert twin.inputs == rt.Channels(("hip", "wrist"), ("rad", "rad"))
    made = twin.simulate(np.full((1, 200, 2), [0.3, 0.0]), seed=0)
    np.testing.assert_allclose(made.observed[0, -1], [np.sin(0.3), 0, np.cos(0.3)], atol=0.02)
    with pytest.raises(rt.InputError, match="meshes=False"):
        MuJoCoTwin.from_file(path, servos=servos, outputs=["hand"])
    with pytest.raises(rt.InputError, match="add servos"):
        MuJoCoTwin.from_file(path, outputs=["hand"], meshes=False)
    with pytest.raises(rt.InputError, match=r"joint:NAME.* body:hand"):
        MuJoCoTwin.from_file(path, servos=servos, meshes=False)
    with pytest.raises(rt.InputError, match=r"servos: .* got 'hips'; did you mean 'hip'\?"):
        MuJoCoTwin.from_file(path, servos=[("hips", Servo(1, 1))], meshes=False)


def test_joints_sites_and_bodies_are_outputs_by_name(make) -> None:
    """Also velocities, and joints of models without sensors; names that stand for several."""
    names = ("joint:hinge", "joint_velocity:hinge", "site:tip", "site_velocity:tip", "body:bob")
    twin = make(outputs=(*names, "hinge"), keyframe="raised")
    assert twin.outputs.names[:3] == ("joint:hinge", "joint_velocity:hinge", "site:tip_x")
    assert twin.outputs.units == ("rad", "rad/s", *("m",) * 3, *("m/s",) * 3, *("m",) * 3, "rad")
    made = twin.simulate(np.zeros((1, 100, 1)), seed=0).observed[0]
    angle, speed, tip, swing = made[:, 0], made[:, 1], made[:, 2:5], made[:, 5:8]
    own = make(keyframe="raised").simulate(np.zeros((1, 100, 1)), seed=0).observed[0]
    np.testing.assert_array_equal(made[:, [0, 1]], own)
    np.testing.assert_array_equal(made[:, -1], angle)
    np.testing.assert_allclose(tip[:, 0], -np.sin(angle), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(swing, axis=1), np.abs(speed), atol=1e-9)
    for bad, meant in [
        ("joint:hing", "joint:hinge"),
        ("hip:tip", "site:tip"),
        ("tipp", "site:tip"),
    ]:
        with pytest.raises(rt.InputError, match=f"outputs: .* did you mean '{meant}'"):
            make(outputs=(bad,))


def test_joints_of_other_kinds(tmp_path: Path) -> None:
    balls = PENDULUM.format(actuator=MOTOR, joint="").replace(
        '<body name="bob">',
        '<body name="top"><joint name="{}" type="{}"/><geom size=".1"/></body><body name="bob">',
    )
    path = tmp_path / "balls.xml"
    path.write_text(re.sub("<keyframe>.*</keyframe>", "", balls.format("ball", "ball")))
    twin = MuJoCoTwin.from_file(path, outputs=["joint:ball", "joint_velocity:ball"])
    assert twin.outputs.names == tuple(
        [f"joint:ball_{part}" for part in "wxyz"]
        + [f"joint_velocity:ball_{part}" for part in "xyz"]
    )
    path.write_text(re.sub("<keyframe>.*</keyframe>", "", balls.format("loose", "free")))
    with pytest.raises(rt.InputError, match=r"no free joint, got 'joint:loose'; .* body:top"):
        MuJoCoTwin.from_file(path, outputs=["joint:loose"])


def test_actuators_without_names_have_those_of_their_joints(make) -> None:
    nameless = (
        '<motor joint="hinge"/><velocity joint="hinge" kv="1"/><motor name="m" joint="hinge"/>'
    )
    twin = make(nameless)
    assert twin.inputs.names == ("hinge", "hinge_2", "m")
    assert make(nameless, inputs=("hinge_2",)).simulate(np.ones((1, 9, 1)), seed=0).observed.any()


def test_what_is_refused(make, tmp_path: Path) -> None:
    with pytest.raises(rt.InputError, match=r"inputs: .* motor, got 'moter'; did you mean 'motor'"):
        make(inputs=("moter",))
    with pytest.raises(rt.InputError, match=r"outputs: .* got 'speeed'"):
        make(outputs=("speeed",))
    with pytest.raises(rt.InputError, match=r"keyframe: .* raised, hanging"):
        make(keyframe="standing")
    with pytest.raises(rt.InputError, match="divides the sample period"):
        make(rate=333.0)
    for name, bad in [("rate", 0.0), ("step", -0.001), ("settle", np.nan), ("threads", -1)]:
        with pytest.raises(rt.InputError, match=f"^{name}: expected .*, got {bad}"):
            make(**{name: bad})
    with pytest.raises(rt.InputError, match="where there is none"):
        MuJoCoTwin.from_file(tmp_path / "gone.xml")
    (tmp_path / "bad.xml").write_text("<mujoco><worldbody><geom size='a'/></worldbody></mujoco>")
    with pytest.raises(rt.InputError, match="bad format in attribute 'size'"):
        MuJoCoTwin.from_file(tmp_path / "bad.xml")
    beyond = np.full((1, 20, 1), 1.5)
    with pytest.raises(rt.InputError, match=r"servo from -1 to 1 rad, got 1.5"):
        make(SERVO).simulate(beyond, seed=0)
    clipped = make(SERVO, outside="clip").simulate(beyond, seed=0)
    assert clipped.commands.max() == 1.0
    twin = make()
    for bad in ({"opt.gravty": 1}, {"joint.knee.damping": 1}, {"joint.hinge": 1}):
        with pytest.raises(rt.InputError, match=r'parameters: expected "KIND.NAME.FIELD'):
            twin.simulate(np.zeros((1, 20, 1)), seed=0, parameters=bad)
    with pytest.raises(rt.InputError, match=r"'opt\.timestep', which they share"):
        twin.simulate(np.zeros((1, 20, 1)), seed=0, parameters={"opt.timestep": 0.002})
    for bad, got in (([1, 2], r"shape \(2,\)"), (np.ones(200), "shape"), ("high", "'high'")):
        with pytest.raises(rt.InputError, match=f"got joint.hinge.damping: .*{got}"):
            twin.simulate(np.zeros((128, 20, 1)), seed=0, parameters={"joint.hinge.damping": bad})
    for bad, got in (
        (lambda commands: commands, r"got float64, \(2, 20, 1\)"),
        (lambda commands: np.full((2, 20, 2), np.nan), "got NaN"),
    ):
        with pytest.raises(rt.InputError, match=rf"nominal: .* shape \(2, 20, 2\), {got}"):
            make(nominal=bad).simulate(np.zeros((2, 20, 1)), seed=0)
    runge = PENDULUM.replace("implicitfast", "RK4").format(actuator=MOTOR, joint="")
    (tmp_path / "runge.xml").write_text(runge, encoding="utf-8")
    with pytest.raises(rt.InputError, match="implicit integrator"):
        MuJoCoTwin.from_file(tmp_path / "runge.xml").simulate(
            np.zeros((1, 60, 1)), faults=[rt.Stuck(0)], seed=0
        )


def test_the_how_to_is_true(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tests = Path(__file__).parents[1]
    page = section("twins", "MuJoCo")
    (tmp_path / "crane.xml").write_text((tests / "testing" / "crane.xml").read_text("utf-8"))
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.M | re.S)
    names: dict[str, object] = {}
    for code in blocks:
        exec(compile(code, "docs/twins.md", "exec"), names)
    printed = re.findall(r"  # prints (.*)", page)
    assert printed
    assert capsys.readouterr().out.splitlines() == printed
    swing = np.ptp(names["made"].observed[:, 60:, 0], axis=1)
    assert len(set(swing.round(4))) == 4, "the loads give different motions"
