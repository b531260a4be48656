"""The Hiwonder ArmPi FPV as twins: a MuJoCo model of it, and its kinematics in closed form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.cases.armpi_fpv.closed_form import KinematicTwin, ServoLag
from retwin.cases.armpi_fpv.kinematics import YawPitchArm
from retwin.data.trajectories import Channels, Trajectories
from retwin.progress import Progress
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.limits import Limits

if TYPE_CHECKING:
    from retwin.twins.mujoco.twin import MuJoCoTwin


ARM = YawPitchArm(base=0.028505 + 0.0361, links=(0.10048, 0.094714, 0.05071))
"""Kinematics of the arm, with the lengths of its URDF."""
MODEL = Path(__file__).with_name("armpi.xml")
"""Path of the arm's MJCF file."""
STRAIGHT = 500.0
"""Command at which a motor's angle is 0, in units; commands go from 0 to 1000."""
UNIT = 0.24
"""Degrees per command unit; a motor's angle in degrees is 120 - 0.24 units."""
RATE = 100.0
"""Sample rate in Hz of the published data."""
SENSOR_RATE = 10.0
"""Rate in Hz of the sensor of the real arm, whose data are linear between its samples."""
RAMPS = (60, 80, 100)
"""Possible durations of a motor's ramp in samples at `RATE`, as in the published data."""

KINEMATIC = KinematicTwin(
    ARM,
    centre=STRAIGHT,
    scale=-np.deg2rad(UNIT),
    lag=ServoLag(proportional=-0.515, integral=48.7),
    inputs=Channels(tuple(f"motor_{i}" for i in range(1, 5)), ("0.24 deg",) * 4),
    outputs=Channels(("x", "y", "z"), ("m",) * 3),
    rate=RATE,
    limits=Limits((0.0,) * 4, (1000.0,) * 4),
)
"""The arm's kinematics behind a servo lag that is fitted to the published twin."""


@dataclass(frozen=True)
class ArmPiTwin:
    """The arm as a MuJoCo model: masses and inertias of its URDF, servos with a transport delay.

    The servos' stiffness, damping and delay in `armpi.xml` are fitted to the published twin
    (benchmarks/results/arm.md). Commands are in servo units, the output is the end-effector
    position in m. The nominal output is the forward kinematics of the clean commands without lag.

    Parameters
    ----------
    step : float, default 0.005
        Integration step in s; between 1 and 10 ms paths differ by less than 0.1 mm RMS.
    outside : {"refuse", "clip"}
        What is done with commands outside 0 to 1000.
    threads : int, default 0
        Threads that simulate; 0 takes all cores. The result does not depend on it.
    rate : float, default 100.0
        Sample rate in Hz; where a sample is shorter than `step`, it is one step.

    """

    step: float = 0.005
    outside: Literal["refuse", "clip"] = "refuse"
    threads: int = 0
    rate: float = RATE

    @property
    def inputs(self) -> Channels:
        """Command channels: motors 1 to 4."""
        return KINEMATIC.inputs

    @property
    def outputs(self) -> Channels:
        """Output channels: the end-effector's position."""
        return KINEMATIC.outputs

    @property
    def limits(self) -> Limits:
        """Range of the commands that the servos accept."""
        return Limits((0.0,) * 4, (1000.0,) * 4, self.outside)

    @cached_property
    def physics(self) -> MuJoCoTwin:
        """The MuJoCo model that simulates."""
        from retwin.twins.mujoco.twin import MuJoCoTwin

        return MuJoCoTwin(
            MODEL,
            inputs=self.inputs,
            sensors=("tip",),
            outputs=self.outputs,
            rate=self.rate,
            step=min(self.step, 1 / self.rate),
            nominal=KINEMATIC.position,
            outside=self.outside,
            threads=self.threads,
        )

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
        """See `MuJoCoTwin.simulate`; `hidden` gets the angles of the five joints in rad."""
        return self.physics.simulate(
            commands,
            faults=faults,
            seed=seed,
            progress=progress,
            parameters=parameters,
            hidden=hidden,
        )

    def respond(self, commands: NDArray, frozen: NDArray, failed: dict[int, str]) -> NDArray:
        """Integrate the response of motors 1 to 4.

        Parameters
        ----------
        commands, frozen, failed
            See `MuJoCoTwin.respond`.

        Returns
        -------
        ndarray, shape (n, T, 4)
            Angles in command units.

        """
        positions = self.physics.respond(commands, frozen, failed)
        return STRAIGHT + positions[..., : len(self.inputs)] / KINEMATIC.scale
