"""From a file to a MuJoCo model with the actuators and sensors asked for, and their channels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Channels
from retwin.errors import InputError

__all__ = [
    "FILTERS",
    "Servo",
    "compiled",
    "input_channels",
    "joint_of",
    "limits_of",
    "output_channels",
    "resting",
]


@dataclass(frozen=True)
class Servo:
    """A position servo for a joint that has no actuator; its command is the joint's angle in rad
    (or its place in m).

    Parameters
    ----------
    stiffness: N m/rad (or N/m).
    damping: N m s/rad (or N s/m).
    armature: the rotor's inertia behind the gear, in kg m^2 (or kg). Most of what a geared servo
        moves is its own rotor; without it, a stiff loop needs far smaller steps.

    """

    stiffness: float
    damping: float
    armature: float = 0.005


# As plain numbers: MuJoCo's enumerations do not equal the numbers that its arrays hold.
HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
DIRECT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
FIXED, AFFINE = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_AFFINE)
FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
"""Actuators that follow their control with a lag."""
FOLLOWING = (int(mujoco.mjtDyn.mjDYN_NONE), *FILTERS)
"""Actuators whose gain acts on their control, and not, say, on its integral."""


def compiled(
    path: Path,
    *,
    servos: Sequence[tuple[str, Servo]] = (),
    places: Sequence[str] = (),
    step: float | None = None,
    meshes: bool = True,
) -> mujoco.MjModel:
    """The model in `path`, with servos on joints and sensors for the places of sites or bodies.

    Raises InputError when the file is missing, broken, or lacks one of the joints.
    """
    if not path.is_file():
        raise InputError(
            "model",
            expected="an MJCF or URDF file",
            got=f"{path}, where there is none",
            remedy="check the name",
        )
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if not meshes:
            for geom in list(spec.geoms):
                if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
                    spec.delete(geom)
            for mesh in list(spec.meshes):
                spec.delete(mesh)
        sensors = {each.name for each in spec.sensors}
        kinds = {each.name: mujoco.mjtObj.mjOBJ_XBODY for each in spec.bodies}
        kinds |= {each.name: mujoco.mjtObj.mjOBJ_SITE for each in spec.sites}
        for name in places:
            if name in kinds and name not in sensors:
                kind = mujoco.mjtSensor.mjSENS_FRAMEPOS
                spec.add_sensor(name=name, type=kind, objtype=kinds[name], objname=name)
        for joint, servo in servos:
            _name("servos", joint, [each.name for each in spec.joints])
            actuator = spec.add_actuator(
                name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT
            )
            actuator.set_to_position(kp=servo.stiffness, kv=servo.damping)
            spec.joint(joint).armature = servo.armature
            # Damping of a stiff loop is only stable when it is integrated implicitly.
            spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        if step is not None:
            spec.option.timestep = step
        # Instability is told as such, and not hidden by starting again in the middle.
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        return spec.compile()
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        missing = "meshes that are not there can be left out" if meshes else "or load its meshes"
        raise InputError(
            "model",
            expected="an MJCF or URDF file that MuJoCo can compile",
            got=f"{path} ({' '.join(str(error).split())})",
            remedy=f"repair the file, {missing} (meshes={not meshes})",
        ) from None


def input_channels(model: mujoco.MjModel, names: Sequence[str]) -> Channels:
    """Those actuators, by default all with a name; units of controls where these are plain."""
    there = [name for i in range(model.nactuator) if (name := model.actuator(i).name)]
    chosen = [_name("inputs", name, there) for name in names] or there
    if not chosen:
        raise InputError(
            "inputs",
            expected="a model with actuators that have names",
            got="one without, as a URDF file always is",
            remedy="name them, or add servos=((joint, Servo(stiffness, damping)), …)",
        )
    for name in chosen:
        if model.actuator_ctrlnum[model.actuator(name).id] != 1:
            raise InputError(
                "inputs",
                expected="actuators with one control",
                got=f"{name} with {model.actuator_ctrlnum[model.actuator(name).id]}",
                remedy="use an actuator for each of its controls",
            )
    return Channels(tuple(chosen), tuple(_control_unit(model, name) for name in chosen))


def output_channels(
    model: mujoco.MjModel, names: Sequence[str]
) -> tuple[tuple[str, ...], Channels]:
    """Those sensors, by default all that have a name, and a channel for each component."""
    there = [name for i in range(model.nsensor) if (name := model.sensor(i).name)]
    places = [name for i in range(model.nsite) if (name := model.site(i).name)]
    places += [name for i in range(1, model.nbody) if (name := model.body(i).name)]
    # Places that were asked for have become sensors when the model was compiled.
    for name in names:
        _name("outputs", name, list(dict.fromkeys(there + places)))
    chosen = list(names) or there
    if not chosen:
        raise InputError(
            "outputs",
            expected="sensors, sites or bodies of the model",
            got="none asked for, and no sensors with names in the model",
            remedy="name places whose position is the output"
            + (f", such as {', '.join(places[-3:])}" if places else ""),
        )
    channels: list[str] = []
    units: list[str] = []
    for name in chosen:
        sensor = model.sensor(name)
        size = int(sensor.dim[0])
        parts = "xyz" if size == 3 else "wxyz" if size == 4 else range(size)
        channels += [name] if size == 1 else [f"{name}_{part}" for part in parts]
        units += [_sensor_unit(model, name)] * size
    return tuple(chosen), Channels(tuple(channels), tuple(units))


def limits_of(model: mujoco.MjModel, names: Sequence[str]) -> tuple[NDArray, NDArray] | None:
    """The least and the greatest control of those actuators; None when none is limited."""
    controls = np.array([model.actuator_ctrladr[model.actuator(name).id] for name in names])
    limited = model.actuator_ctrllimited[controls].astype(bool)
    if not limited.any():
        return None
    low, high = model.actuator_ctrlrange[controls].T
    return np.where(limited, low, -np.inf), np.where(limited, high, np.inf)


def resting(model: mujoco.MjModel, name: str) -> tuple[int, Callable[[NDArray], NDArray]] | None:
    """For a position servo on a joint: where its place is in qpos, and that place by command.

    None for actuators of another kind: a command does not tell where they rest.
    """
    actuator = model.actuator(name)
    joint = joint_of(model, name)
    slope = actuator.biasprm[1]
    plain = actuator.gaintype[0] == FIXED and actuator.biastype[0] == AFFINE
    if joint is None or not plain or slope == 0 or actuator.dyntype[0] not in FOLLOWING:
        return None
    gear = actuator.gear[0]
    low, high = limits_of(model, [name]) or (np.array([-np.inf]), np.array([np.inf]))

    def place(commands: NDArray) -> NDArray:
        told = np.clip(commands, low[0], high[0])
        return -(actuator.gainprm[0] * told + actuator.biasprm[0]) / (slope * gear)

    return int(model.jnt_qposadr[joint]), place


def joint_of(model: mujoco.MjModel, name: str) -> int | None:
    """The hinge or slide joint that an actuator drives, or None when it drives something else."""
    actuator = model.actuator(name)
    joint = int(actuator.trnid[0])
    direct = actuator.trntype[0] in DIRECT and model.jnt_type[joint] in (HINGE, SLIDE)
    return joint if direct else None


def _name(argument: str, name: str, there: Sequence[str]) -> str:
    """`name`, if the model has it."""
    if name not in there:
        close = get_close_matches(name, there, n=1)
        shown = ", ".join(there[:12]) + (", …" if len(there) > 12 else "")
        raise InputError(
            argument,
            expected=f"names in the model: {shown or 'it has none'}",
            got=repr(name),
            remedy=f"did you mean {close[0]!r}?" if close else "check the spelling",
        )
    return name


def _control_unit(model: mujoco.MjModel, name: str) -> str:
    """Unit of a plain position servo or motor of gear 1; "1" where only the model knows."""
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


UNITS = {
    "m": ("FRAMEPOS", "SUBTREECOM", "RANGEFINDER", "TENDONPOS", "TENDONLIMITPOS", "GEOMDIST"),
    "m/s": ("VELOCIMETER", "FRAMELINVEL", "SUBTREELINVEL", "TENDONVEL", "TENDONLIMITVEL"),
    "m/s^2": ("ACCELEROMETER", "FRAMELINACC"),
    "rad/s": ("GYRO", "FRAMEANGVEL", "BALLANGVEL"),
    "rad/s^2": ("FRAMEANGACC",),
    "N": ("TOUCH", "FORCE", "TENDONACTFRC", "TENDONLIMITFRC"),
    "N m": ("TORQUE",),
    "J": ("E_POTENTIAL", "E_KINETIC"),
    "s": ("CLOCK",),
}
BY_JOINT = {
    "JOINTPOS": ("rad", "m"),
    "JOINTLIMITPOS": ("rad", "m"),
    "JOINTVEL": ("rad/s", "m/s"),
    "JOINTLIMITVEL": ("rad/s", "m/s"),
    "JOINTACTFRC": ("N m", "N"),
    "JOINTLIMITFRC": ("N m", "N"),
}


def _sensor_unit(model: mujoco.MjModel, name: str) -> str:
    sensor = model.sensor(name)
    kind = mujoco.mjtSensor(int(sensor.type[0])).name.removeprefix("mjSENS_")
    if kind in BY_JOINT:
        hinge = model.jnt_type[sensor.objid[0]] == HINGE
        return BY_JOINT[kind][0 if hinge else 1]
    if kind.startswith("TENDON") and not _is_spatial(model, int(sensor.objid[0])):
        return "1"
    return next((unit for unit, kinds in UNITS.items() if kind in kinds), "1")


def _is_spatial(model: mujoco.MjModel, tendon: int) -> bool:
    """Whether a tendon has a length in m; a fixed one adds up joints, in units of their own."""
    first = int(model.tendon_adr[tendon])
    return bool(model.wrap_type[first] != int(mujoco.mjtWrap.mjWRAP_JOINT))
