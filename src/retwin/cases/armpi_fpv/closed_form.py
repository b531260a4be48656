"""`KinematicTwin`: closed-form forward kinematics behind a linear servo lag, vectorised."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

from retwin.cases.armpi_fpv.kinematics import YawPitchArm
from retwin.data.trajectories import Channels, Trajectories
from retwin.progress import Progress
from retwin.twins.faults import Fault, frozen_response
from retwin.twins.limits import Limits
from retwin.twins.twin import Chunk, simulate_in_chunks

__all__ = ["KinematicTwin", "ServoLag"]


@dataclass(frozen=True)
class ServoLag:
    """A joint's closed position loop, (P s + I) / ((1 + P) s + I): unit gain, lag 1/I on a ramp.

    Parameters
    ----------
    proportional, integral: the loop's gains P (no unit) and I (1/s).

    """

    proportional: float
    integral: float

    @property
    def seconds(self) -> float:
        """How far a ramp is followed behind its command, in s."""
        return 1.0 / self.integral

    def respond(self, commands: NDArray, rate: float) -> NDArray:
        """The response (n, T, d_u) to commands sampled at `rate`, linear between samples.

        Every actuator starts at rest at its first command.
        """
        loop = ([self.proportional, self.integral], [1.0 + self.proportional, self.integral])
        numerator, denominator, _ = cont2discrete(loop, 1.0 / rate, method="foh")
        rest = commands[:, :1]
        return rest + lfilter(numerator.ravel(), denominator, commands - rest, axis=1)


@dataclass(frozen=True)
class KinematicTwin:
    """An arm whose joints follow their commands with a lag.

    Parameters
    ----------
    arm: the kinematics.
    centre: command at which a joint's angle is 0.
    scale: rad per command unit.
    lag: the joints' closed loop; None follows at once.
    inputs, outputs: channels of commands and outputs.
    rate: samples per second.
    limits: of the commands, if there are any.

    `nominal` is the forward kinematics of the clean commands without lag.

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
        """Joint angles in rad for commands or responses in command units, any leading shape."""
        return (commands - self.centre) * commands.dtype.type(self.scale)

    def position(self, commands: NDArray) -> NDArray:
        """End-effector (..., 3) in m when every joint stands where its command says."""
        return self.arm.position(self.angles(commands))

    def respond(self, commands: NDArray) -> NDArray:
        """Where the joints go, in command units (n, T, d_u)."""
        return commands if self.lag is None else self.lag.respond(commands, self.rate)

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`; stuck actuators are held in their response, behind the lag."""
        return simulate_in_chunks(self, self._run, commands, faults, seed=seed, progress=progress)

    def _run(self, chunk: Chunk) -> tuple[NDArray, NDArray]:
        response = frozen_response(self.respond(chunk.faulty_commands), chunk.faults)
        return self.position(chunk.commands), self.position(response)
