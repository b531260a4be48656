"""Actuator nets: torque by position error and velocity, called as Isaac Lab documents."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import retwin as rt
from retwin.deploy import ExportedActuatorNet, Joint, export_actuator_net
from retwin.errors import InputError
from retwin.twins import Parameter, State, StateTwin

STIFFNESS, DAMPING = 12.0, 0.8
JOINTS = [Joint(f"target {i}", f"angle {i}", f"torque {i}", f"speed {i}") for i in (1, 2)]
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.:DeprecationWarning")


def arm(positions: str = "rad") -> StateTwin:
    """An emulated arm of two equal drives, whose torques are outputs."""
    return StateTwin(
        tuple(State(f"{what} {i}", "rad", 0.0) for i in (1, 2) for what in ("q", "v")),
        lambda x, u, p: (
            x[0], x[1], p.stiffness * (u[0] - x[0]) - DAMPING * x[1],
            x[2], x[3], p.stiffness * (u[1] - x[2]) - DAMPING * x[3],
        ),
        rt.Channels(("target 1", "target 2"), ("rad", "rad")),
        rt.Channels(
            tuple(f"{what} {i}" for i in (1, 2) for what in ("angle", "speed", "torque")),
            (positions, "rad/s", "N m") * 2,
        ),
        50.0,
        derivative=lambda x, u, p: (
            x[1], p.stiffness * (u[0] - x[0]) - 2 * x[1],
            x[3], p.stiffness * (u[1] - x[2]) - 3 * x[3],
        ),
        parameters=(Parameter("stiffness", "N m/rad", 1.0, 50.0, STIFFNESS),),
    )  # fmt: skip


def held(count: int, seed: int) -> np.ndarray:
    levels = np.random.default_rng(seed).uniform(-1, 1, (count, 8, 2))
    return np.concatenate([np.zeros((count, 5, 2)), levels.repeat(15, axis=1)], axis=1)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> ExportedActuatorNet:
    return export_actuator_net(
        arm(), tmp_path_factory.mktemp("net") / "net.pt", joints=JOINTS, commands=held(12, 0),
        seed=0, history=(0, 2), training=rt.Training(max_epochs=12, learning_rate=1e-2),
    )  # fmt: skip


class Drive:
    """Stands in for `ActuatorNetMLP`, from its documentation: histories, scales, one network."""

    def __init__(self, cfg: Any, robots: int, joints: int) -> None:
        self.cfg, self.shape = cfg, (robots, joints)
        self.network = torch.jit.load(str(cfg.network_file)).eval()
        self.past = torch.zeros(2, max(cfg.input_idx) + 1, robots, joints)

    def compute(self, target: torch.Tensor, position: torch.Tensor, velocity: torch.Tensor) -> Any:
        now = torch.stack([target - position, velocity])
        self.past = torch.cat([now[:, None], self.past[:, :-1]], dim=1)
        rows = [self.past[:, i].flatten(1) for i in self.cfg.input_idx]
        error, speed = torch.stack(rows, dim=-1)
        parts = [error * self.cfg.pos_scale, speed * self.cfg.vel_scale]
        order = (0, 1) if self.cfg.input_order == "pos_vel" else (1, 0)
        made = self.network(torch.cat([parts[k] for k in order], dim=1))
        return made.view(self.shape) * self.cfg.torque_scale


@pytest.mark.slow
def test_its_torques_are_those_of_the_twin(exported: ExportedActuatorNet) -> None:
    assert (exported.input_idx, exported.period, exported.unit) == ((0, 2), 0.02, "N m")
    robots = 6
    made = arm().simulate(held(robots, 7), seed=0)
    drive = Drive(exported, robots, 2)
    series = made.observed.copy().reshape(robots, made.steps, 2, 3)
    found = []
    for k in range(made.steps):
        position, speed = (torch.as_tensor(series[:, k, :, i]).float() for i in (0, 1))
        target = torch.as_tensor(made.commands[:, k].copy()).float()
        found.append(drive.compute(target, position, speed))
    torques = torch.stack(found, dim=1).numpy()
    truth = series[..., 2]
    error = np.sqrt(np.mean((torques - truth) ** 2)) / truth.std()
    assert error < 0.05
    assert exported.error == pytest.approx(error, rel=0.6, abs=0.01)


@pytest.mark.parametrize(
    ("joint", "unit", "message"),
    [
        (Joint("target 1", "angle 1", "current"), "rad", "current.*effective position targets"),
        (Joint("angle 1", "angle 1", "torque 1"), "rad", "target among target 1, target 2"),
        (Joint("target 1", "angle 1", "torque 1"), "deg", "unit of its target"),
    ],
)
def test_without_torques_it_is_refused(
    joint: Joint, unit: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=f"(?s){message}"):
        export_actuator_net(
            arm(unit), tmp_path / "net.pt", joints=[joint], commands=held(12, 0), seed=0
        )
    assert not list(tmp_path.iterdir())


SERVO = """
import numpy as np


def servo(targets):
    reached = 0.5 * targets
    return np.concatenate([reached, 4 * (targets - reached)], axis=-1)
"""
CASE = """
name = "servo"
twin = "own_servo:servo"
rate = 20
inputs = { target = { unit = "rad", low = -1, high = 1 } }
outputs = { angle = { unit = "rad" }, torque = { unit = "N m" } }
commands = { duration = 4, segments = 2, ramp_durations = [0.8, 1.0] }
network = { kind = "MLP", hidden = [8] }
training = { max_epochs = 5, batch_size = 64, learning_rate = 1e-2 }
density = { kind = "Mixture", training = { max_epochs = 2, decay = "step" } }
"""


@pytest.mark.slow
def test_the_command_line_writes_it_from_a_fitted_model(tmp_path: Path, call) -> None:
    (tmp_path / "own_servo.py").write_text(SERVO)
    (tmp_path / "case.toml").write_text(CASE)
    case = rt.cases.get(str(tmp_path / "case.toml"))
    made = case.twin.simulate(case.sampler.sample(12, rng=np.random.default_rng(0)), seed=0)
    real = made.replace(observed=made.observed + np.float32(0.1))
    rt.save(real, tmp_path / "real.npz")
    model = tmp_path / "model"
    given = (tmp_path / "case.toml", "--real", tmp_path / "real.npz", "--simulations", 40)
    code, _, err = call(
        "fit", *given, "--correction", "delay_offset", "--no-compare", "--out", model
    )
    assert code == 0, err
    net = tmp_path / "net.pt"
    words = ("export", "actuator", model, "--history", "0,2", "--json", "--out", net)
    code, out, err = call(*words, "--torque", "target,angle,torque")
    assert code == 0, err
    printed = json.loads(out)
    assert (printed["input_idx"], printed["period"], printed["unit"]) == ([0, 2], 0.05, "N m")
    assert printed["error"] < 0.2
    assert torch.jit.load(str(net))(torch.zeros(7, 4)).shape == (7, 1)
    net.unlink()
    for joint, part in (
        ("target,angle,current", "effective position targets"),
        ("target,angle", "TARGET,POSITION,TORQUE,VELOCITY"),
        ("target,angle,torque,", "TARGET,POSITION,TORQUE,VELOCITY"),
    ):
        code, _, err = call(*words, "--torque", joint)
        assert (code, part in err, net.exists()) == (2, True, False), err
    code, _, err = call(*words, "--torque", "target,angle,torque", "--history", "0,x")
    assert (code, "--history" in err) == (2, True), err
