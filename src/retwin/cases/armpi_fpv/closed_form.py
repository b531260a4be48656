"""`KinematicTwin`: closed-form forward kinematics behind a linear servo lag, vectorised."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import NDArray

from retwin.cases.armpi_fpv.kinematics import YawPitchArm
from retwin.data.trajectories import Channels
from retwin.twins.faults.applied_faults import frozen_response
from retwin.twins.limits import Limits
from retwin.twins.twin import Chunk, ChunkedTwin


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
