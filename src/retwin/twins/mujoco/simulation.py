"""`MuJoCoSimulation`: batches of simulations of one MuJoCo model, from commands to sensor data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import mujoco
import numpy as np
from mujoco import batch as mujoco_batch
from numpy.typing import NDArray

from retwin.checks import given, require
from retwin.twins.mujoco.actuators import FILTERS, joint_of, resting
from retwin.twins.mujoco.parameters import set_parameter

LOCKED = 1e12
"""Damping in N m s/rad (N s/m) of a joint that is held. It is so high that the joint moves by less
than 1 um under a load of tons."""


@dataclass(frozen=True, eq=False)
class Response:
    """The result of n simulations.

    Attributes
    ----------
    outputs : ndarray, shape (n, T, d_y)
        Sensor data at the samples.
    positions : ndarray, shape (n, T, nq)
        Joint positions in rad and m; empty unless states were requested.
    velocities : ndarray, shape (n, T, nv)
        Joint velocities in rad/s and m/s; empty unless states were requested.
    failed : dict of int to str
        Simulations that became unstable, counted from 0, and MuJoCo's warnings.

    """

    outputs: NDArray
    positions: NDArray
    velocities: NDArray
    failed: dict[int, str]


@dataclass(frozen=True, eq=False)
class MuJoCoSimulation:
    """How simulations of a model run.

    Parameters
    ----------
    model : mujoco.MjModel
        The compiled model.
    inputs : tuple of str
        Actuators that the commands drive.
    sensors : tuple of str
        Sensors that are the outputs.
    keyframe : int
        Keyframe to start from; -1 takes the model's defaults.
    substeps : int
        Integration steps per sample.
    interpolate : bool
        Whether commands are linear between samples, or held.
    settle : float
        Duration in s for which the first commands are held before sample 0.
    threads : int
        Threads that simulate; 0 takes all cores.

    """

    model: mujoco.MjModel
    inputs: tuple[str, ...]
    sensors: tuple[str, ...]
    keyframe: int
    substeps: int
    interpolate: bool
    settle: float
    threads: int

    def integrate(
        self,
        commands: NDArray,
        frozen: NDArray,
        parameters: Mapping[str, NDArray],
        *,
        states: bool = False,
    ) -> Response:
        """Integrate n simulations.

        Parameters
        ----------
        commands : ndarray, shape (n, T, d_u)
            Effective commands.
        frozen : ndarray of int, shape (n, d_u)
            Sample from which an actuator's joint is locked, T for never.
        parameters : mapping of str to ndarray, shape (n,)
            Model fields per simulation, see `set_parameter`.
        states : bool, default False
            Whether positions and velocities are returned.

        Returns
        -------
        Response
            The outputs, and the simulations that failed.

        Raises
        ------
        InputError
            A parameter that the model does not have, or a stuck actuator whose joint cannot be
            locked.

        """
        steps = commands.shape[1]
        batch = mujoco_batch.Batch(self.model, len(commands), self.threads)
        fields = ("sensordata", "qpos", "qvel") if states else ("sensordata",)
        with _without_log():
            for name, values in parameters.items():
                set_parameter(batch, name, values)
            if parameters:
                batch.set_const()
            batch.reset(keyframe=self.keyframe)
            controls = self._controls(batch, commands)
            self._rest(batch, controls[:, :1], commands[:, 0])
            recorded = self._roll(batch, controls, frozen, fields)
        failed = {}
        for i in np.flatnonzero(batch.warning[:, :, 1].any(axis=1)):
            kind = int(np.argmax(batch.warning[i, :, 1] > 0))
            failed[int(i)] = mujoco.mju_warningText(kind, int(batch.warning[i, kind, 0]))
        none = np.empty((len(commands), steps, 0))
        positions, velocities = (recorded.get(name, none) for name in ("qpos", "qvel"))
        return Response(recorded["sensordata"], positions, velocities, failed)

    def _roll(
        self, batch: mujoco_batch.Batch, controls: NDArray, frozen: NDArray, fields: Sequence[str]
    ) -> dict[str, NDArray]:
        """Fields at every sample, (n, T, size); joints are locked at their onsets."""
        sub, last = self.substeps, controls.shape[1]
        steps = (last - 1) // sub + 1
        columns = {name: self._columns if name == "sensordata" else slice(None) for name in fields}
        recorded = {}
        for name, width in columns.items():
            recorded[name] = np.empty((len(controls), steps, *batch.bind(name)[0, width].shape))
            recorded[name][:, 0] = batch.bind(name)[:, width]
        held = frozen < steps
        damping = batch.expand("dof_damping") if held.any() else np.empty(0)
        # Between two onsets of any simulation, all simulations are integrated together.
        marks = np.unique(np.append(sub * frozen[held], [0, last]))
        for begin, end in pairwise(marks):
            for i, actuator in np.argwhere(held & (sub * frozen == begin)):
                dof = self._lockable(int(actuator))
                damping[i, dof] = LOCKED
                batch.bind("qvel")[i, dof] = 0.0
            part = batch.rollout(int(end - begin), controls[:, begin:end], record=fields)
            for name, width in columns.items():
                # Sensor data are of the begin of a step, states of its end.
                at = np.arange(begin, end) + (name != "sensordata")
                keep = (at % sub == 0) & (at < steps * sub)
                recorded[name][:, at[keep] // sub] = part[name][:, keep][:, :, width]
        return recorded

    def _controls(self, batch: mujoco_batch.Batch, commands: NDArray) -> NDArray:
        """Controls of all actuators at every step until the last sample, (n, steps, nu)."""
        samples = commands.shape[1]
        at = np.arange((samples - 1) * self.substeps + 1)
        before = at // self.substeps
        targets = commands[:, before].astype(np.float64)
        if self.interpolate and self.substeps > 1:
            fraction = (at % self.substeps / self.substeps)[:, None]
            after = np.minimum(before + 1, samples - 1)
            targets += fraction * (commands[:, after] - targets)
        controls = np.repeat(batch.bind("ctrl")[:, None], len(at), axis=1)
        columns = [
            int(self.model.actuator_ctrladr[self.model.actuator(name).id]) for name in self.inputs
        ]
        controls[:, :, columns] = targets
        return controls

    def _rest(self, batch: mujoco_batch.Batch, controls: NDArray, first: NDArray) -> None:
        """Put servos to rest at their first command (n, d_u), which delayed actuators hold."""
        model = self.model
        positions = batch.bind("qpos")
        for column, name in enumerate(self.inputs):
            servo = resting(model, name)
            if servo is not None:
                positions[:, servo[0]] = servo[1](first[:, column])
            actuator = model.actuator(name)
            if actuator.actnum[0] and actuator.dyntype[0] in FILTERS:
                batch.bind("act")[:, actuator.actadr[0]] = first[:, column]
        # The history of a delayed actuator is filled with its first command.
        delayed = np.flatnonzero(model.actuator_history[:, 0])
        data = mujoco.MjData(model)
        for i in range(len(controls) if len(delayed) else 0):
            for actuator in delayed:
                first_control = model.actuator_ctrladr[actuator]
                control = controls[i, 0, first_control:][: model.actuator_ctrlnum[actuator]]
                past = np.tile(control, (model.actuator_history[actuator, 0], 1))
                mujoco.mj_initCtrlHistory(model, data, int(actuator), None, past)
            batch.bind("history")[i] = data.history
        ahead = round(self.settle / model.opt.timestep)
        if ahead:
            batch.rollout(ahead, controls, record=("qpos",))

    def _lockable(self, actuator: int) -> int:
        """The degree of freedom that is locked when an actuator is stuck."""
        name = self.inputs[actuator]
        expected = "a stuck actuator that drives a hinge or slide joint"
        got = f"{name}, which drives something else"
        remedy = "give the fault to another actuator, or model it as a command fault"
        joint = given("faults", joint_of(self.model, name), expected, got=got, remedy=remedy)
        require(
            self.model.opt.integrator != int(mujoco.mjtIntegrator.mjINT_RK4),
            "faults",
            expected="an implicit integrator, which alone can lock a joint",
            got="RK4",
            remedy='set <option integrator="implicitfast"/> in the model',
        )
        return int(self.model.jnt_dofadr[joint])

    @cached_property
    def _columns(self) -> NDArray:
        """Columns of the sensors' components in the sensor data."""
        sensors = [self.model.sensor(name) for name in self.sensors]
        return np.concatenate([np.arange(s.adr[0], s.adr[0] + s.dim[0]) for s in sensors])


@contextmanager
def _without_log() -> Iterator[None]:
    """Suppress MuJoCo's log, a file in the current folder; failures are returned instead."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
