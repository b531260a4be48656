"""`TwinSubject`: a twin, with the commands and faults for its contract checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.segments import Segments
from retwin.data.trajectories import Trajectories
from retwin.twins.faults.actuator_faults import Fault, Stuck
from retwin.twins.faults.applied_faults import draw_faults, faulty_commands, frozen_response
from retwin.twins.twin import Twin


@dataclass(frozen=True, eq=False)
class TwinSubject:
    """A twin, and the commands and faults with which it is checked.

    Parameters
    ----------
    twin : Twin
        The twin.
    commands : ndarray, shape (n, T, d_u)
        Commands that the twin can follow: at least two trajectories that move, of at least eight
        samples. A few short ones suffice.
    faults : sequence of Fault or None, optional
        One per trajectory, None for a healthy one, some of each; the faults must change the twin's
        output. By default the first trajectory is healthy, and in each of the others one actuator
        is stuck from some sample before its last movement.

    Raises
    ------
    InputError
        Commands or faults that the checks cannot use.

    """

    twin: Twin
    commands: NDArray
    faults: Sequence[Fault | None] = ()

    def __post_init__(self) -> None:
        shape = np.shape(self.commands)
        fits = len(shape) == 3 and shape[0] >= 2 and shape[1] >= 8
        expected = "numbers of shape (n, T, d_u), n at least 2 and T at least 8"
        remedy = "give a few short trajectories that the twin can follow"
        require(fits, "commands", expected=expected, got=f"shape {shape}", remedy=remedy)
        if not self.faults:
            rate = getattr(self.twin, "rate", 1.0)  # a twin without one fails its first check
            stuck = [_stuck(each, number, rate) for number, each in enumerate(self.commands[1:])]
            object.__setattr__(self, "faults", (None, *stuck))
        healthy = sum(fault is None for fault in self.faults)
        fits = len(self.faults) == shape[0] and 0 < healthy < shape[0]
        expected = f"{shape[0]}, one per trajectory, some None and some not"
        got = f"{len(self.faults)}, {healthy} of them None"
        remedy = "give None for a healthy trajectory, or leave faults out"
        require(fits, "faults", expected=expected, got=got, remedy=remedy)

    def simulate(
        self,
        commands: NDArray | None = None,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int = 0,
    ) -> Trajectories:
        """Simulate with the twin.

        Parameters
        ----------
        commands : ndarray, shape (n, T, d_u), optional
            By default the subject's.
        faults, seed
            See `Twin.simulate`.

        Returns
        -------
        Trajectories
            See `Twin.simulate`.

        """
        commands = self.commands.copy() if commands is None else commands
        return self.twin.simulate(commands, faults=faults, seed=seed)

    def drawn(self, seed: int) -> list[Fault | None]:
        """The subject's faults with severities drawn.

        Parameters
        ----------
        seed : int
            See `draw_faults`.

        Returns
        -------
        list of Fault or None
            One per trajectory.

        """
        segments = Segments.from_commands(self.commands)
        return draw_faults(self.faults, segments, seed, rate=self.twin.rate)

    def affected(self, seed: int) -> NDArray:
        """Whether the faults change the reference or the response of the actuators.

        Parameters
        ----------
        seed : int
            See `draw_faults`.

        Returns
        -------
        ndarray of bool, shape (n,)
            One per trajectory.

        """
        drawn, rate = self.drawn(seed), self.twin.rate
        segments = Segments.from_commands(self.commands)
        effective = faulty_commands(self.commands, drawn, segments, rate=rate)
        return (frozen_response(effective, drawn, rate=rate) != self.commands).any(axis=(1, 2))


def _stuck(commands: NDArray, number: int, rate: float) -> Stuck:
    """A fault of an actuator that moves in (T, d_u), another actuator for each number."""
    moving = np.diff(commands, axis=0) != 0
    actuators = np.flatnonzero(moving.any(axis=0))
    if len(actuators) == 0:
        return Stuck(0, onset=0.0)
    actuator = int(actuators[number % len(actuators)])
    return Stuck(actuator, onset=(0.0, np.flatnonzero(moving[:, actuator])[-1] / rate))
