"""The ArmPi arm with its uncertain quantities as parameters (Eq. 2, 3)."""

from __future__ import annotations

from retwin.cases.armpi_fpv.twin import KINEMATIC, STRAIGHT, ArmPiTwin
from retwin.twins.wrappers.command_side import CommandSide, command_side_parameters
from retwin.twins.wrappers.parametric import Parameter, ParametricTwin

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
