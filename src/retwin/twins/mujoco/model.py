"""A MuJoCo model from a file, with added actuators and sensors, and its channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import chain, count
from pathlib import Path

import mujoco

from retwin.checks import existing, require
from retwin.data.trajectories import Channels
from retwin.errors import InputError
from retwin.twins.mujoco.actuators import HINGE, control_unit


@dataclass(frozen=True)
class Servo:
    """A position servo for a joint that has no actuator.

    Its command is the joint's angle in rad (or its position in m).

    Parameters
    ----------
    stiffness : float
        Position gain in N m/rad (or N/m).
    damping : float
        Velocity gain in N m s/rad (or N s/m).
    armature : float, default 0.005
        Inertia of the rotor, reflected through the gear, in kg m^2 (or kg). It is most of the
        inertia that a geared servo moves; without it, a stiff loop needs far smaller steps.

    """

    stiffness: float
    damping: float
    armature: float = 0.005


PLACES = {
    "joint": ("joints", mujoco.mjtSensor.mjSENS_JOINTPOS),
    "joint_velocity": ("joints", mujoco.mjtSensor.mjSENS_JOINTVEL),
    "site": ("sites", mujoco.mjtSensor.mjSENS_FRAMEPOS),
    "site_velocity": ("sites", mujoco.mjtSensor.mjSENS_FRAMELINVEL),
    "body": ("bodies", mujoco.mjtSensor.mjSENS_FRAMEPOS),
    "body_velocity": ("bodies", mujoco.mjtSensor.mjSENS_FRAMELINVEL),
}
"""What an output "KIND:NAME" is measured by: the list of the model in which the name is, and the
kind of sensor."""
OBJECTS = {
    "joints": mujoco.mjtObj.mjOBJ_JOINT,
    "sites": mujoco.mjtObj.mjOBJ_SITE,
    "bodies": mujoco.mjtObj.mjOBJ_XBODY,
}
OF_BALLS = {
    mujoco.mjtSensor.mjSENS_JOINTPOS: mujoco.mjtSensor.mjSENS_BALLQUAT,
    mujoco.mjtSensor.mjSENS_JOINTVEL: mujoco.mjtSensor.mjSENS_BALLANGVEL,
}
"""The sensors of ball joints."""


def compiled(
    path: Path,
    *,
    servos: Sequence[tuple[str, Servo]] = (),
    places: Sequence[str] = (),
    step: float | None = None,
    meshes: bool = True,
) -> mujoco.MjModel:
    """Compile a model, with servos added to joints and sensors added to named places.

    Actuators without a name get that of what they drive.

    Parameters
    ----------
    path : Path
        MJCF or URDF file.
    servos : sequence of (str, Servo)
        Position servos, by the joint that they drive.
    places : sequence of str
        What gets a sensor: "joint:NAME" or "joint_velocity:NAME", and so for site and body, or
        the bare name of a site, a body or a joint. Other names are ignored.
    step : float, optional
        Integration step in s; by default the model's.
    meshes : bool, default True
        Whether to load meshes.

    Returns
    -------
    mujoco.MjModel
        The compiled model.

    Raises
    ------
    InputError
        The file is missing or broken, or lacks one of the joints.

    """
    existing("model", path, path.is_file(), "an MJCF or URDF file")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if not meshes:
            for geom in list(spec.geoms):
                if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
                    spec.delete(geom)
            for mesh in list(spec.meshes):
                spec.delete(mesh)
        _name_actuators(spec)
        _add_sensors(spec, places)
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
        # An unstable simulation must raise a warning instead of being reset.
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        return spec.compile()
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        flag = ", or --no-meshes" if meshes else ""
        missing = "meshes that are not there can be left out" if meshes else "or load its meshes"
        expected = "an MJCF or URDF file that MuJoCo can compile"
        got = f"{path} ({' '.join(str(error).split())})"
        remedy = f"repair the file, {missing} (meshes={not meshes}{flag})"
        raise InputError("model", expected=expected, got=got, remedy=remedy) from None


def _name_actuators(spec: mujoco.MjSpec) -> None:
    """Give actuators without a name that of the joint, tendon, … that they drive."""
    used = {each.name for each in spec.actuators}
    for actuator in spec.actuators:
        if not actuator.name and actuator.target:
            numbered = (f"{actuator.target}_{k}" for k in count(2))
            actuator.name = next(n for n in chain([actuator.target], numbered) if n not in used)
            used.add(actuator.name)


def _add_sensors(spec: mujoco.MjSpec, places: Sequence[str]) -> None:
    """Add a sensor of the same name for each place that has none."""
    named = {
        what: {each.name: each for each in getattr(spec, what) if each.name} for what in OBJECTS
    }
    sensors = {each.name for each in spec.sensors}
    for place in dict.fromkeys(places):
        kind, _, name = place.rpartition(":")
        kinds = [kind] if kind in PLACES else ["site", "body", "joint"]
        found = next((each for each in kinds if name in named[PLACES[each][0]]), None)
        if place in sensors or found is None or (kind and kind not in PLACES):
            continue
        what, sensor = PLACES[found]
        if what == "joints":
            joint = named[what][name]
            fits = joint.type != mujoco.mjtJoint.mjJNT_FREE
            expected = "a joint that is no free joint"
            remedy = f"name the body that it moves, body:{joint.parent.name}"
            require(fits, "outputs", expected=expected, got=repr(place), remedy=remedy)
            sensor = OF_BALLS[sensor] if joint.type == mujoco.mjtJoint.mjJNT_BALL else sensor
        spec.add_sensor(name=place, type=sensor, objtype=OBJECTS[what], objname=name)


def input_channels(model: mujoco.MjModel, names: Sequence[str]) -> Channels:
    """Channels of actuators.

    Parameters
    ----------
    model : mujoco.MjModel
        The model.
    names : sequence of str
        Actuators, in order; empty takes all that have a name.

    Returns
    -------
    Channels
        Names, and units of the controls where the model determines them, else "1".

    Raises
    ------
    InputError
        No actuator of that name, none at all, or one with several controls.

    """
    existing = [name for i in range(model.nactuator) if (name := model.actuator(i).name)]
    chosen = [_name("inputs", name, existing) for name in names] or existing
    got = "one without, as a URDF file always is"
    remedy = "add servos=[(joint, Servo(stiffness, damping)), …], in a case.toml a table "
    remedy += "servos, or on the command line --servo JOINT=STIFFNESS,DAMPING for each joint"
    require(chosen, "inputs", expected="a model with actuators", got=got, remedy=remedy)
    for name in chosen:
        controls = model.actuator_ctrlnum[model.actuator(name).id]
        expected = "actuators with one control"
        got = f"{name} with {controls}"
        remedy = "use an actuator for each of its controls"
        require(controls == 1, "inputs", expected=expected, got=got, remedy=remedy)
    return Channels(tuple(chosen), tuple(control_unit(model, name) for name in chosen))


def output_channels(
    model: mujoco.MjModel, names: Sequence[str]
) -> tuple[tuple[str, ...], Channels]:
    """Channels of sensors.

    Parameters
    ----------
    model : mujoco.MjModel
        The model, compiled with the sensors' places.
    names : sequence of str
        Sensors, and places as in `compiled`, in order; empty takes all sensors that have a name.

    Returns
    -------
    sensors : tuple of str
        Names of the sensors.
    channels : Channels
        One channel per component of the sensors.

    Raises
    ------
    InputError
        No sensor or place of that name, or none at all.

    """
    existing = [name for i in range(model.nsensor) if (name := model.sensor(i).name)]
    places = [f"joint:{n}" for i in range(model.njnt) if (n := model.joint(i).name)]
    places += [f"site:{n}" for i in range(model.nsite) if (n := model.site(i).name)]
    places += [f"body:{n}" for i in range(1, model.nbody) if (n := model.body(i).name)]
    # The chosen places became sensors when the model was compiled.
    for name in names:
        _name("outputs", name, existing, [*existing, *places])
    chosen = list(names) or existing
    expected = "sensors, joints, sites or bodies of the model"
    got = "no names, and no sensors with names in the model"
    remedy = "name what is measured: joint:NAME, joint_velocity:NAME, or the position of "
    remedy += f"site:NAME or body:NAME; there are {', '.join(places[:12])}"
    require(chosen, "outputs", expected=expected, got=got, remedy=remedy)
    channels: list[str] = []
    units: list[str] = []
    for name in chosen:
        sensor = model.sensor(name)
        size = int(sensor.dim[0])
        parts = "xyz" if size == 3 else "wxyz" if size == 4 else range(size)
        channels += [name] if size == 1 else [f"{name}_{part}" for part in parts]
        units += [_sensor_unit(model, name)] * size
    return tuple(chosen), Channels(tuple(channels), tuple(units))


def _name(argument: str, name: str, existing: Sequence[str], also: Sequence[str] = ()) -> str:
    """`name`, if the model has it; the message proposes names of `also`, or else of `existing`."""
    known = also or existing
    bare = {each.rpartition(":")[2]: each for each in reversed(known)} | {n: n for n in known}
    near = get_close_matches(name, bare, n=1) or get_close_matches(name.rpartition(":")[2], bare, 1)
    close = [bare[each] for each in near]
    shown = ", ".join(known[:12]) + (", …" if len(known) > 12 else "")
    expected = f"names in the model: {shown or 'it has none'}"
    remedy = f"did you mean {close[0]!r}?" if close else "check the spelling"
    require(name in existing, argument, expected=expected, got=repr(name), remedy=remedy)
    return name


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
    """Unit of a sensor; "1" where the model does not determine it."""
    sensor = model.sensor(name)
    kind = mujoco.mjtSensor(int(sensor.type[0])).name.removeprefix("mjSENS_")
    if kind in BY_JOINT:
        hinge = model.jnt_type[sensor.objid[0]] == HINGE
        return BY_JOINT[kind][0 if hinge else 1]
    if kind.startswith("TENDON") and not _is_spatial(model, int(sensor.objid[0])):
        return "1"
    return next((unit for unit, kinds in UNITS.items() if kind in kinds), "1")


def _is_spatial(model: mujoco.MjModel, tendon: int) -> bool:
    """Whether a tendon has a length in m; a fixed one is a sum of joints in their own units."""
    first = int(model.tendon_adr[tendon])
    return bool(model.wrap_type[first] != int(mujoco.mjtWrap.mjWRAP_JOINT))
