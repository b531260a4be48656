"""`MuJoCoTwin`: any MJCF or URDF model; named actuators in, named sensors or places out."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
from mujoco import batch as mujoco_batch
from numpy.typing import ArrayLike, NDArray

from retwin.checks import positive
from retwin.data.trajectories import Channels, Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.twins.faults import Fault
from retwin.twins.limits import Limits
from retwin.twins.mujoco_model import (
    FILTERS,
    Servo,
    compiled,
    input_channels,
    joint_of,
    limits_of,
    output_channels,
    resting,
)
from retwin.twins.mujoco_parameters import per_simulation, set_parameter
from retwin.twins.time_step import steps_per_sample
from retwin.twins.twin import Chunk, checked_commands, nominal_outputs, simulate_in_chunks

__all__ = ["MuJoCoTwin", "Servo"]

LOCKED = 1e12
"""Damping in N m s/rad (N s/m) of a joint that is held: under tons it creeps by less than 1 um."""
TRAJECTORIES_PER_CHUNK = 128
"""Trajectories per batch: their records at every step take tens of MB."""


@dataclass(frozen=True)
class MuJoCoTwin:
    """A rigid-body model, integrated by MuJoCo on all cores.

    Make it with `MuJoCoTwin.from_file`, which takes names and units from the model. An actuator's
    own delay (`delay` and `nsample` in MJCF) is at work as the model says.

    Parameters
    ----------
    path: MJCF or URDF file.
    inputs: actuators that the commands drive, in the model's control units.
    sensors: sensors, sites or bodies that are the outputs; the latter give their position in m.
    outputs: one channel per component of the sensors.
    rate: samples per second of commands and outputs.
    step: integration step in s; None takes the model's. The sample period is a multiple of it.
    interpolate: whether commands are joined linearly between samples, or held.
    keyframe: the model's keyframe to start from, and to take the controls of all other actuators
        from; "" takes the first one, or the model's defaults where it has none.
    settle: s for which the first commands are held before sample 0. With 0, position servos start
        at rest where their first command says, everything else as in the keyframe.
    servos: position servos to add, by the joint they drive: URDF files have no actuators.
    meshes: whether to load the meshes a model names; they are not needed where inertias are given.
    nominal: the ideal output (n, T, d_y) for clean commands (n, T, d_u); None takes the twin's own
        healthy output.
    outside: "refuse" or "clip" commands outside the actuators' control ranges.
    threads: that simulate; 0 takes all cores. The result does not depend on it.

    Raises
    ------
    InputError: a rate or step that is not positive; `settle` or `threads` below 0.

    """

    path: Path
    inputs: Channels
    sensors: tuple[str, ...]
    outputs: Channels
    rate: float
    step: float | None = None
    interpolate: bool = True
    keyframe: str = ""
    settle: float = 0.0
    servos: tuple[tuple[str, Servo], ...] = ()
    meshes: bool = True
    nominal: Callable[[NDArray], NDArray] | None = None
    outside: Literal["refuse", "clip"] = "refuse"
    threads: int = 0

    def __post_init__(self) -> None:
        positive("rate", self.rate, unit="Hz")
        if self.step is not None:
            positive("step", self.step, unit="s")
        for name, unit in (("settle", "s"), ("threads", "threads, or 0 for all cores")):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InputError(
                    name,
                    expected=f"at least 0 {unit}",
                    got=repr(value),
                    remedy="leave it out",
                )

    @classmethod
    def from_file(
        cls,
        path: str | Path,
        *,
        inputs: Sequence[str] = (),
        outputs: Sequence[str] = (),
        rate: float = 100.0,
        servos: Sequence[tuple[str, Servo]] = (),
        meshes: bool = True,
        **options: object,
    ) -> MuJoCoTwin:
        """The twin of a file, with names and units from the model.

        Parameters
        ----------
        path: MJCF or URDF file.
        inputs: actuators, in the order of the commands; by default all.
        outputs: sensors, sites and bodies, in order; by default all sensors.
        rate, servos, meshes, options: see the attributes of the class.

        Raises
        ------
        InputError: a file that cannot be compiled, a name that the model does not have, a sample
            period that is no multiple of the step.

        """
        model = compiled(Path(path), servos=servos, places=outputs, meshes=meshes)
        sensors, channels = output_channels(model, outputs)
        twin = cls(
            Path(path).resolve(),
            input_channels(model, inputs),
            sensors,
            channels,
            rate,
            servos=tuple(servos),
            meshes=meshes,
            **options,  # type: ignore[arg-type]
        )
        _ = twin.substeps, twin._start
        return twin

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled model."""
        return compiled(
            self.path, servos=self.servos, places=self.sensors, step=self.step, meshes=self.meshes
        )

    @property
    def fingerprint(self) -> str:
        """The SHA-256 of the compiled model: of all that its file includes and names, too."""
        whole = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, whole)
        return hashlib.sha256(whole.tobytes()).hexdigest()

    @cached_property
    def limits(self) -> Limits | None:
        """The control ranges of the actuators, where they are limited."""
        found = limits_of(self.model, self.inputs.names)
        if found is None:
            return None
        low, high = found
        return Limits(tuple(low.tolist()), tuple(high.tolist()), self.outside)

    @property
    def substeps(self) -> int:
        """Integration steps per sample.

        Raises InputError when the step does not divide the sample period.
        """
        return steps_per_sample(self.rate, self.model.opt.timestep)

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
        hidden: dict[str, NDArray] | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`; a stuck actuator's joint is locked where it stands at the onset.

        Parameters
        ----------
        commands, faults, seed, progress: as in `Twin.simulate`.
        parameters: model fields per simulation, (n,) or one for all, by their place in the model:
            "body.link_2.mass", "actuator.motor_3.gainprm[0]", "opt.gravity[2]".
        hidden: filled with what no sensor shows, for tests: "positions" (n, T, nq) and
            "velocities" (n, T, nv), in rad and m, of the simulation with faults.

        A simulation that becomes unstable ends alone: see `SimulationError`.

        Raises
        ------
        InputError: as in `Twin.simulate`; parameters that the model does not have or that are not
            one for all or one each; a stuck actuator whose joint cannot be locked.

        """
        commands = checked_commands(commands, self.inputs)
        values = per_simulation(parameters, len(commands))
        states: list[tuple[NDArray, NDArray]] = []

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            own = {name: each[chunk.index] for name, each in values.items()}
            some = np.arange(len(chunk.commands))
            observed, *state = self._integrate(
                chunk.faulty_commands,
                chunk.frozen,
                own,
                some,
                chunk.failed,
                states=hidden is not None,
            )
            if hidden is not None:
                states.append((state[0], state[1]))
            if self.nominal is not None:
                return nominal_outputs(self.nominal, chunk.commands, len(self.outputs)), observed
            nominal = observed.copy()
            faulty = np.flatnonzero([fault is not None for fault in chunk.faults])
            if len(faulty):
                never = np.full((len(faulty), len(self.inputs)), commands.shape[1])
                nominal[faulty], *_ = self._integrate(
                    chunk.commands[faulty], never, own, faulty, chunk.failed
                )
            return nominal, observed

        made = simulate_in_chunks(
            self, run, commands, faults, seed=seed, progress=progress, size=TRAJECTORIES_PER_CHUNK
        )
        if hidden is not None:
            hidden["positions"] = np.concatenate([positions for positions, _ in states])
            hidden["velocities"] = np.concatenate([velocities for _, velocities in states])
        return made

    def respond(self, told: NDArray, frozen: NDArray, failed: dict[int, str]) -> NDArray:
        """Positions of all joints (n, T, nq) when the actuators are told `told` (n, T, d_u).

        For twins built around this one. `frozen` (n, d_u): the sample from which an actuator's
        joint is locked, T for never. `failed` is filled with what could not be simulated.
        """
        return self._integrate(told, frozen, {}, np.arange(len(told)), failed, states=True)[1]

    def _integrate(
        self,
        commands: NDArray,
        frozen: NDArray,
        parameters: Mapping[str, NDArray],
        rows: NDArray,
        failed: dict[int, str],
        *,
        states: bool = False,
    ) -> tuple[NDArray, ...]:
        """Outputs (n, T, d_y), and on demand positions and velocities, for commands (n, T, d_u).

        `frozen` (n, d_u): the sample from which a joint is locked. `rows`: which trajectories of
        the chunk these are, to choose their parameters and to name those that fail.
        """
        steps = commands.shape[1]
        batch = mujoco_batch.Batch(self.model, len(commands), self.threads)
        wanted = ("sensordata", "qpos", "qvel") if states else ("sensordata",)
        with _quiet():
            for name, values in parameters.items():
                set_parameter(batch, name, values[rows])
            if parameters:
                batch.set_const()
            batch.reset(keyframe=self._start)
            controls = self._controls(batch, commands)
            self._rest(batch, controls[:, :1], commands[:, 0])
            made = self._roll(batch, controls, frozen, steps, wanted)
        for i in np.flatnonzero(batch.warning[:, :, 1].any(axis=1)):
            kind = int(np.argmax(batch.warning[i, :, 1] > 0))
            failed[int(rows[i])] = mujoco.mju_warningText(kind, int(batch.warning[i, kind, 0]))
        return tuple(made[name] for name in wanted)

    def _roll(
        self,
        batch: mujoco_batch.Batch,
        controls: NDArray,
        frozen: NDArray,
        steps: int,
        wanted: Sequence[str],
    ) -> dict[str, NDArray]:
        """The wanted fields at every sample, (n, T, size); joints are locked on the way."""
        sub, last = self.substeps, controls.shape[1]
        made = {}
        for name in wanted:
            width = self._columns if name == "sensordata" else slice(None)
            made[name] = np.empty((len(controls), steps, *batch.bind(name)[0, width].shape))
            made[name][:, 0] = batch.bind(name)[:, width]
        held = frozen < steps
        damping = batch.expand("dof_damping") if held.any() else np.empty(0)
        # From one onset to the next all simulations go on together.
        marks = np.unique(np.append(sub * frozen[held], [0, last]))
        for begin, end in pairwise(marks):
            for i, actuator in np.argwhere(held & (sub * frozen == begin)):
                dof = self._lockable(int(actuator))
                damping[i, dof] = LOCKED
                batch.bind("qvel")[i, dof] = 0.0
            part = batch.rollout(int(end - begin), controls[:, begin:end], record=wanted)
            for name in wanted:
                # A sensor says what was before a step, a state what is after it.
                at = np.arange(begin, end) + (name != "sensordata")
                keep = (at % sub == 0) & (at < steps * sub)
                width = self._columns if name == "sensordata" else slice(None)
                made[name][:, at[keep] // sub] = part[name][:, keep][:, :, width]
        return made

    def _controls(self, batch: mujoco_batch.Batch, commands: NDArray) -> NDArray:
        """Controls of all actuators at every step until the last sample, (n, steps, nu)."""
        samples = commands.shape[1]
        at = np.arange((samples - 1) * self.substeps + 1)
        before = at // self.substeps
        told = commands[:, before].astype(np.float64)
        if self.interpolate and self.substeps > 1:
            share = (at % self.substeps / self.substeps)[:, None]
            told += share * (commands[:, np.minimum(before + 1, samples - 1)] - told)
        controls = np.repeat(batch.bind("ctrl")[:, None], len(at), axis=1)
        columns = [
            int(self.model.actuator_ctrladr[self.model.actuator(name).id])
            for name in self.inputs.names
        ]
        controls[:, :, columns] = told
        return controls

    def _rest(self, batch: mujoco_batch.Batch, controls: NDArray, first: NDArray) -> None:
        """Put servos where their first command says, and let that command have been there."""
        model = self.model
        positions = batch.bind("qpos")
        for column, name in enumerate(self.inputs.names):
            servo = resting(model, name)
            if servo is not None:
                positions[:, servo[0]] = servo[1](first[:, column])
            actuator = model.actuator(name)
            if actuator.actnum[0] and actuator.dyntype[0] in FILTERS:
                batch.bind("act")[:, actuator.actadr[0]] = first[:, column]
        # A delayed actuator looks back at what it was told: the first command, for ever.
        delayed = np.flatnonzero(model.actuator_history[:, 0])
        data = mujoco.MjData(model)
        for i in range(len(controls) if len(delayed) else 0):
            for actuator in delayed:
                first_control = model.actuator_ctrladr[actuator]
                told = controls[i, 0, first_control:][: model.actuator_ctrlnum[actuator]]
                past = np.tile(told, (model.actuator_history[actuator, 0], 1))
                mujoco.mj_initCtrlHistory(model, data, int(actuator), None, past)
            batch.bind("history")[i] = data.history
        ahead = round(self.settle / model.opt.timestep)
        if ahead:
            batch.rollout(ahead, controls, record=("qpos",))

    def _lockable(self, actuator: int) -> int:
        """The degree of freedom to lock when an actuator is stuck."""
        name = self.inputs.names[actuator]
        joint = joint_of(self.model, name)
        if joint is None:
            raise InputError(
                "faults",
                expected="a stuck actuator that drives a hinge or slide joint",
                got=f"{name}, which drives something else",
                remedy="give the fault to another actuator, or model it as a command fault",
            )
        if self.model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4):
            raise InputError(
                "faults",
                expected="an implicit integrator, which alone can lock a joint",
                got="RK4",
                remedy='set <option integrator="implicitfast"/> in the model',
            )
        return int(self.model.jnt_dofadr[joint])

    @cached_property
    def _columns(self) -> NDArray:
        """Where the sensors' components are in the sensor data."""
        sensors = [self.model.sensor(name) for name in self.sensors]
        return np.concatenate([np.arange(s.adr[0], s.adr[0] + s.dim[0]) for s in sensors])

    @cached_property
    def _start(self) -> int:
        """The keyframe to start from; -1 for the model's defaults."""
        names = [self.model.key(i).name for i in range(self.model.nkey)]
        if not self.keyframe:
            return 0 if names else -1
        if self.keyframe not in names:
            raise InputError(
                "keyframe",
                expected=f"one of the model's: {', '.join(names) or 'it has none'}",
                got=repr(self.keyframe),
                remedy="check the spelling, or leave it out",
            )
        return names.index(self.keyframe)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without MuJoCo's own log, which goes to a file in the current folder: failures are named."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
