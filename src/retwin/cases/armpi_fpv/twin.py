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
from retwin.twins.faults import Fault
from retwin.twins.limits import Limits

if TYPE_CHECKING:
    from retwin.twins.mujoco import MuJoCoTwin

__all__ = ["ARM", "KINEMATIC", "MODEL", "POLL", "STRAIGHT", "UNIT", "ArmPiTwin"]

ARM = YawPitchArm(base=0.028505 + 0.0361, links=(0.10048, 0.094714, 0.05071))
MODEL = Path(__file__).with_name("armpi.xml")
"""The arm in MJCF."""
STRAIGHT = 500.0
"""The command at which a motor's angle is 0; commands go from 0 to 1000."""
UNIT = 0.24
"""Degrees per command unit; a motor's angle in degrees is 120 - 0.24 units."""
RATE = 100.0
POLL = 10
"""Samples per reading of the real arm's motors; between them its data are straight lines."""

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
"""The arm's kinematics behind a servo lag, fitted to the published twin."""


@dataclass(frozen=True)
class ArmPiTwin:
    """The arm as a MuJoCo model: masses and inertias of its URDF, servos with a transport delay.

    The servos' stiffness, damping and delay in `armpi.xml` are fitted to the published twin
    (docs/results.md). Commands are servo units; the output is the end-effector in m; `nominal` is
    the forward kinematics of the clean commands without any lag.

    Parameters
    ----------
    step: integration step in s; from 1 to 10 ms paths differ by less than 0.1 mm RMS.
    outside: "refuse" or "clip" commands outside 0 to 1000.
    threads: that simulate; 0 takes all cores. The result does not depend on it.

    """

    step: float = 0.005
    outside: Literal["refuse", "clip"] = "refuse"
    threads: int = 0

    @property
    def inputs(self) -> Channels:
        """Command channels: motors 1 to 4."""
        return KINEMATIC.inputs

    @property
    def outputs(self) -> Channels:
        """Output channels: the end-effector's position."""
        return KINEMATIC.outputs

    @property
    def rate(self) -> float:
        """Samples per second."""
        return RATE

    @property
    def limits(self) -> Limits:
        """What the servos accept."""
        return Limits((0.0,) * 4, (1000.0,) * 4, self.outside)

    @cached_property
    def physics(self) -> MuJoCoTwin:
        """The simulator inside."""
        from retwin.twins.mujoco import MuJoCoTwin

        return MuJoCoTwin(
            MODEL,
            inputs=self.inputs,
            sensors=("tip",),
            outputs=self.outputs,
            rate=RATE,
            step=self.step,
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
        """See `MuJoCoTwin.simulate`; `hidden` has the angles of the five joints in rad."""
        return self.physics.simulate(
            commands,
            faults=faults,
            seed=seed,
            progress=progress,
            parameters=parameters,
            hidden=hidden,
        )

    def respond(self, told: NDArray, frozen: NDArray, failed: dict[int, str]) -> NDArray:
        """Where motors 1 to 4 go, in command units (n, T, 4); see `MuJoCoTwin.respond`."""
        positions = self.physics.respond(told, frozen, failed)
        return STRAIGHT + positions[..., : len(self.inputs)] / KINEMATIC.scale
