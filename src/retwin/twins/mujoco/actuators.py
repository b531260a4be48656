"""Actuators of a MuJoCo model: their joints, limits, rest positions and units."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

# As plain numbers: MuJoCo's enumerations do not equal the numbers that its arrays hold.
HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
DIRECT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
FIXED, AFFINE = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_AFFINE)
FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
"""Dynamics of actuators that follow their control with a lag."""
FOLLOWING = (int(mujoco.mjtDyn.mjDYN_NONE), *FILTERS)
"""Dynamics of actuators whose gain acts on their control, and not for instance on its integral."""


def limits_of(model: mujoco.MjModel, names: Sequence[str]) -> tuple[NDArray, NDArray] | None:
    """Control ranges of actuators.

    Parameters
    ----------
    model : mujoco.MjModel
        The model.
    names : sequence of str
        Actuators, d_u of them.

    Returns
    -------
    (low, high) or None
        Arrays (d_u,), infinite where an actuator is not limited; None when none is.

    """
    controls = np.array([model.actuator_ctrladr[model.actuator(name).id] for name in names])
    limited = model.actuator_ctrllimited[controls].astype(bool)
    if not limited.any():
        return None
    low, high = model.actuator_ctrlrange[controls].T
    return np.where(limited, low, -np.inf), np.where(limited, high, np.inf)


def resting(model: mujoco.MjModel, name: str) -> tuple[int, Callable[[NDArray], NDArray]] | None:
    """Rest position of a position servo on a joint, as a function of its command.

    Parameters
    ----------
    model : mujoco.MjModel
        The model.
    name : str
        The actuator.

    Returns
    -------
    (address, position) or None
        The joint's address in qpos, and a function from commands to positions in rad or m. None
        for other actuators, whose rest position does not follow from the command alone.

    """
    actuator = model.actuator(name)
    joint = joint_of(model, name)
    slope = actuator.biasprm[1]
    plain = actuator.gaintype[0] == FIXED and actuator.biastype[0] == AFFINE
    if joint is None or not plain or slope == 0 or actuator.dyntype[0] not in FOLLOWING:
        return None
    gear = actuator.gear[0]
    low, high = limits_of(model, [name]) or (np.array([-np.inf]), np.array([np.inf]))

    def position(commands: NDArray) -> NDArray:
        controls = np.clip(commands, low[0], high[0])
        return -(actuator.gainprm[0] * controls + actuator.biasprm[0]) / (slope * gear)

    return int(model.jnt_qposadr[joint]), position


def joint_of(model: mujoco.MjModel, name: str) -> int | None:
    """The joint that an actuator drives.

    Parameters
    ----------
    model : mujoco.MjModel
        The model.
    name : str
        The actuator.

    Returns
    -------
    int or None
        Index of the hinge or slide joint; None when the actuator drives something else.

    """
    actuator = model.actuator(name)
    joint = int(actuator.trnid[0])
    direct = actuator.trntype[0] in DIRECT and model.jnt_type[joint] in (HINGE, SLIDE)
    return joint if direct else None


def control_unit(model: mujoco.MjModel, name: str) -> str:
    """Unit of the control of a position servo or motor of gear 1; "1" for other actuators."""
    joint = joint_of(model, name)
    actuator = model.actuator(name)
    if joint is None or actuator.gear[0] != 1 or actuator.dyntype[0] not in FOLLOWING:
        return "1"
    hinge = model.jnt_type[joint] == HINGE
    if actuator.biastype[0] != AFFINE and actuator.gainprm[0] == 1:
        return "N m" if hinge else "N"
    if actuator.gainprm[0] == -actuator.biasprm[1] != 0:
        return "rad" if hinge else "m"
    return "1"
