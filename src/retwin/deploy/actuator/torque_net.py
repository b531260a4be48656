"""`export_actuator_net`: torque by position errors and velocities, where torque is an output.

Isaac Lab's `ActuatorNetMLP` and mjlab's `LearnedMlpActuator` call one network for all joints of a
group (Hwangbo et al., Science Robotics 4, eaau5872, 2019). It is trained here on simulations of the
corrected twin, in which torque, position and commanded position are known at each sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.checks import finite, require
from retwin.data.trajectories import Channels, Trajectories
from retwin.deploy.actuator.export import ScriptedNetwork, write_script
from retwin.deploy.parity import check_parity
from retwin.nets.networks import MLP
from retwin.nets.training import Training
from retwin.progress import Progress
from retwin.serialisation.files import write_atomically
from retwin.serialisation.places import check_place
from retwin.twins.twin import Twin, checked_commands, checked_seed
from retwin.update.surrogate import fit_surrogate


@dataclass(frozen=True)
class Joint:
    """The channels of a joint.

    Parameters
    ----------
    target : str
        The command channel of its position target.
    position, torque : str
        Output channels; the position has the unit of the target.
    velocity : str
        Output channel, in that unit per second; by default the change of the position per sample.

    """

    target: str
    position: str
    torque: str
    velocity: str = ""


@dataclass(frozen=True)
class ExportedActuatorNet:
    """What was written, with the names of `ActuatorNetMLPCfg`.

    Attributes
    ----------
    network_file : Path
        TorchScript: (N, 2 k) to (N, 1), for k entries of `input_idx` and all joints of all robots.
    input_order : str
        "pos_vel": position errors first.
    input_idx : tuple of int
        Steps into the past, 0 for the present one.
    pos_scale, vel_scale, torque_scale : float
        1: the file has its scales inside.
    period : float
        Time between two steps in s, with which the file must be used.
    unit : str
        Of the torque.
    error : float
        Root mean square error on held-out trajectories, divided by the torque's standard deviation.

    """

    network_file: Path
    input_idx: tuple[int, ...]
    period: float
    unit: str
    error: float
    input_order: str = "pos_vel"
    pos_scale: float = 1.0
    vel_scale: float = 1.0
    torque_scale: float = 1.0


def export_actuator_net(
    twin: Twin,
    path: str | Path,
    *,
    joints: Sequence[Joint],
    commands: NDArray,
    seed: int,
    history: Sequence[int] = (0, 1, 2),
    training: Training | None = None,
    progress: Progress | None = None,
) -> ExportedActuatorNet:
    """Write the torque of joints by the history of their position errors and velocities.

    Parameters
    ----------
    twin : Twin
        A corrected twin whose outputs have the torques, such as `CorrectedTwin` or `DynamicsTwin`.
    path : path
        The file, *.pt.
    joints : sequence of Joint
        Joints with equal actuators: they share the network, as in both tools.
    commands : NDArray
        (n, T, d_u), commands like those of the task; n times the number of joints is at least ten.
    seed : int
        Of the simulation and the training.
    history : sequence of int
        Steps into the past that the network is given, each once.
    training : Training, optional
        Settings of the training.
    progress : callable, optional
        Called with the share of the training that is done.

    Raises
    ------
    InputError
        A channel that the twin does not have, torque above all; units of target and position that
        differ; outputs that are not finite; a file of another kind.

    """
    path = Path(path)
    check_place(path)
    _require(path.suffix == ".pt", "path", "a file *.pt", str(path), "give a name that ends so")
    lags = _history(history)
    places = [_places(twin, each) for each in joints]
    _require(bool(places), "joints", "at least one joint", "none", "name the channels of one")
    units = {twin.outputs.units[place[2]] for place in places}
    _require(len(units) == 1, "joints", "torques in one unit", str(sorted(units)), "export each")
    seed = checked_seed(seed)
    made = twin.simulate(checked_commands(commands, twin.inputs), seed=seed)
    examples = [_examples(made, place, lags) for place in places]
    inputs, torque = (np.concatenate(each) for each in zip(*examples, strict=True))
    finite_rows = np.isfinite(inputs).all() and np.isfinite(torque).all() and made.mask.all()
    _require(
        bool(finite_rows), "twin", "finite outputs at each sample", "others", "change commands"
    )
    names = [f"{what} {lag} steps ago" for what in ("error", "velocity") for lag in lags]
    channels = Channels(tuple(names), ("1",) * len(names))
    simulated = Trajectories(
        inputs, torque, torque, twin.rate, inputs=channels, outputs=Channels(("torque",), ("1",))
    )
    network = fit_surrogate(
        simulated, MLP((32, 32)), seed=seed, training=training, progress=progress
    )
    assert network.fitted is not None
    module = ScriptedNetwork(network).eval()
    with write_atomically(path) as temporary, torch.no_grad():
        again: Any = write_script(module, Path(temporary))
        given = torch.as_tensor(inputs.reshape(-1, inputs.shape[2]))[:1000]
        expected = module(given)
        extent = float(expected.max() - expected.min()) or 1.0
        check_parity("twin", "TorchScript", again(given), expected, extent)
    error = float(network.fitted.figures["nrmse_torque"])
    return ExportedActuatorNet(path, lags, 1 / twin.rate, units.pop(), error)


def _require(right: bool, what: str, expected: str, got: str, remedy: str) -> None:
    require(right, what, expected=expected, got=got, remedy=remedy)


def _history(history: Sequence[int]) -> tuple[int, ...]:
    # Steps into the past at most.
    lags = tuple(int(finite("history", each, at_least=0, at_most=1000)) for each in history)
    right = bool(lags) and len(set(lags)) == len(lags) and lags == tuple(history)
    _require(right, "history", "steps into the past, each once", str(history), "give (0, 1, 2)")
    return lags


def _places(twin: Twin, joint: Joint) -> tuple[int, int, int, int | None]:
    """Where target, position, torque and velocity are among commands and outputs."""
    target = _place(twin.inputs, "target", joint.target)
    position = _place(twin.outputs, "position", joint.position)
    torque = _place(twin.outputs, "torque", joint.torque)
    velocity = _place(twin.outputs, "velocity", joint.velocity) if joint.velocity else None
    commanded, reached = twin.inputs.units[target], twin.outputs.units[position]
    expected = f"a position in the unit of its target, {commanded!r}"
    got = repr(reached)
    _require(commanded == reached, "joints", expected, got, "convert one of them in the twin")
    return target, position, torque, velocity


def _place(channels: Channels, role: str, name: str) -> int:
    """Where the channel is that has a role in a joint."""
    expected = f"a {role} among {', '.join(channels.names)}"
    got = f"{name!r}, which the twin has not"
    remedy = "an actuator net needs torques of the machine; without them, export_actuator gives "
    remedy += "effective position targets, which need none"
    _require(name in channels.names, "joints", expected, got, remedy)
    return channels.names.index(name)


def _examples(
    made: Trajectories, place: tuple[int, int, int, int | None], lags: Sequence[int]
) -> tuple[NDArray, NDArray]:
    """Inputs (n, T, 2 k) and torques (n, T, 1) of a joint; before the begin its history is 0."""
    target, position, torque, velocity = place
    reached = made.observed[..., position].astype(np.float64)
    error = made.commands[..., target] - reached
    speed = np.diff(reached, axis=1, prepend=reached[:, :1]) * made.rate
    if velocity is not None:
        speed = made.observed[..., velocity]
    columns = []
    for series in (error, speed):
        for lag in lags:
            past = np.zeros_like(series)
            past[:, lag:] = series[:, : series.shape[1] - lag]
            columns.append(past)
    inputs = np.stack(columns, axis=-1).astype(np.float32)
    return inputs, made.observed[..., [torque]].astype(np.float32)
