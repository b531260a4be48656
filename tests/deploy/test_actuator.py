"""Exported actuators: equal to the corrected twin for the same z, and refused where not causal."""

from __future__ import annotations

import dataclasses
import importlib
import json
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from test_readme import python_of

import retwin as rt
from retwin.deploy import export_actuator
from retwin.errors import InputError
from retwin.update.corrections import Chain, SampledSensor
from retwin.update.corrections.commands.effective_commands import effective_commands
from retwin.update.residual import SequenceMixture
from retwin.update.residual.sequence import SequenceResidual

EXAMPLES = Path(__file__).parents[2] / "examples" / "actuators"
RATE, STEPS, WIDTH = 50.0, 120, 2
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.:DeprecationWarning")


def channels(outputs: int = 3) -> dict[str, Any]:
    return {
        "inputs": rt.Channels.numbered("u", WIDTH),
        "outputs": rt.Channels.numbered("y", outputs),
    }


def surrogate(outputs: int = 3, network: Any = rt.MLP((8,))) -> rt.Surrogate:  # noqa: B008
    torch.manual_seed(0)
    made = rt.Surrogate(network, **channels(outputs), rate=RATE)
    for name, values in made.named_buffers():
        if name.endswith(("mean", "scale")):
            values.copy_(torch.rand_like(values) + 0.5)
    return made.eval()


def corrected(
    correction: Any = rt.CommandSpace(),  # noqa: B008 - frozen
    outputs: int = 3,
    network: Any = rt.MLP((8,)),  # noqa: B008 - frozen
    delay: float = 3.3,
    **how: Any,
) -> rt.CorrectedTwin:
    """One whose z depends on the commands, with random weights."""
    torch.manual_seed(1)
    made = rt.ResidualModel(
        correction, rt.Mixture(components=2, hidden=(6,)), **channels(outputs), **how
    )
    made.shift[0], made.scale[0] = delay, 0.4
    made.scale[1:] = 0.3
    made.bounds.copy_(made.shift.abs() + 5 * made.scale)
    return rt.CorrectedTwin(surrogate(outputs, network), made.eval())


def ramps(count: int, motion: int, seed: int = 0) -> np.ndarray:
    """Commands (n, T, 2) with four motions of so many steps from sample 8, 36, 64, 92 on."""
    rng = np.random.default_rng(seed)
    at = np.array([0, *(28 * m + 8 + e for m in range(4) for e in (0, motion)), STEPS])
    levels = rng.uniform(-2, 2, (count, WIDTH, 5))
    values = np.repeat(levels, 2, axis=2)
    made = [[np.interp(np.arange(STEPS), at, row) for row in rows] for rows in values]
    return np.moveaxis(np.array(made), 1, 2).astype(np.float32)


def executed(
    module: Any, commands: np.ndarray, rows: torch.Tensor, uniform: torch.Tensor
) -> np.ndarray:
    """Outputs (n, T, d_y) of a loaded file, step by step."""
    sent = torch.as_tensor(commands)
    module.start(sent[:, 0], rows)
    return torch.stack([module(sent[:, k], uniform[:, k]) for k in range(STEPS)], dim=1).numpy()


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[rt.CorrectedTwin, Path]:
    twin = corrected()
    folder = tmp_path_factory.mktemp("export") / "actuator"
    export_actuator(twin, folder, commands=ramps(20, 9), seed=3, draws=500, onnx=False)
    return twin, folder


def read(folder: Path) -> tuple[dict[str, torch.Tensor], Any]:
    return load_file(folder / "weights.safetensors"), torch.jit.load(folder / "actuator.pt")


@pytest.mark.parametrize("motion", [1, 9])
def test_it_executes_what_command_space_does_for_the_same_z(
    exported: tuple[rt.CorrectedTwin, Path], motion: int
) -> None:
    _, folder = exported
    table, module = read(folder)
    n = 30
    commands, rows = ramps(n, motion, seed=5), torch.arange(n)
    segments = rt.Segments.from_commands(commands)
    step = module.step
    settled = torch.as_tensor(commands)[:, segments.settle[0].round().astype(int)]
    pose = settled.clamp(step.low, step.high) - step.centre
    if motion == 1:
        step.speed.fill_(100.0)  # a step is as fast as any error is caught up with
    # A ramp is caught up with at its onset, the twin spreads that over the ramp: none is missed.
    missed = (torch.rand(n, 4, WIDTH) < 0.4).float() if motion == 1 else torch.zeros(n, 4, WIDTH)
    missed[:, 0] = 0
    z = torch.cat(
        [
            table["delays"][rows][:, None].expand(-1, 4, 1),
            table["offsets"][rows][:, None] + step.gain * pose,
            missed,
        ],
        dim=2,
    ).double()
    expected = effective_commands(
        torch.as_tensor(commands).double(), segments, z, torch.arange(STEPS)
    ).numpy()
    uniform = torch.ones(n, STEPS, WIDTH)
    for m, onset in enumerate(segments.start[0].round().astype(int)):
        uniform[:, onset : onset + 28] = 1.0 - missed[:, m][:, None]
    found = executed(module, commands, rows, uniform)
    # Within the range of the gain, from the end of the first segment's motion on.
    inside = ((commands >= step.low.numpy()) & (commands <= step.high.numpy())).all(axis=(1, 2))
    inside &= (found.min(axis=(1, 2)) > -9) & (found.max(axis=(1, 2)) < 9)
    assert inside.sum() >= 5
    late = 8 + motion + int(table["delays"].max().ceil()) + 1
    np.testing.assert_allclose(found[inside, late:], expected[inside, late:], atol=2e-5)


def test_draws_have_the_distribution_of_the_twin(
    exported: tuple[rt.CorrectedTwin, Path],
) -> None:
    twin, folder = exported
    table, _ = read(folder)
    context = twin.residual.context(twin.surrogate, ramps(20, 9))
    z = torch.cat(
        [
            twin.residual.sample(context, generator=torch.Generator().manual_seed(k)).flatten(0, 1)
            for k in range(20)
        ]
    )
    delay = table["delays"][:, 0]
    assert float(delay.mean()) == pytest.approx(float(z[:, 0].mean()), abs=0.1)
    assert float(delay.std()) == pytest.approx(float(z[:, 0].std()), rel=0.15)
    chance = table["probabilities"].mean(dim=0)
    assert chance.tolist() == pytest.approx(z[:, 3:].mean(dim=0).tolist(), abs=0.05)


@pytest.mark.slow
def test_the_onnx_graph_and_the_script_agree_step_by_step(tmp_path: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    folder = tmp_path / "actuator"
    export_actuator(corrected(), folder, commands=ramps(20, 9), seed=3, draws=50)
    table, module = read(folder)
    n = 7
    commands, rows = ramps(n, 4, seed=8), torch.arange(n)
    uniform = torch.rand(n, STEPS, WIDTH, generator=torch.Generator().manual_seed(0))
    expected = executed(module, commands, rows, uniform)
    session = onnxruntime.InferenceSession(folder / "actuator.onnx")
    about = json.loads((folder / "model.json").read_text())
    state = {
        "previous": commands[:, 0],
        "reference": commands[:, 0],
        "resting": np.full((n, 1), about["at_rest"], np.float32),
        "missed": np.zeros((n, WIDTH), np.float32),
        "history": np.repeat(commands[None, :, 0], about["history"], axis=0),
    }
    fixed = {
        "delay": table["delays"][rows].numpy(),
        "offset": table["offsets"][rows].numpy(),
        "probability": table["probabilities"][rows].numpy(),
    }
    for k in range(STEPS):
        inputs = {"command": commands[:, k], "uniform": uniform[:, k].numpy(), **fixed, **state}
        out, *new = session.run(None, inputs)
        state = dict(zip(state, new, strict=True))
        np.testing.assert_allclose(out, expected[:, k], atol=1e-5)


def test_a_reset_begins_the_episode_of_some_environments_only(
    exported: tuple[rt.CorrectedTwin, Path],
) -> None:
    _, folder = exported
    commands, half = ramps(6, 4, seed=2), STEPS // 2
    sent, rows = torch.as_tensor(commands), torch.arange(6)
    uniform = torch.ones(6, STEPS, WIDTH)
    module, fresh = read(folder)[1], read(folder)[1]
    with torch.inference_mode():
        whole = executed(module, commands, rows, uniform)
    module.start(sent[:, 0], rows)
    for k in range(half):
        module(sent[:, k], uniform[:, k])
    some, other = torch.tensor([1, 4]), torch.tensor([200, 300])
    module.reset(some, sent[some, half], other)
    fresh.start(sent[some, half], other)
    for k in range(half, STEPS):
        now = module(sent[:, k], uniform[:, k])
        torch.testing.assert_close(now[some], fresh(sent[some, k], uniform[some, k]))
        np.testing.assert_array_equal(now[[0, 2, 3, 5]], whole[[0, 2, 3, 5], k])


def test_an_actuator_that_missed_a_segment_stays_and_catches_up(tmp_path: Path) -> None:
    twin = corrected(delay=0.0)
    folder = tmp_path / "actuator"
    export_actuator(twin, folder, commands=ramps(20, 9), seed=3, draws=10, onnx=False)
    module, commands = torch.jit.load(folder / "actuator.pt"), ramps(1, 9, seed=4)
    uniform = torch.ones(1, STEPS, WIDTH)
    rows = torch.zeros(1, dtype=torch.long)
    free = executed(module, commands, rows, uniform)
    uniform[:, 36:64] = torch.tensor([0.0, 1.0])
    held = executed(module, commands, rows, uniform)
    np.testing.assert_array_equal(held[..., 1], free[..., 1])
    assert np.ptp(held[0, 40:64, 0]) < 1e-5
    speed = module.step.speed[0].item()
    assert np.abs(np.diff(held[0, :, 0])).max() <= 1.2 * speed
    np.testing.assert_allclose(held[0, 110:], free[0, 110:], atol=1e-5)


def test_the_period_changes_steps_and_no_times(tmp_path: Path) -> None:
    twin = corrected()
    how = {"commands": ramps(20, 9), "seed": 3, "draws": 50, "onnx": False}
    own = export_actuator(twin, tmp_path / "own", **how)
    fine = export_actuator(twin, tmp_path / "fine", period=0.005, **how)
    assert own.delay == fine.delay
    (one, first), (other, second) = read(tmp_path / "own"), read(tmp_path / "fine")
    torch.testing.assert_close(4 * one["delays"], other["delays"])
    assert (first.step.rest, second.step.rest) == (1.0, 4.0)
    torch.testing.assert_close(first.step.speed, 4 * second.step.speed)


def test_outputs_of_actuators_are_delayed_and_offset(tmp_path: Path) -> None:
    twin = corrected(rt.DelayOffset(), outputs=WIDTH)
    export_actuator(twin, tmp_path / "a", commands=ramps(20, 9), seed=3, draws=50, onnx=False)
    table, module = read(tmp_path / "a")
    commands, rows = ramps(5, 9, seed=6), torch.arange(5)
    segments = rt.Segments.from_commands(commands)
    z = torch.cat([table["delays"][rows], table["offsets"][rows]], dim=1)
    context = rt.Context.of(twin.surrogate, commands, segments, rate=RATE)
    expected = rt.DelayOffset().apply(context, z[:, None].expand(-1, 4, -1)).numpy()
    found = executed(module, commands, rows, torch.ones(5, STEPS, WIDTH))
    np.testing.assert_allclose(found[:, 30:], expected[:, 30:], atol=1e-4)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_without_paths(tmp_path: Path) -> None:
    for name in ("one", "two"):
        export_actuator(corrected(), tmp_path / name, commands=ramps(5, 9), seed=1, draws=20)
    for file in ("actuator.pt", "actuator.onnx", "model.json", "weights.safetensors"):
        content = (tmp_path / "one" / file).read_bytes()
        assert content == (tmp_path / "two" / file).read_bytes(), file
        assert str(Path(rt.__file__).parent).encode() not in content


def sampled(correction: Any) -> Chain:
    return Chain(correction, SampledSensor())


def per_sample() -> rt.CorrectedTwin:
    density = SequenceMixture(network=rt.LSTM(4), members=2)
    return rt.CorrectedTwin(
        surrogate(), SequenceResidual(rt.Additive(), density, **channels()).eval()
    )


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (surrogate, "Surrogate, which has no correction"),
        (per_sample, "Additive, which corrects each output sample"),
        (lambda: corrected(rt.DelayOffset()), "3 outputs for 2 commands"),
        (
            lambda: corrected(rt.DelayOffset(), outputs=2, network=rt.LSTM(4)),
            "a network that remembers",
        ),
        (lambda: corrected(sampled(Chain(rt.CommandSpace(), rt.DelayOffset()))), "behind the act"),
        (lambda: corrected(segmentation="path"), "known only at the end"),
        (lambda: corrected(delay=-3.0), "before the command"),
    ],
)
def test_what_is_no_causal_actuator_is_refused(made: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        export_actuator(made(), tmp_path / "a", commands=ramps(5, 9), seed=0, onnx=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"draws": 0}, "draws"),
        ({"period": 0.0}, "period"),
        ({"seed": -1}, "seed"),
        ({"commands": np.ones((2, 30, WIDTH))}, "none that changes"),
        ({"commands": np.ones((2, 30, 5))}, "commands"),
    ],
)
def test_wrong_arguments_are_named(how: Any, message: str, tmp_path: Path) -> None:
    given = {"commands": ramps(5, 9), "seed": 0, "onnx": False, **how}
    with pytest.raises(InputError, match=message):
        export_actuator(corrected(), tmp_path / "a", **given)
    assert not list(tmp_path.iterdir())


def test_the_command_line_exports_with_the_commands_of_a_case(call, tmp_path: Path) -> None:
    surrogate_, residual = (getattr(corrected(), each) for each in ("surrogate", "residual"))
    (tmp_path / "case.toml").write_text(CASE)
    (tmp_path / "joints.py").write_text("def follow(u):\n    return u[:, [0, 1, 0]]\n")
    twin = rt.CorrectedTwin(surrogate_, residual, case=str(tmp_path / "case.toml"))
    twin.save(tmp_path / "model")
    out = tmp_path / "actuator"
    words = ("export", "actuator", tmp_path / "model", "--out", out, "--torchscript-only")
    code, printed, err = call(*words, "--period", 0.01, "--draws", 30, "--json")
    assert code == 0, err
    answer = json.loads(printed)
    assert (answer["period"], answer["files"][-1]) == (0.01, "actuator.pt")
    assert torch.jit.load(out / "actuator.pt").draws() == 30
    code, _, err = call(*words[:3], "--out", tmp_path / "model" / "model.json")
    assert (code, "path" in err) == (2, True), err
    corrected(rt.DelayOffset()).save(tmp_path / "other")
    code, _, err = call(*words[:2], tmp_path / "other", "--out", tmp_path / "no")
    assert (code, "3 outputs for 2 commands" in err) == (2, True), err
    assert not (tmp_path / "no").exists()


CASE = """
name = "joints"
title = "Two joints"
twin = "joints:follow"
rate = 50
correction = "command_space"

[inputs]
u0 = { low = -1, high = 1 }
u1 = { low = -1, high = 1 }

[outputs]
y0 = {}
y1 = {}
y2 = {}

[commands]
kind = "HoldSampler"
duration = 4
"""


class Drive:
    """Stands in for the PD drives of both tools: torques are errors of position."""

    def __init__(self, cfg: Any, *args: Any, **kwargs: Any) -> None:
        self.cfg, self._num_envs, self._device = cfg, 5, "cpu"
        self.resets: list[Any] = []

    def initialize(self, mj_model: Any, model: Any, data: Any, device: str) -> None:
        assert data.nworld == 5

    def reset(self, env_ids: Any = None) -> None:
        self.resets.append(env_ids)


class IsaacLabDrive(Drive):
    def compute(self, control_action: Any, joint_pos: torch.Tensor, joint_vel: torch.Tensor) -> Any:
        control_action.joint_efforts = control_action.joint_positions - joint_pos
        return control_action


class MjlabDrive(Drive):
    def compute(self, cmd: Any) -> torch.Tensor:
        return cmd.position_target - cmd.pos


@dataclasses.dataclass
class ActuatorCmd:
    """The fields that mjlab documents."""

    position_target: torch.Tensor
    velocity_target: torch.Tensor
    effort_target: torch.Tensor
    pos: torch.Tensor
    vel: torch.Tensor


@dataclasses.dataclass(kw_only=True)
class DriveCfg:
    stiffness: float = 1.0


def wrapper(name: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The example, which imports stand-ins."""
    isaac, mjlab = types.ModuleType("isaaclab.actuators"), types.ModuleType("mjlab.actuator")
    isaac.IdealPDActuator, isaac.IdealPDActuatorCfg = IsaacLabDrive, DriveCfg  # type: ignore[attr-defined]
    utils = types.ModuleType("isaaclab.utils")
    utils.configclass = dataclasses.dataclass(kw_only=True)  # type: ignore[attr-defined]
    mjlab.IdealPdActuator, mjlab.IdealPdActuatorCfg = MjlabDrive, DriveCfg  # type: ignore[attr-defined]
    mjlab.ActuatorCmd = ActuatorCmd  # type: ignore[attr-defined]
    for each in (isaac, mjlab, utils):
        monkeypatch.setitem(sys.modules, each.__name__.partition(".")[0], types.ModuleType("none"))
        monkeypatch.setitem(sys.modules, each.__name__, each)
    monkeypatch.syspath_prepend(EXAMPLES)
    for each in ("effective", name):
        monkeypatch.delitem(sys.modules, each, raising=False)
    return importlib.import_module(name)


@pytest.mark.parametrize("name", ["isaac_lab", "mjlab_actuator"])
def test_the_wrappers_keep_the_documented_signatures(
    name: str, exported: tuple[rt.CorrectedTwin, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = wrapper(name, monkeypatch)
    how = {"file": str(exported[1] / "actuator.pt"), "unit": 0.5, "zero": 0.1}
    cfg = module.RetwinActuatorCfg(**how)
    if name == "isaac_lab":
        made = module.RetwinActuator(cfg, ["a", "b"], slice(None), 5, "cpu")
    else:
        made = cfg.build(None, [0, 1], ["a", "b"])
        made.initialize(None, None, types.SimpleNamespace(nworld=5), "cpu")

    def torque(target: torch.Tensor, joint_pos: torch.Tensor) -> torch.Tensor:
        if name == "mjlab_actuator":
            return made.compute(ActuatorCmd(target, *[torch.zeros(5, 2)] * 2, joint_pos, joint_pos))
        action = types.SimpleNamespace(joint_positions=target)
        return made.compute(action, joint_pos, torch.zeros(5, 2)).joint_efforts

    position, target = torch.zeros(5, 2), torch.full((5, 2), 0.3)
    made.reset([0, 1, 2, 3, 4])
    first = torque(position, position)
    # At rest the torque is that of the offsets, in the joint's unit.
    model = made.effective.model
    error = 0.5 * (model.offset + model.step.gain * (-0.2 - model.step.centre))
    torch.testing.assert_close(first, error, atol=1e-5, rtol=0)
    before = made.effective.model.delay.clone()
    for _ in range(20):
        torque(target, position)
    made.reset(torch.tensor([1]))
    torque(target, position)
    after = made.effective.model.delay
    assert (before != after).flatten().tolist() == [False, True, False, False, False]
    assert len(made.resets) == 2


@pytest.mark.slow
def test_the_code_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code = "".join(python_of("export", "Actuators for robot learning"))
    names: dict = {}
    exec(compile(code, "docs/export.md", "exec"), names)
    assert names["effective"].shape == (4096, 4)
    assert 0 < names["made"].delay[0] < 0.2
