"""What a case.toml names: Python objects beside it, and its twin, of whatever kind."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from retwin import twins
from retwin.catalog import resolve
from retwin.catalog.modules import import_beside
from retwin.checks import at_most, existing, nothing, require
from retwin.data.trajectories import Channels
from retwin.errors import InputError
from retwin.serialisation.configs import at, checked, from_settings, key
from retwin.twins import FILES
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.function import FunctionTwin
from retwin.twins.limits import Limits
from retwin.twins.mujoco.twin import MuJoCoTwin, Servo
from retwin.twins.twin import Twin
from retwin.twins.wrappers.parametric import Parameter, ParametricTwin, takes_parameters

ELSEWHERE = ("path", "function", "inputs", "outputs", "sensors", "rate", "limits")
"""Parameters of twins that other keys of a case.toml set."""


@dataclass(frozen=True)
class _Channel:
    """A channel of a twin that is a function: its unit, and the limits of a command in it."""

    unit: str = "1"
    low: float = float("-inf")
    high: float = float("inf")


@dataclass(frozen=True)
class _Making:
    """How a twin is made, besides the parameters of its class."""

    outside: Literal["refuse", "clip"] = "refuse"
    servos: dict[str, dict[str, Any]] = field(default_factory=dict)


def imported(name: Any, folder: Path, place: str) -> Any:
    """The object that `module:object` names, the module installed or else in `folder`.

    Raises
    ------
    InputError
        There is none, or `folder` has a module of that name but another one was found. The message
        names `place`.

    """
    module, _, attribute = str(name).partition(":")
    expected = "module:object, the module installed or beside the case"
    if not re.fullmatch(r"\w+(\.\w+)*:\w+", str(name)):
        raise InputError(place, expected=expected, got=repr(name), remedy="check the spelling")
    try:
        home = import_beside(module, folder)
        found = getattr(home, attribute)
    except (ImportError, AttributeError) as error:
        got = f"{name!r}: {' '.join(str(error).split())}"
        raise InputError(place, expected=expected, got=got, remedy="check the spelling") from None
    beside = folder / f"{module}.py"
    if beside.is_file() and not beside.samefile(home.__file__ or ""):
        got = f"another one of that name, {home.__file__}"
        remedy = "give your module a name of its own"
        raise InputError(place, expected=f"the module {beside}", got=got, remedy=remedy)
    return found


@dataclass(frozen=True, kw_only=True)
class TwinKeys:
    """The keys of a case.toml from which its twin is made, and the name of the case."""

    name: str
    twin: Any
    rate: float | None = None
    inputs: dict[str, Any] | tuple[str, ...] = ()
    outputs: dict[str, Any] | tuple[str, ...] = ()


def read_twin(keys: TwinKeys, folder: Path, place: str) -> Twin:
    """The twin that a text names, or a table that holds its name and its settings.

    | name | takes |
    |---|---|
    | `module:function` | inputs and outputs as tables, with units and limits; rate |
    | `module:object`, or a built-in one | nothing, since it has its own |
    | `*.fmu`, `*.xml`, `*.urdf` | names of inputs and outputs, by default all; rate |

    Raises
    ------
    InputError
        There is no such twin, or it does not take these settings. The message names `place` and the
        key.

    """
    own = key(place, "twin")
    options = dict(keys.twin) if isinstance(keys.twin, Mapping) else {"name": keys.twin}
    name = options.pop("name", None)
    if not isinstance(name, str):
        remedy = 'write twin = "NAME", or a table with a name in it'
        raise InputError(
            own, expected=f"the name of a twin: {twins.FORMS}", got=repr(keys.twin), remedy=remedy
        )
    if "nominal" in options:
        options["nominal"] = imported(options["nominal"], folder, key(own, "nominal"))
    if Path(name).suffix.lower() in FILES:
        return _of_file(folder / name, keys, options, place)
    found = imported(name, folder, own) if ":" in name else None
    if callable(found) and (keys.inputs or keys.outputs):
        return _of_function(found, keys, options, place)
    expected = "a name alone, for such a twin has its own settings"
    nothing(own, options, expected, remedy="make the object with these settings")
    inputs, outputs = tuple(keys.inputs), tuple(keys.outputs)
    with at(place):
        return twins.get(name, inputs=inputs, outputs=outputs, rate=keys.rate)


def _of_function(
    function: Any, keys: TwinKeys, options: dict[str, Any], place: str
) -> FunctionTwin:
    commands = _channels(keys.inputs, key(place, "inputs"))
    results = _channels(keys.outputs, key(place, "outputs"))
    own = key(place, "twin")
    making = _making(options, own, "outside")
    settings = checked(FunctionTwin, options, place=own, besides=ELSEWHERE)
    with at(key(place, "inputs")):
        low, high = (tuple(getattr(c, end) for c in commands.values()) for end in ("low", "high"))
        limits = Limits(low, high, making.outside)
    with at(place):
        return FunctionTwin(
            function,
            Channels(tuple(commands), tuple(each.unit for each in commands.values())),
            Channels(tuple(results), tuple(each.unit for each in results.values())),
            keys.rate,  # type: ignore[arg-type]  # None is refused there
            limits=limits,
            **settings,
        )


def _of_file(file: Path, keys: TwinKeys, options: dict[str, Any], place: str) -> Twin:
    own, kind = key(place, "twin"), resolve(FILES[file.suffix.lower()])
    existing(own, file, file.is_file(), "a file")
    chosen = {"inputs": keys.inputs, "outputs": keys.outputs}
    for name, channels in chosen.items():
        fits = not (isinstance(channels, Mapping) and any(channels.values()))
        expected = f"names alone, since units and limits are those of {file.name}"
        remedy = f"write {name} = [{', '.join(map(repr, channels))}]"
        require(fits, key(place, name), expected=expected, got=repr(channels), remedy=remedy)
    making = _making(options, own, "outside", *(["servos"] if kind is MuJoCoTwin else []))
    settings = checked(kind, options, place=own, besides=(*ELSEWHERE, "outside"))
    if making.servos:
        inside = key(own, "servos")
        settings["servos"] = [
            (joint, from_settings(Servo, value, place=key(inside, joint)))
            for joint, value in making.servos.items()
        ]
    settings |= {name: tuple(channels) for name, channels in chosen.items()}
    if keys.rate is not None:
        settings["rate"] = keys.rate
    with at(own):
        return kind.from_file(file, outside=making.outside, **settings)


def _making(options: dict[str, Any], place: str, *names: str) -> _Making:
    """The settings of those names, taken out of `options`."""
    return from_settings(_Making, {n: options.pop(n) for n in names if n in options}, place=place)


def _channels(given: Mapping[str, Any] | Sequence[str], place: str) -> dict[str, _Channel]:
    """A table of each channel, for which its name alone may stand."""
    tables = given if isinstance(given, Mapping) else {name: {} for name in given}
    remedy = "leave out those that are constant, or split the system"
    # More take minutes to read, and a trajectory takes hundreds of MB.
    at_most(place, len(tables), 10_000, "channels", remedy=remedy)
    return {
        name: from_settings(_Channel, value, place=key(place, name))
        for name, value in tables.items()
    }


def parametric_twin(twin: Twin, free: Sequence[Parameter], place: str) -> ParametricTwin:
    """`twin` at the parameters' starts; those of a function are keyword arguments of it.

    Raises InputError for parameters that the twin does not take.
    """
    if not isinstance(twin, FunctionTwin):
        if not takes_parameters(twin):
            raise _takes_none(place, type(twin).__name__, free)
        with at(place):
            return ParametricTwin(twin, tuple(free))  # type: ignore[arg-type]
    taken = inspect.signature(twin.function).parameters
    unknown = [each for each in free if each.name not in taken]
    if unknown:
        raise _takes_none(place, getattr(twin.function, "__qualname__", "the function"), unknown)
    return ParametricTwin.built(partial(_with_values, twin), free)


def delayed_twin(twin: Twin, delays: Mapping[str, Parameter], place: str) -> StateTwin:
    """The twin whose commands of these names have these dead times.

    Raises InputError for a twin that is no `StateTwin`, and for commands that it does not have.
    """
    if not isinstance(twin, StateTwin):
        expected = "dead times of a twin that is a StateTwin"
        got = f"those of a {type(twin).__name__}"
        remedy = "delay the commands inside the twin, with a parameter of its own"
        raise InputError(place, expected=expected, got=got, remedy=remedy)
    with at(place):
        names = {command: each.name for command, each in delays.items()}
        parameters = (*twin.parameters, *delays.values())
        return replace(twin, parameters=parameters, delays={**twin.delays, **names})


def _with_values(twin: FunctionTwin, values: Mapping[str, float]) -> FunctionTwin:
    """The twin whose functions get `values`, each those that it takes by name."""

    def bound(function: Any) -> Any:
        taken = inspect.signature(function).parameters
        return partial(function, **{name: v for name, v in values.items() if name in taken})

    nominal = None if twin.nominal is None else bound(twin.nominal)
    return replace(twin, function=bound(twin.function), nominal=nominal)


def _takes_none(place: str, what: str, parameters: Sequence[Parameter]) -> InputError:
    return InputError(
        place,
        expected=f"parameters that {what} takes by name",
        got=", ".join(each.name for each in parameters),
        remedy="give the function keyword arguments of these names, or leave them out",
    )
