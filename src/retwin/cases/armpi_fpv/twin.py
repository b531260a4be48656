"""The Hiwonder ArmPi FPV as twins: a MuJoCo model, perhaps with parameters, and a closed form."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from retwin.cases.armpi_fpv.kinematics import YawPitchArm
from retwin.data.trajectories import Channels, Trajectories
from retwin.twins.faults.applied_faults import frozen_response
from retwin.twins.limits import Limits
from retwin.twins.twin import Chunk, ChunkedTwin, Twin
from retwin.twins.wrappers.command_side import CommandSide, command_side_parameters
from retwin.twins.wrappers.parametric import Parameter, ParametricTwin
from retwin.twins.wrappers.wrapper import OfTwin

if TYPE_CHECKING:
    from retwin.twins.mujoco.twin import MuJoCoTwin


@dataclass(frozen=True)
class ServoLag:
    """A joint's closed position loop, (P s + I) / ((1 + P) s + I), of unit gain.

    Parameters
    ----------
    proportional : float
        Proportional gain P of the loop, without unit.
    integral : float
        Integral gain I of the loop in 1/s, above 0; a ramp is followed with a lag of 1/I.

    """

    proportional: float
    integral: float

    @property
    def seconds(self) -> float:
        """Lag in s with which a ramp is followed."""
        return 1.0 / self.integral

    def respond(self, commands: NDArray, rate: float) -> NDArray:
        """Response to commands, from rest at the first command of every actuator.

        Parameters
        ----------
        commands : ndarray, shape (n, T, d_u)
            Commands, linear between samples.
        rate : float
            Sample rate in Hz.

        Returns
        -------
        ndarray, shape (n, T, d_u)
            The response in command units.

        """
        # Imported here, since it takes longer than all that a description of the twin needs.
        from scipy.signal import cont2discrete, lfilter

        loop = ([self.proportional, self.integral], [1.0 + self.proportional, self.integral])
        numerator, denominator, _ = cont2discrete(loop, 1.0 / rate, method="foh")
        rest = commands[:, :1]
        return rest + lfilter(numerator.ravel(), denominator, commands - rest, axis=1)


@dataclass(frozen=True)
class KinematicTwin(ChunkedTwin):
    """An arm whose joints follow their commands with a lag.

    The nominal output is the forward kinematics of the clean commands without lag. The lagged
    response of a stuck actuator is held.

    Parameters
    ----------
    arm : YawPitchArm
        The kinematics.
    centre : float
        Command at which a joint's angle is 0.
    scale : float
        Angle in rad per command unit.
    lag : ServoLag, optional
        The joints' closed loop; None follows without lag.
    inputs, outputs : Channels
        Channels of commands and outputs.
    rate : float
        Sample rate in Hz.
    limits : Limits, optional
        Range of the commands.

    """

    arm: YawPitchArm
    centre: float
    scale: float
    lag: ServoLag | None
    inputs: Channels
    outputs: Channels
    rate: float
    limits: Limits | None = None

    def angles(self, commands: NDArray) -> NDArray:
        """Joint angles of commands or responses.

        Parameters
        ----------
        commands : ndarray, any shape
            In command units.

        Returns
        -------
        ndarray, same shape
            Angles in rad.

        """
        return (commands - self.centre) * commands.dtype.type(self.scale)

    def position(self, commands: NDArray) -> NDArray:
        """End-effector position when every joint is at its command.

        Parameters
        ----------
        commands : ndarray, shape (..., joints)
            In command units.

        Returns
        -------
        ndarray, shape (..., 3)
            Position in m.

        """
        return self.arm.position(self.angles(commands))

    def respond(self, commands: NDArray) -> NDArray:
        """Response of the joints to commands.

        Parameters
        ----------
        commands : ndarray, shape (n, T, d_u)
            In command units.

        Returns
        -------
        ndarray, shape (n, T, d_u)
            Joint positions in command units.

        """
        return commands if self.lag is None else self.lag.respond(commands, self.rate)

    def _run(self, chunk: Chunk) -> tuple[NDArray, NDArray]:
        """Nominal and observed outputs of a chunk."""
        response = frozen_response(
            self.respond(chunk.faulty_commands), chunk.faults, rate=self.rate
        )
        return self.position(chunk.commands), self.position(response)


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
class ArmPiTwin(OfTwin):
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
    def _inner(self) -> Twin:
        """What has the same channels; no model is compiled to state them."""
        return KINEMATIC

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

    def simulate(self, commands: NDArray, **options: Any) -> Trajectories:
        """See `MuJoCoTwin.simulate`; `hidden` gets the angles of the five joints in rad."""
        return self.physics.simulate(commands, **options)

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


SERVOS = tuple(f"actuator.motor_{i}" for i in range(1, 6))
GAIN, DAMPING = 0.008, 0.000082
"""Gains of the servos in `armpi.xml`, per command unit."""
PER_RAD = KINEMATIC.scale**2
"""Factor from a gain in N m/rad (N m s/rad) to the gain in `armpi.xml`, in command units."""


def armpi_parametric(arm: ArmPiTwin | None = None) -> ParametricTwin:
    """The MuJoCo arm with seven free parameters, at the values of `armpi.xml`.

    | parameter | unit | range |
    |---|---|---|
    | `stiffness`, of all servos | N m/rad | 150 to 900 |
    | `damping`, of all servos | N m s/rad | 1 to 40 |
    | `delay`, beyond the servos' own | s | 0 to 0.2 |
    | `offset.motor_1` … `offset.motor_4` | command units of 0.24 degrees | -25 to 25 |

    Parameters
    ----------
    arm : ArmPiTwin, optional
        By default that of the case. Its `outside` must be "refuse" and its step at most 5 ms: with
        longer steps the stiffest and least damped arms in this range become unstable, and a fit to
        data prefers parameters close to instability, where integration noise imitates data noise.

    Returns
    -------
    ParametricTwin
        The arm behind `CommandSide`.

    """
    arm = ArmPiTwin() if arm is None else arm
    gains = {"gainprm[0]": 1.0, "biasprm[0]": -STRAIGHT, "biasprm[1]": -1.0}
    places = {f"{servo}.{key}": gains[key] * PER_RAD for servo in SERVOS for key in gains}
    stiffness = Parameter("stiffness", "N m/rad", 150.0, 900.0, GAIN / PER_RAD, places)
    places = {f"{servo}.biasprm[2]": -PER_RAD for servo in SERVOS}
    damping = Parameter("damping", "N m s/rad", 1.0, 40.0, DAMPING / PER_RAD, places)
    free = command_side_parameters(KINEMATIC.inputs, delay=(0.0, 0.2), offset=25.0)
    return ParametricTwin(CommandSide(arm, nominal=KINEMATIC.position), (stiffness, damping, *free))
