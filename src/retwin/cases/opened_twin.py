"""`open_parametric`: the twin of any name, with the parameters that are to be identified free."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Any

from retwin import cases, catalog, twins
from retwin.cases.case import Case
from retwin.cases.named_twin import parametric_twin
from retwin.checks import nothing, require
from retwin.errors import InputError
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.fmu.model import adjustable, read_description
from retwin.twins.fmu.twin import FMUTwin
from retwin.twins.function import FunctionTwin
from retwin.twins.mujoco.parameters import parameter_value, suggested_parameters
from retwin.twins.mujoco.twin import MuJoCoTwin
from retwin.twins.twin import Twin
from retwin.twins.wrappers.parameter_values import RebuiltTwin
from retwin.twins.wrappers.parametric import Parameter, ParametricTwin

SHOWN = 24
"""Parameters that a message lists, at most."""
FORM = "NAME, NAME=LOW:HIGH or NAME=LOW:HIGH:START"
PASSED = ("rng", "rate")
"""Arguments of a function that are no parameters, since a `FunctionTwin` passes them."""


@dataclass(frozen=True)
class Known:
    """What a twin itself states about one of its parameters.

    Parameters
    ----------
    name : str
        Name of the parameter.
    unit : str
        Its unit, "1" if none is stated.
    value : float or None
        Its present value; None where the twin does not state it.
    low, high : float or None
        Its range; None where the twin states none.

    """

    name: str
    unit: str = "1"
    value: float | None = None
    low: float | None = None
    high: float | None = None

    @property
    def ranged(self) -> bool:
        """Whether the twin states a finite range that contains the present value."""
        if self.low is None or self.high is None or not self.low < self.high:
            return False
        inside = self.value is None or self.low <= self.value <= self.high
        return inside and isfinite(self.low) and isfinite(self.high)

    @property
    def parameter(self) -> Parameter:
        """It as a free parameter, which it can be if it is `ranged`."""
        return Parameter(self.name, self.unit, self.low, self.high, self.value)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class OpenedTwin:
    """A twin whose free parameters are declared.

    Attributes
    ----------
    name : str
        The name under which it was opened.
    twin : ParametricTwin
        The twin at the starts of its free parameters.
    known : tuple of Known
        All parameters that the twin itself names.
    case : Case or None
        The case to which the name belongs; None for a twin without a case.
    own_channels : bool
        Whether the twin has channels and a rate of its own, so that none were given.

    """

    name: str
    twin: ParametricTwin
    known: tuple[Known, ...]
    case: Case | None
    own_channels: bool


def open_parametric(
    name: str,
    free: Sequence[str] = (),
    *,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    rate: float | None = None,
) -> OpenedTwin:
    """The twin of any name, with its free parameters declared.

    Parameters
    ----------
    name : str
        A built-in case, a file `case.toml`, or any name that `rt.twins.get` takes: `*.fmu`,
        `*.xml`, `*.urdf`, `module:function`, `module:object`.
    free : sequence of str
        The free parameters, each as `NAME=LOW:HIGH`, `NAME=LOW:HIGH:START`, or `NAME` where the
        twin states a range. The others keep their values. By default all parameters are free for
        which the twin or its case states a range.
    inputs, outputs, rate
        Channels and sample rate in Hz, see `rt.twins.get`; a case has its own.

    Returns
    -------
    OpenedTwin
        The twin at the starts of its free parameters, which are the twin's present values unless
        START is given.

    Raises
    ------
    InputError
        There is no such twin, it has no parameters, no range is known, or a parameter is unknown,
        given twice, or its range does not contain its start.

    """
    toml, case = Path(name).suffix.lower() == ".toml", None
    if toml or name in catalog.CASES:
        case = cases.get(name)
        given = (*inputs, *outputs, *([f"{rate:g} Hz"] if rate is not None else []))
        expected = "none of them, since the case has its own"
        nothing("inputs, outputs, rate", given, expected, remedy="leave them out")
        twin: Twin = case.parametric or case.twin
    else:
        twin = twins.get(name, inputs=tuple(inputs), outputs=tuple(outputs), rate=rate)
    if isinstance(twin, StateTwin) and twin.free:
        twin = twin.parametric()
    known = tuple(_list_known(twin))
    made = _free(twin, _choose_free(known, free, name))
    return OpenedTwin(name, made, known, case, not (inputs or outputs or rate))


def _list_known(twin: Twin) -> Iterator[Known]:
    """What a twin states about its parameters; declared ones come first."""
    if isinstance(twin, ParametricTwin):
        own = zip(twin.parameters, twin.values, strict=True)
        yield from (Known(p.name, p.unit, value, p.low, p.high) for p, value in own)
        places = {place for p in twin.parameters for place in p.places} | set(twin.names)
        held = dict(twin.held)
        for each in _list_known(twin.twin):
            if each.name not in places:
                yield replace(each, value=held.get(each.name, each.value))
    elif isinstance(twin, FMUTwin):
        for name, unit, start, low, high in adjustable(read_description(twin.path)):
            now = twin.start.get(name, start)
            yield Known(name, unit, None if now is None else float(now), low, high)
    elif isinstance(twin, MuJoCoTwin):
        yield from (Known(name, "1", value) for name, value in suggested_parameters(twin.model))
    elif isinstance(twin, RebuiltTwin):
        yield from (Known(name, "1", value) for name, value in twin.defaults.items())
    elif isinstance(twin, FunctionTwin):
        for taken in list(inspect.signature(twin.function).parameters.values())[1:]:
            default = taken.default
            number = isinstance(default, int | float) and not isinstance(default, bool)
            if taken.name not in PASSED and number:
                yield Known(taken.name, "1", float(default))


def _choose_free(known: Sequence[Known], free: Sequence[str], name: str) -> list[Parameter]:
    """The free parameters, from what the user gives and what the twin states."""
    by_name = {each.name: each for each in known}
    if not free:
        ranged = [each for each in known if each.ranged]
        require(
            ranged,
            "--free",
            expected="at least one parameter and its range, since the twin states no range",
            got="none",
            remedy=f"give for instance --free {known[0].name}=LOW:HIGH; {_list(known)}"
            if known
            else f"{name} names no parameters: give a function keyword arguments with numbers as "
            "defaults, or declare [parameters] in a case.toml",
        )
        return [each.parameter for each in ranged]
    made = [_parameter(text, by_name, known) for text in free]
    names = [each.name for each in made]
    twice = sorted({each for each in names if names.count(each) > 1})
    repeated = (f"{each} twice" for each in twice)
    nothing("--free", repeated, "each parameter once", remedy="leave one of them out")
    return made


def _parameter(text: str, by_name: dict[str, Known], known: Sequence[Known]) -> Parameter:
    """A parameter from `NAME`, `NAME=LOW:HIGH` or `NAME=LOW:HIGH:START`."""
    name, equals, given = text.rpartition("=") if "=" in text else (text, "", "")
    found = by_name.get(name, Known(name))
    if not equals:
        require(
            found.ranged,
            "--free",
            expected=f"a range for {name}, since the twin states none"
            if name in by_name
            else f"a parameter of the twin, as {FORM}",
            got=repr(text),
            remedy=f"write --free {name}=LOW:HIGH; {_list(known)}"
            if name in by_name
            else f"check the spelling: {_list(known)}",
        )
        return found.parameter
    try:
        low, high, *start = map(float, given.split(":"))
        if len(start) > 1 or not name:
            raise ValueError
    except ValueError:
        expected = f"{FORM}, with numbers"
        remedy = "write for instance --free damping=0.1:2"
        raise InputError("--free", expected=expected, got=repr(text), remedy=remedy) from None
    begin = start[0] if start else found.value
    require(
        start or begin is None or low <= begin <= high,
        "--free",
        expected=f"a range of {name} that contains its present value, {begin}",
        got=given,
        remedy=f"widen the range, or give another start: --free {name}={low:g}:{high:g}:START; to "
        "hold a parameter, name the others alone",
    )
    return Parameter(name, found.unit, low, high, begin)


def _free(twin: Twin, chosen: Sequence[Parameter]) -> ParametricTwin:
    """The twin with these parameters free and the others held."""
    if not isinstance(twin, ParametricTwin):
        if isinstance(twin, MuJoCoTwin):
            chosen = [_set_start(each, twin) for each in chosen]
        return parametric_twin(twin, chosen, "--free")
    made, own = twin.freed(chosen), None
    if isinstance(twin.twin, RebuiltTwin):
        own = set(twin.twin.defaults)
    elif isinstance(twin.twin, StateTwin):
        own = set(twin.twin.names)
    unknown = [each.name for each in made.parameters if own is not None and set(each.places) - own]
    remedy = "declare it among the parameters of the case or of the twin"
    nothing("--free", unknown, f"some of {', '.join(twin.names)}", remedy=remedy)
    return made


def _set_start(parameter: Parameter, twin: MuJoCoTwin) -> Parameter:
    """The same with the model's own value as its start, for places that no list suggests."""
    value = parameter_value(twin.model, parameter.name)
    inside = parameter.low <= value <= parameter.high
    middle = (parameter.low + parameter.high) / 2
    given = parameter.start != middle or not inside
    return parameter if given else replace(parameter, start=value)


def _list(known: Sequence[Known]) -> str:
    """The parameters that there are, with their present values."""

    def described(each: Known) -> str:
        value = "" if each.value is None else f" = {each.value:g}"
        return each.name + value + (f" {each.unit}" if each.unit != "1" else "")

    more = f", … ({len(known)} in all)" if len(known) > SHOWN else ""
    shown: Any = ", ".join(map(described, known[:SHOWN]))
    return f"there are {shown}{more}" if known else "the twin names none"
