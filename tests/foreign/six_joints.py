"""A six-joint arm of the kind of a UR, and recordings of one that differs from its model.

The user has the model, its case and the recordings. The recorded arm carries a load, has friction,
follows its commands late by a time that differs between segments, and stops beside its targets.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

RATE, DURATION, SEGMENTS = 25, 8.0, 4
STEPS = int(RATE * DURATION)
ONSET = 1.0
"""Time in s from which a stuck joint is held."""
JOINTS = ("pan", "lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
LOW = (-0.6, -1.7, 0.7, -1.5, -1.6, -0.6)
HIGH = (0.6, -0.7, 1.7, -0.5, -0.6, 0.6)
STUCK = {f"{name}_stuck": ("stuck", k) for k, name in enumerate(JOINTS)}
BIASED = {f"{name}_bias": ("bias", k) for k, name in enumerate(JOINTS[:3])}
FAULTS = STUCK | BIASED

MODEL = """
<mujoco model="six">
  <compiler angle="radian"/>
  <option timestep="{step}" integrator="implicitfast"/>
  <default><joint armature="0.5" damping="2" frictionloss="{friction}"/></default>
  <worldbody>
    <body name="base" pos="0 0 0.09" gravcomp="1">
      <inertial mass="3.5" pos="0 0 0" diaginertia="0.01 0.01 0.007"/>
      <joint name="pan" axis="0 0 1"/>
      <body name="upper" pos="0 0.13 0" gravcomp="1">
        <inertial mass="8" pos="0.2 0 0" diaginertia="0.02 0.12 0.12"/>
        <joint name="lift" axis="0 1 0"/>
        <body name="fore" pos="0.42 -0.11 0" gravcomp="1">
          <inertial mass="2.3" pos="0.2 0 0" diaginertia="0.004 0.03 0.03"/>
          <joint name="elbow" axis="0 1 0"/>
          <body name="hand_1" pos="0.39 0 0" gravcomp="1">
            <inertial mass="1.2" pos="0 0.09 0" diaginertia="0.003 0.003 0.002"/>
            <joint name="wrist_1" axis="0 1 0"/>
            <body name="hand_2" pos="0 0.09 0" gravcomp="1">
              <inertial mass="1.2" pos="0 0 -0.09" diaginertia="0.003 0.003 0.002"/>
              <joint name="wrist_2" axis="0 0 1"/>
              <body name="hand_3" pos="0 0 -0.095" gravcomp="1">
                <inertial mass="0.2" pos="0 0.05 0" diaginertia="0.0002 0.0002 0.0002"/>
                <joint name="wrist_3" axis="0 1 0"/>
                <site name="tool" pos="0.08 0.12 0.06"/>
                {load}
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    {actuators}
  </actuator>
</mujoco>
"""
LOAD = (
    """<body pos="0 0.1 0"><inertial mass="1.5" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/></body>"""
)

MODULE = '''"""Where the tool of the ideal arm is, which follows its commands at once."""

import numpy as np

AXES = (2, 1, 1, 1, 2, 1)  # z or y
LINKS = ((0, 0.13, 0), (0.42, -0.11, 0), (0.39, 0, 0), (0, 0.09, 0), (0, 0, -0.095))
TOOL = (0.08, 0.12, 0.06)


def turned(points, angle, axis):
    """Points (..., 3) turned about z or y."""
    x, y, z = np.moveaxis(points, -1, 0)
    c, s = np.cos(angle), np.sin(angle)
    new = (c * x - s * y, s * x + c * y, z) if axis == 2 else (c * x + s * z, y, c * z - s * x)
    return np.stack(new, axis=-1)


def outputs(commands):
    """The elbow's angle and the tool's position (n, T, 4) for angles (n, T, 6)."""
    angles = np.asarray(commands, dtype=float)
    point = np.broadcast_to(np.array(TOOL), (*angles.shape[:2], 3))
    for k in reversed(range(6)):
        point = turned(point, angles[..., k], AXES[k])
        point = point + np.array(LINKS[k - 1] if k else (0, 0, 0.09))
    return np.concatenate([angles[..., 2:3], point], axis=-1)
'''

CASE = """
name = "six"
title = "An arm of six joints"
rate = {rate}
correction = "command_space"
outputs = ["joint:elbow", "site:tool"]
network = {{ kind = "MLP", hidden = [128, 128] }}
training = {{ max_epochs = 30, batch_size = 512, learning_rate = 5e-3 }}

[twin]
name = "six.xml"
nominal = "six_kinematics:outputs"

[commands]
duration = {duration}
segments = {segments}
low = {low}
high = {high}

[faults]
{faults}
"""


def model(*, friction: float = 0.0, load: str = "", step: float = 0.01) -> str:
    """The MJCF of the arm."""
    actuators = "\n    ".join(
        f'<position name="{name}" joint="{name}" kp="2000" dampratio="1" ctrlrange="-3.2 3.2"/>'
        for name in JOINTS
    )
    return MODEL.format(friction=friction, load=load, step=step, actuators=actuators)


def write_case(folder: Path) -> Path:
    """The files that the user has of the arm, and the name of the case."""
    faults = {
        "stuck": f'kind = "Stuck", onset = {ONSET}',
        "bias": 'kind = "ActuatorBias", size = [0.15, 0.3]',
    }
    lines = [
        f'{label} = {{ {faults[kind]}, actuator = "{JOINTS[k]}" }}'
        for label, (kind, k) in FAULTS.items()
    ]
    settings = {"rate": RATE, "duration": DURATION, "segments": SEGMENTS}
    limits = {"low": list(LOW), "high": list(HIGH)}
    (folder / "six.xml").write_text(model())
    (folder / "six_kinematics.py").write_text(MODULE)
    (folder / "six.toml").write_text(CASE.format(**settings, **limits, faults="\n".join(lines)))
    return folder / "six.toml"


# --- the recorded arm, which the user does not see into ------------------------------------------


def record(count: int, label: str, seed: int) -> list[tuple[NDArray, NDArray]]:
    """Commands (T, 6) and measured outputs (T, 4) of runs of that class."""
    real = mujoco.MjModel.from_xml_string(model(friction=0.5, load=LOAD, step=0.004))
    constant = np.random.default_rng(7).normal(0, 0.006, 6)
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        levels = rng.uniform(LOW, HIGH, size=(SEGMENTS, 6))
        ramps = rng.choice((0.6, 0.8, 1.0), size=(SEGMENTS, 6))
        rest = np.mean([LOW, HIGH], axis=0)
        late = rng.uniform(0.06, 0.2, SEGMENTS)
        travel = np.diff(levels, axis=0, prepend=rest[None])
        stops = levels + constant - 0.01 * travel + rng.normal(0, 0.006, levels.shape)
        kind, joint = FAULTS.get(label, ("", 0))
        if kind == "bias":
            size = rng.uniform(0.15, 0.3, SEGMENTS)
            stops[:, joint] += size * rng.choice((-1, 1), SEGMENTS)
        fine = np.arange(0, DURATION, real.opt.timestep)
        executed = program(rest, stops, ramps, late, fine)
        if kind == "stuck":
            after = fine >= ONSET
            executed[after, joint] = executed[after, joint][0]
        measured = moved(real, executed)[:: round(1 / RATE / real.opt.timestep)]
        measured += rng.normal(0, (1e-3, 5e-4, 5e-4, 5e-4), measured.shape)
        time = np.arange(STEPS) / RATE
        made.append((program(rest, levels, ramps, 0 * late, time), measured))
    return made


def program(
    rest: NDArray, levels: NDArray, ramps: NDArray, late: NDArray, time: NDArray
) -> NDArray:
    """References (len(time), 6) that ramp to each level in turn, each segment late by a time."""
    found = np.tile(rest, (len(time), 1))
    before = rest
    for m, level in enumerate(levels):
        share = np.clip((time[:, None] - m * DURATION / SEGMENTS - late[m]) / ramps[m], 0, 1)
        found += share * (level - before)
        before = level
    return found


def moved(real: mujoco.MjModel, references: NDArray) -> NDArray:
    """Elbow and tool (steps, 4) of the arm that follows these references."""
    state = mujoco.MjData(real)
    state.qpos[:] = references[0]
    found = np.empty((len(references), 4))
    elbow = real.joint("elbow").qposadr[0]
    for i, reference in enumerate(references):
        state.ctrl[:] = reference
        mujoco.mj_forward(real, state)
        found[i] = state.qpos[elbow], *state.site("tool").xpos
        mujoco.mj_step(real, state)
    return found


def write_runs(folder: Path, counts: dict[str, int], seed: int, *, nominal: bool = True) -> None:
    """A folder of CSV files per class: commands, ideal outputs, measured outputs."""
    space: dict = {}
    exec(MODULE, space)
    for k, (label, count) in enumerate(counts.items()):
        (folder / label).mkdir(parents=True)
        for i, (commands, measured) in enumerate(record(count, label, seed + k)):
            ideal = space["outputs"](commands[None])[0]
            table = np.hstack([commands, ideal, measured])
            np.savetxt(folder / label / f"{label}-{i}.csv", table, delimiter=",", fmt="%.7g")
