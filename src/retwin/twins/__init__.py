"""Simulators: the `Twin` protocol, faults, command samplers, and one file per kind of twin.

Belongs here: whatever turns commands into outputs and needs nothing but its own equations or files.
Not here: learned twins (see `update`) and the twins of built-in systems (see `cases`).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from retwin._lazy import homes, names
from retwin.catalog import TWINS, resolve
from retwin.checks import nothing
from retwin.data.trajectories import Channels
from retwin.errors import InputError

if TYPE_CHECKING:  # one kind of twin does not load what another kind needs
    from retwin.twins.twin import Twin

_HOME = homes(
    {
        "collected": "SimulationError",
        "commands.record_sampler": "sampler_from",
        "commands.samplers": "CommandSampler HoldSampler MultisineSampler RampSampler "
        "RecordedSampler",
        "equations.state": "State",
        "equations.state_twin": "StateTwin",
        "equations.step_error": "StepWarning",
        "faults.actuator_faults": "ActuatorBias Fault Stuck",
        "faults.applied_faults": "draw_faults faulty_commands frozen_response",
        "faults.system_faults": "ActuatorGain ParameterDrift ParameterShift SensorBias SensorDrift "
        "SensorFreeze SensorGain",
        "fmu.twin": "FMUTwin",
        "function": "FunctionTwin",
        "limits": "Limits",
        "mujoco.twin": "MuJoCoTwin Servo",
        "system": "System",
        "twin": "Chunk Twin simulate_in_chunks",
        "workers": "keep_workers",
        "wrappers.command_side": "CommandSide command_side_parameters",
        "wrappers.noisy": "NoisyTwin residual_scale",
        "wrappers.parametric": "Parameter ParametricTwin",
        "wrappers.randomised": "RandomisedTwin",
        "wrappers.wrapper": "TwinWrapper",
    }
)

__getattr__, __dir__, __all__ = names(__name__, _HOME)
__all__ += ["get"]

FORMS = "package.module:object, *.fmu, *.xml or *.urdf"
FILES = {
    ".fmu": f"{__name__}.fmu.twin:FMUTwin",
    **dict.fromkeys((".xml", ".urdf"), f"{__name__}.mujoco.twin:MuJoCoTwin"),
}
"""The kind of twin that a file of each suffix holds."""


def get(
    name: str,
    *,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    rate: float | None = None,
    outside: Literal["refuse", "clip"] = "refuse",
    **options: Any,
) -> Twin:
    """Find a twin by its name.

    Parameters
    ----------
    name : str
        One of the forms below.
    inputs, outputs : sequence of str, optional
        Names of the channels. A function needs both; a file has all its channels by default.
    rate : float, optional
        Sample rate in Hz, above 0. A function needs it; for a file the default is 100 Hz.
    outside : {"refuse", "clip"}
        What the twin of a file does with commands outside its limits.
    **options
        Other arguments of `FMUTwin.from_file` or `MuJoCoTwin.from_file`.

    Returns
    -------
    Twin
        The twin.

    Raises
    ------
    InputError
        There is no such twin, it cannot be made, a package is missing, or channels or a rate are
        given for a twin that has its own.

    Notes
    -----
    | name | twin |
    |---|---|
    | a name without `:` or suffix | an entry of `retwin.catalog.TWINS` |
    | `package.module:object` | a twin, or a callable without arguments that returns a twin |
    | `package.module:function` | a function from commands (n, T, d_u) to outputs (n, T, d_y) |
    | `*.fmu` | an FMU for co-simulation |
    | `*.xml`, `*.urdf` | a MuJoCo model |

    """
    if name in TWINS or ":" in name:
        _check_none(name, options)
        return _from_module(name, inputs, outputs, rate)
    suffix = Path(name).suffix.lower()
    if suffix not in FILES:
        raise _unknown(name, "no such twin")
    if not Path(name).is_file():
        raise _unknown(name, "no file of that name")
    options |= {"inputs": tuple(inputs), "outputs": tuple(outputs)}
    if rate is not None:
        options["rate"] = rate
    if suffix == ".fmu":
        _check_none(name, {each: options[each] for each in ("meshes", "servos") if each in options})
    return resolve(FILES[suffix]).from_file(name, outside=outside, **options)


def _check_none(name: str, options: Mapping[str, Any]) -> None:
    """Refuse options that this kind of twin does not have."""
    expected = "no such options, which are those of another kind of twin"
    nothing(f"twin {name!r}", options, expected, remedy="leave them out")


def _from_module(
    name: str, inputs: Sequence[str], outputs: Sequence[str], rate: float | None
) -> Twin:
    """The twin that an entry of the catalog, or an object of a module, is or makes.

    The channels of a function have the unit "1".
    """
    from retwin.twins.twin import Twin

    try:
        found = resolve(TWINS[name].target if name in TWINS else name)
    except (ImportError, AttributeError, ValueError) as error:
        raise _unknown(name, str(error)) from None
    found = made_by(found)
    if takes_commands(found):
        if not inputs or not outputs or not rate:
            expected = "inputs, outputs and rate, which a function does not have"
            got = f"inputs {list(inputs)}, outputs {list(outputs)}, rate {rate}"
            remedy = "name the channels and the rate, or name an object that is a FunctionTwin"
            raise InputError(f"twin {name!r}", expected=expected, got=got, remedy=remedy)
        from retwin.twins.function import FunctionTwin

        _check_one_array(name, found, inputs)
        us, ys = (Channels(tuple(n), ("1",) * len(n)) for n in (inputs, outputs))
        return FunctionTwin(found, us, ys, rate)
    if not isinstance(found, Twin):
        raise _unknown(name, f"a {type(found).__name__}")
    given = (*inputs, *outputs, *([f"{rate} Hz"] if rate is not None else []))
    expected = "neither channels nor a rate, since it has its own"
    nothing(f"twin {name!r}", given, expected, remedy="leave them out")
    return found


def _check_one_array(name: str, function: Callable[..., Any], inputs: Sequence[str]) -> None:
    """Refuse a function that takes an array of each command: its order is not that of `inputs`."""
    try:
        signature = inspect.signature(function)
        signature.bind(0, **{each: 0 for each in ("rng", "rate") if each in signature.parameters})
    except TypeError as error:
        passed = ", ".join(f"{each}=u[..., {i}]" for i, each in enumerate(inputs))
        expected = "a function of one array of commands u, (n, T, d_u), and of numbers with "
        expected += "defaults"
        got = f"{name.rpartition(':')[2]}{signature}, {error}"
        remedy = f"name a function of u that calls it by names, with {passed}"
        raise InputError(f"twin {name!r}", expected=expected, got=got, remedy=remedy) from None
    except ValueError:  # some compiled functions have no signature
        return


def made_by(found: Any) -> Any:
    """What a function or a class makes that can be called without arguments; else the object."""
    try:
        inspect.signature(found).bind()
    except (TypeError, ValueError):  # it cannot be called, arguments are missing, or unknown
        return found
    return found() if takes_commands(found) else found


def takes_commands(found: Any) -> bool:
    """Whether an object is a function or a class, and no twin, which may be called too.

    Of what `made_by` gave, it is a function of commands.
    """
    from retwin.twins.twin import Twin

    # A class of twins satisfies the protocol too, although it is not a twin itself.
    return callable(found) and (isinstance(found, type) or not isinstance(found, Twin))


def _unknown(name: str, got: str) -> InputError:
    """The error for a name that stands for no twin."""
    return InputError(
        f"twin {name!r}",
        expected=f"{', '.join(TWINS)}, {FORMS}",
        got=" ".join(got.split()),
        remedy="check the spelling, or that the module or file can be read",
    )
