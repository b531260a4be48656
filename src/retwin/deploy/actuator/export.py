"""`export_actuator`: what actuators execute, as TorchScript and ONNX, for many environments."""

from __future__ import annotations

import copy
import math
import warnings
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.checks import positive, whole
from retwin.data.trajectories import Channels
from retwin.deploy.actuator.draws import Draws, causal_part, drawn, still_and_fastest
from retwin.deploy.actuator.module import AT_REST, Actuators, ActuatorStep
from retwin.deploy.parity import check_parity
from retwin.serialisation.models import write_model
from retwin.serialisation.places import check_place
from retwin.twins.twin import checked_commands, checked_seed
from retwin.update.corrected import CorrectedTwin
from retwin.update.corrections import DelayOffset
from retwin.update.surrogate import Surrogate

DATE = (1980, 1, 1, 0, 0, 0)
"""The date of the parts of a file: the same twin gives the same bytes."""
EXAMPLES, STEPS = 3, 40
"""Environments and steps with which written files are compared with torch."""
DRAWN = ("delay", "offset", "probability")
STATE = ("previous", "reference", "resting", "missed", "history")
"""Inputs of the ONNX graph, after the command and its noise: what is drawn, and the state."""


@dataclass(frozen=True)
class ExportedActuator:
    """What was written.

    Attributes
    ----------
    folder : Path
        The folder.
    files : tuple of str
        Names of its files.
    inputs, outputs : Channels
        Commands, and what is executed: positions that the actuators follow effectively, in the
        unit of the commands, or the outputs of the twin.
    period : float
        Time between two steps in s.
    delay : tuple of float
        Mean and greatest delay in s.
    early : float
        Share of draws whose delay was before the command; they have none.
    gain : tuple of float
        Error per unit of distance from the mean target, of each output.
    emulated : bool
        Whether the twin was calibrated on an emulated system.

    """

    folder: Path
    files: tuple[str, ...]
    inputs: Channels
    outputs: Channels
    period: float
    delay: tuple[float, float]
    early: float
    gain: tuple[float, ...]
    emulated: bool


def export_actuator(
    twin: CorrectedTwin,
    folder: str | Path,
    *,
    commands: NDArray,
    seed: int,
    period: float | None = None,
    draws: int = 16384,
    onnx: bool = True,
) -> ExportedActuator:
    """Write what the actuators of a corrected twin execute, for simulations of many robots.

    The folder holds `actuator.pt` (TorchScript, with its state), `actuator.onnx` (a function of
    command and state), and the draws of z in `weights.safetensors`. Each environment has one draw
    per episode: a delay, offsets, and the probability that an actuator misses a segment.

    Parameters
    ----------
    twin : CorrectedTwin
        With `CommandSpace`, or with `DelayOffset` and one output per command; a sensor behind it is
        left out.
    folder : path
        Where to write.
    commands : NDArray
        (n, T, d_u), commands like those of the task, at the rate of the twin: z is drawn at the
        poses of their segments.
    seed : int
        Of the draws.
    period : float, optional
        Time between two steps in s; by default the sample period of the twin.
    draws : int
        Number of draws of z, from 1 to 1e7.
    onnx : bool
        Whether an ONNX graph is written too, for which the extra `onnx` must be installed.

    Raises
    ------
    InputError
        A twin that cannot be an actuator, with the reason; no segment in `commands`; or a file that
        differs from torch by more than 1e-5 of the range of an output.

    """
    twin, operator = causal_part(twin)
    # Draws of z at most: more would not fit in memory beside a simulation.
    whole("draws", draws, at_least=1, at_most=10_000_000)
    seed = checked_seed(seed)
    period = 1 / twin.rate if period is None else positive("period", period, unit="s")
    files = ["model.json", "weights.safetensors", "actuator.pt", *(["actuator.onnx"] * onnx)]
    check_place(folder, folder=True, holds=files)
    if onnx:
        from retwin.deploy.onnx.export import check_installed

        check_installed()
    given = checked_commands(commands, twin.inputs).astype(np.float32, copy=False)
    found = drawn(twin, given, draws, seed)
    at_outputs = isinstance(operator, DelayOffset)
    outputs = twin.outputs if at_outputs else twin.inputs
    actuators = _actuators(twin, given, found, period, at_outputs)
    about = {
        "case": twin.case,
        "inputs": vars(twin.inputs),
        "outputs": vars(outputs),
        "operator": type(operator).__name__,
        "period": period,
        "history": actuators.length,
        "at_rest": AT_REST,
        "early": found.early,
        "gain": found.gain.tolist(),
        "emulated": twin.residual.emulated,
    }
    table = {name: getattr(actuators, name) for name in ("delays", "offsets", "probabilities")}
    with write_model(folder, "actuator", about, table) as inside, torch.no_grad():
        examples = _examples(actuators, given)
        executed = {
            "TorchScript": _execute(write_script(actuators, inside / "actuator.pt"), examples)
        }
        if onnx:
            graph = _run_graph(actuators, inside / "actuator.onnx", examples)
            executed["an ONNX graph"] = graph
        expected = _execute(actuators, examples)
        extent = (expected.amax(dim=(0, 1)) - expected.amin(dim=(0, 1))).clamp_min(1e-30)
        for what, made in executed.items():
            check_parity("twin", what, made, expected, extent)
    return ExportedActuator(
        Path(folder),
        tuple(files),
        twin.inputs,
        outputs,
        period,
        (float(found.delay.mean()), float(found.delay.max())),
        found.early,
        tuple(found.gain.tolist()),
        twin.residual.emulated,
    )


def _actuators(
    twin: CorrectedTwin, commands: NDArray, found: Draws, period: float, at_outputs: bool
) -> Actuators:
    """The module, with the draws in steps."""
    still, change = still_and_fastest(commands)
    plant: nn.Module = nn.Identity()
    if at_outputs:
        assert isinstance(twin.surrogate, Surrogate)
        plant = ScriptedNetwork(twin.surrogate)
    step = ActuatorStep(
        plant,
        found,
        tolerance=torch.as_tensor(still, dtype=torch.float32),
        speed=torch.as_tensor(change * twin.rate * period, dtype=torch.float32),
        # A motion of the twin ends when a sample equals the one before.
        rest=float(max(1, round(1 / (twin.rate * period)))),
    )
    delay = found.delay / period
    length = math.floor(float(delay.max())) + 2
    return Actuators(step, delay, found, length).eval()


class ScriptedNetwork(nn.Module):
    """The network of a surrogate with its units: torch.jit cannot read the surrogate itself."""

    def __init__(self, surrogate: Surrogate) -> None:
        super().__init__()
        self.before = copy.deepcopy(surrogate.before)
        self.network = copy.deepcopy(surrogate.network).requires_grad_(False)
        self.after = copy.deepcopy(surrogate.after)

    def forward(self, values: Tensor) -> Tensor:
        """Outputs (..., d_y) for inputs (..., d_u)."""
        return self.after.inverse(self.network(self.before(values)))


def _examples(actuators: Actuators, commands: NDArray) -> tuple[Tensor, Tensor, Tensor]:
    """Rows of draws (EXAMPLES,), commands and noise (STEPS, EXAMPLES, d_u) to compare with."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.randint(actuators.draws(), (EXAMPLES,), generator=generator)
    trajectories = np.resize(np.arange(len(commands)), EXAMPLES)
    times = np.linspace(0, commands.shape[1] - 1, STEPS).round().astype(int)
    sent = torch.as_tensor(commands[trajectories][:, times]).transpose(0, 1).contiguous()
    return rows, sent, torch.rand(sent.shape, generator=generator)


def _execute(actuators: Any, examples: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """What actuators execute for the examples, (STEPS, EXAMPLES, d_y); none are left in it."""
    rows, sent, uniform = examples
    actuators.start(sent[0], rows)
    made = torch.stack([actuators(u, noise) for u, noise in zip(sent, uniform, strict=True)])
    actuators.start(sent[0, :0], rows[:0])
    return made


def write_script(module: nn.Module, path: Path) -> Any:
    """Write a module as TorchScript, without the names of source files, and read it again."""
    with warnings.catch_warnings():
        # Isaac Lab and mjlab read TorchScript, which torch calls deprecated.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.script(module), str(path))
        with zipfile.ZipFile(path) as archive:
            parts = {name: archive.read(name) for name in archive.namelist()}
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in parts.items():
                if not name.endswith(".debug_pkl"):
                    archive.writestr(zipfile.ZipInfo(name, DATE), data)
        return torch.jit.load(str(path))


def _run_graph(actuators: Actuators, path: Path, examples: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Write the ONNX graph of one step; what onnxruntime executes for the examples."""
    import onnxruntime

    from retwin.deploy.onnx.export import write_graph

    rows, sent, uniform = examples
    actuators.start(sent[0], rows)
    held = {name: getattr(actuators, name) for name in (*DRAWN, *STATE)}
    inputs = {"command": sent[0], "uniform": uniform[0], **held}
    batch = {name: 1 if name == "history" else 0 for name in inputs}
    outputs = ("executed", *(f"next_{name}" for name in STATE))
    write_graph(actuators.step, inputs, path, outputs=outputs, batch=batch)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    values = {name: each.numpy() for name, each in inputs.items()}
    made = []
    for u, noise in zip(sent, uniform, strict=True):
        values |= {"command": u.numpy(), "uniform": noise.numpy()}
        executed, *state = session.run(None, values)
        values |= dict(zip(STATE, state, strict=True))
        made.append(torch.as_tensor(executed))
    return torch.stack(made)
