"""`MuJoCoTwin`: any MJCF or URDF model; named actuators in, named sensors or places out."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import finite, one_of, positive, whole
from retwin.data.trajectories import Channels, Trajectories
from retwin.progress import Progress
from retwin.times import sample_rate
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.limits import Limits
from retwin.twins.mujoco.actuators import limits_of
from retwin.twins.mujoco.model import Servo, compiled, input_channels, output_channels
from retwin.twins.mujoco.simulation import MuJoCoSimulation
from retwin.twins.time_step import steps_per_sample
from retwin.twins.twin import Chunk, checked_commands, nominal_outputs, simulate_in_chunks
from retwin.twins.wrappers.parameter_values import values_per_simulation

__all__ = ["MuJoCoTwin", "Servo"]

TRAJECTORIES_PER_CHUNK = 128
"""Number of trajectories per batch: their states at every step take tens of MB."""


@dataclass(frozen=True)
class MuJoCoTwin:
    """A rigid-body model, integrated by MuJoCo on all cores.

    `MuJoCoTwin.from_file` makes one with names and units from the model. The delay of an actuator
    (`delay` and `nsample` in MJCF) acts as in the model.

    Parameters
    ----------
    path : Path
        MJCF or URDF file.
    inputs : Channels
        Actuators that the commands drive, in the model's control units.
    sensors : tuple of str
        The outputs: sensors by name; "joint:NAME" and "joint_velocity:NAME"; "site:NAME" and
        "body:NAME" for positions in m, "site_velocity:NAME" and "body_velocity:NAME" for velocities
        in m/s; bare names of sites, bodies and joints stand for their positions.
    outputs : Channels
        One channel per component of the sensors.
    rate : float
        Sample rate in Hz of commands and outputs, above 0.
    step : float, optional
        Integration step in s, which divides the sample period; by default the model's.
    interpolate : bool, default True
        Whether commands are linear between samples, or held.
    keyframe : str, default ""
        Keyframe of the model that gives the initial state and the controls of all other
        actuators; "" takes the first one, or the model's defaults where it has none.
    settle : float, default 0.0
        Duration in s for which the first commands are held before sample 0. With 0, position
        servos start at rest at their first command, everything else as in the keyframe.
    servos : tuple of (str, Servo), optional
        Position servos to add, by the joint that they drive: URDF files have no actuators.
    meshes : bool, default True
        Whether to load the meshes of the model, which are not needed where inertias are given.
    nominal : callable, optional
        From clean commands (n, T, d_u) to the ideal output (n, T, d_y); by default the twin's own
        output without faults.
    outside : {"refuse", "clip"}
        What is done with commands outside the actuators' control ranges.
    threads : int, default 0
        Threads that simulate; 0 takes all cores. The result does not depend on it.

    Raises
    ------
    InputError
        A rate or step that is not positive, or `settle` or `threads` below 0.

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
        sample_rate("rate", self.rate)
        if self.step is not None:
            positive("step", self.step, unit="s")
        finite("settle", self.settle, at_least=0.0, unit="s", remedy="leave it out")
        whole("threads", self.threads, remedy="leave it out to use all cores")

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
        """Make the twin of a file, with names and units from the model.

        Parameters
        ----------
        path : str or Path
            MJCF or URDF file.
        inputs : sequence of str, optional
            Actuators, in the order of the commands; by default all. One without a name has that of
            the joint that it drives.
        outputs : sequence of str, optional
            See `sensors` of the class, in order; by default all sensors of the model.
        rate, servos, meshes, **options
            See the parameters of the class.

        Returns
        -------
        MuJoCoTwin
            The twin.

        Raises
        ------
        InputError
            A file that cannot be compiled, a name that the model does not have, or a sample
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
        _ = twin.substeps, twin._keyframe_index
        return twin

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled model."""
        return compiled(
            self.path, servos=self.servos, places=self.sensors, step=self.step, meshes=self.meshes
        )

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the compiled model, which covers the files that its file includes or names."""
        compiled_model = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, compiled_model)
        return hashlib.sha256(compiled_model.tobytes()).hexdigest()

    @cached_property
    def limits(self) -> Limits | None:
        """Control ranges of the actuators; None where no actuator is limited."""
        found = limits_of(self.model, self.inputs.names)
        if found is None:
            return None
        low, high = found
        return Limits(tuple(low.tolist()), tuple(high.tolist()), self.outside)

    @property
    def substeps(self) -> int:
        """Integration steps per sample.

        Raises
        ------
        InputError
            The step does not divide the sample period.

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
        """See `TakesParameters.simulate`; a stuck actuator's joint is locked from the onset on.

        Parameters
        ----------
        commands, faults, seed, progress
            See `Twin.simulate`.
        parameters : mapping of str to array_like, optional
            Model fields per simulation, each () or (n,), by their place in the model:
            "body.link_2.mass", "actuator.motor_3.gainprm[0]", "opt.gravity[2]".
        hidden : dict, optional
            For tests, filled with the states of the simulation with faults: "positions"
            (n, T, nq) and "velocities" (n, T, nv), in rad and m.

        Returns
        -------
        Trajectories
            See `Twin.simulate`.

        Raises
        ------
        InputError
            As `Twin.simulate`; parameters that the model does not have or that are not one for
            all or one each; a stuck actuator whose joint cannot be locked.
        SimulationError
            Simulations that became unstable.

        """
        commands = checked_commands(commands, self.inputs)
        values = values_per_simulation(parameters, len(commands))
        states: list[tuple[NDArray, NDArray]] = []

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            own = {name: each[chunk.index] for name, each in values.items()}
            result = self._simulation.integrate(
                chunk.faulty_commands, chunk.frozen, own, states=hidden is not None
            )
            chunk.failed.update(result.failed)
            states.append((result.positions, result.velocities))
            if self.nominal is not None:
                ideal = nominal_outputs(self.nominal, chunk.commands, len(self.outputs))
                return ideal, result.outputs
            nominal = result.outputs.copy()
            faulty = np.flatnonzero([fault is not None for fault in chunk.faults])
            if len(faulty):
                never = np.full((len(faulty), len(self.inputs)), commands.shape[1])
                some = {name: each[faulty] for name, each in own.items()}
                healthy = self._simulation.integrate(chunk.commands[faulty], never, some)
                nominal[faulty] = healthy.outputs
                chunk.failed.update({int(faulty[i]): why for i, why in healthy.failed.items()})
            return nominal, result.outputs

        simulated = simulate_in_chunks(
            self, run, commands, faults, seed=seed, progress=progress, size=TRAJECTORIES_PER_CHUNK
        )
        if hidden is not None:
            hidden["positions"] = np.concatenate([positions for positions, _ in states])
            hidden["velocities"] = np.concatenate([velocities for _, velocities in states])
        return simulated

    def respond(self, commands: NDArray, frozen: NDArray, failed: dict[int, str]) -> NDArray:
        """Integrate the response of the joints; for twins that wrap this one.

        Parameters
        ----------
        commands : ndarray, shape (n, T, d_u)
            Effective commands.
        frozen : ndarray of int, shape (n, d_u)
            Sample from which an actuator's joint is locked, T for never.
        failed : dict of int to str
            Filled with the trajectories that could not be simulated, and the reasons.

        Returns
        -------
        ndarray, shape (n, T, nq)
            Positions of all joints, in rad and m.

        """
        result = self._simulation.integrate(commands, frozen, {}, states=True)
        failed.update(result.failed)
        return result.positions

    @cached_property
    def _simulation(self) -> MuJoCoSimulation:
        """The integration of the model."""
        return MuJoCoSimulation(
            self.model,
            self.inputs.names,
            self.sensors,
            keyframe=self._keyframe_index,
            substeps=self.substeps,
            interpolate=self.interpolate,
            settle=self.settle,
            threads=self.threads,
        )

    @cached_property
    def _keyframe_index(self) -> int:
        """The keyframe to start from; -1 for the model's defaults."""
        names = [self.model.key(i).name for i in range(self.model.nkey)]
        if not self.keyframe:
            return 0 if names else -1
        remedy = "check the spelling, or leave it out"
        one_of("keyframe", self.keyframe, names, remedy=remedy)
        return names.index(self.keyframe)
