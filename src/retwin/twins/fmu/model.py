"""The model description of an FMU, read and checked without loading its native code."""

from __future__ import annotations

import difflib
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, Literal

import numpy as np

from retwin.checks import needs_extra, require
from retwin.data.trajectories import Channels
from retwin.errors import InputError
from retwin.serialisation.files import refusing
from retwin.serialisation.sizes import Budget
from retwin.twins.limits import Limits

NUMBERS = ("Real", "Float32", "Float64")
WHOLE = (
    "Integer",
    "Enumeration",
    *(f"{u}Int{bits}" for u in ("", "U") for bits in (8, 16, 32, 64)),
)
SCALARS = (*NUMBERS, *WHOLE, "Boolean")
HIDDEN = (("output", "local"), ("output", "calculatedParameter"))
"""Pairs of what a channel is and another causality that it may have if it is named."""


@dataclass(frozen=True, eq=False)
class Scalar:
    """A number of an FMU that can be a channel: a variable, or one element of an array.

    Parameters
    ----------
    name : str
        Name of the variable; of an element "y[0]" or "y[0,1]", counted from 0.
    variable : fmpy.model_description.ModelVariable
        The variable.
    place : int, default 0
        The element's place among those of the variable.

    """

    name: str
    variable: Any
    place: int = 0

    @property
    def constant(self) -> bool:
        """Whether its range is a single value."""
        low, high = self.bounds
        return low == high

    @property
    def bounds(self) -> tuple[float, float]:
        """Its range as the FMU declares it; infinite where it declares none."""
        if self.variable.type == "Boolean":
            return 0.0, 1.0
        items = [
            int(each.value) for each in getattr(self.variable.declaredType, "items", None) or ()
        ]
        low = min(items, default=_declared(self.variable, "min"))
        high = max(items, default=_declared(self.variable, "max"))
        return _limit(low, -np.inf), _limit(high, np.inf)


def _limit(declared: Any, none: float, *, unlimited: float = 1e30) -> float:
    """A declared limit as a number; `none` where it is none.

    Parameters
    ----------
    unlimited : float, default 1e+30
        Magnitude above which a declared limit counts as none: tools write the largest float for it.

    """
    value = none if declared is None else float(declared)
    return value if abs(value) < unlimited else none


def _fmpy() -> Any:
    """The package FMPy."""
    return needs_extra("fmpy", "fmu", "runs FMUs")


def read_description(path: Path) -> Any:
    """Read the model description of an FMU and check that it can run here.

    Parameters
    ----------
    path : Path
        The .fmu file.

    Returns
    -------
    fmpy.model_description.ModelDescription
        FMPy's object.

    Raises
    ------
    InputError
        The file is no FMU, has no readable description, no co-simulation or no native code for
        this machine; FMPy is not installed.

    """
    fmpy = _fmpy()

    def refuse(expected: str, got: str, remedy: str) -> InputError:
        return InputError("path", expected=expected, got=f"{path.name}, {got}", remedy=remedy)

    if not path.is_file() or not zipfile.is_zipfile(path):
        got = "which is no zip file" if path.is_file() else "which is not there"
        raise refuse("an FMU, a zip file", got, "give the path of a .fmu file")
    expected = "an FMU with a readable modelDescription.xml"
    with refusing(path.name, expected=expected, remedy="export it again"):
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            Budget(path.name).take(archive.getinfo("modelDescription.xml").file_size)
        # Not validated against FMI's schema: many FMUs that run break it in some small way.
        description = fmpy.read_model_description(path, validate=False)
    if description.coSimulation is None or description.fmiMajorVersion == 1:
        raise refuse(
            "an FMU for co-simulation, FMI 2.0 or 3.0",
            f"FMI {description.fmiVersion} for "
            + ("model exchange" if description.coSimulation is None else "co-simulation"),
            "export it for co-simulation, which brings its own solver",
        )
    platform = fmpy.platform if description.fmiMajorVersion == 2 else fmpy.platform_tuple
    library = description.coSimulation.modelIdentifier + fmpy.sharedLibraryExtension
    if f"binaries/{platform}/{library}" not in names:
        there = {name.split("/")[1] for name in names if name.startswith("binaries/")} - {""}
        got = f"which has {', '.join(sorted(there)) or 'none'}"
        if platform in there:
            got = f"whose binaries/{platform} does not have it"
        raise refuse(
            f"native code for this machine, binaries/{platform}/{library}",
            got,
            "export it for this system",
        )
    return description


def extract(path: Path, folder: str) -> None:
    """Unpack an FMU; FMPy and zipfile refuse or confine members that point outside the folder.

    Parameters
    ----------
    path : Path
        The .fmu file.
    folder : str
        Where its members go.

    Raises
    ------
    InputError
        It cannot be unpacked, or the disk has no room for it.

    """
    expected, remedy = "an FMU that can be unpacked", "get or make the file again"
    with refusing(path.name, expected=expected, remedy=remedy):
        with zipfile.ZipFile(path) as archive:
            Budget(path.name, disk=folder).take(sum(e.file_size for e in archive.infolist()))
        _fmpy().extract(path, folder)


def find_scalars(description: Any, argument: str, names: Sequence[str]) -> list[Scalar]:
    """Find the numbers that are channels.

    Parameters
    ----------
    description : fmpy.model_description.ModelDescription
        The FMU's description.
    argument : {"inputs", "outputs"}
        What the channels are, and the argument that errors name.
    names : sequence of str
        Names of scalar variables, of elements of arrays, or of arrays for all their elements;
        local variables may be named as outputs. Empty takes all inputs that are not constant, or
        all outputs.

    Returns
    -------
    list of Scalar
        The numbers in the order of the names.

    Raises
    ------
    InputError
        A variable that is missing, of another causality or no number.

    """
    causality = argument.removesuffix("s")
    able = [
        variable
        for variable in description.modelVariables
        if variable.type in SCALARS
        and not variable.clocks
        and (variable.causality == causality or (causality, variable.causality) in HIDDEN)
    ]
    found = {each.name: each for variable in able for each in _scalars(variable, argument)}
    if not names:
        own = [each for each in found.values() if each.variable.causality == causality]
        return [each for each in own if causality == "output" or not each.constant]
    arrays = {variable.name: variable for variable in able if variable.shape}
    chosen: list[Scalar] = []
    for name in names:
        if name in arrays:
            chosen += _scalars(arrays[name], argument)
            continue
        if name not in found:
            every = {variable.name: variable for variable in description.modelVariables}
            local = " or local" if causality == "output" else ""
            expected = f"variables that are an {causality}{local} and a number"
            got = f"{name!r}, {_description(every.get(name))}"
            remedy = _close_matches(name, found)
            raise InputError(argument, expected=expected, got=got, remedy=remedy)
        chosen.append(found[name])
    return chosen


def _scalars(variable: Any, argument: str, *, max_scalars: int = 1_000_000) -> Iterator[Scalar]:
    """The elements of an array; of another variable itself.

    Parameters
    ----------
    max_scalars : int, default 1_000_000
        Largest number of scalars that one array may hold, since a file of some bytes may declare
        any.

    """
    if not variable.shape:
        yield Scalar(variable.name, variable)
        return
    fits = prod(variable.shape) <= max_scalars
    expected = f"arrays of at most {max_scalars} numbers"
    got = f"{variable.name!r} of shape {variable.shape}"
    require(fits, argument, expected=expected, got=got, remedy="export the FMU with smaller arrays")
    for place, index in enumerate(np.ndindex(variable.shape)):
        yield Scalar(f"{variable.name}[{','.join(map(str, index))}]", variable, place)


def _description(variable: Any) -> str:
    """Why a variable cannot be a channel."""
    if variable is None:
        return "which the FMU does not have"
    clocked = " with a clock" if variable.clocks else ""
    return f"whose causality is {variable.causality}, type {variable.type}{clocked}"


def _close_matches(name: str, names: Sequence[str] | Mapping[str, Any]) -> str:
    """Names that are similar, and the names that exist."""
    near = difflib.get_close_matches(name, names, n=3)
    meant = f"did you mean {' or '.join(near)}? " if near else ""
    more = f", … ({len(names)} in all)" if len(names) > 10 else ""
    return f"{meant}there are: {', '.join(list(names)[:10]) or 'none'}{more}"


def _declared(variable: Any, attribute: str) -> Any:
    """An attribute of a variable, or else of the type it refers to."""
    value = getattr(variable, attribute)
    return value if value is not None else getattr(variable.declaredType, attribute, None)


def channels_of(scalars: Sequence[Scalar]) -> Channels:
    """Channels of numbers: their names and units; "1" where a variable has no unit."""
    return Channels(
        tuple(each.name for each in scalars),
        tuple(_declared(each.variable, "unit") or "1" for each in scalars),
    )


def limits_of(inputs: Sequence[Scalar], outside: Literal["refuse", "clip"]) -> Limits | None:
    """Limits of inputs: the ranges that the FMU declares; None where it declares none."""
    bounds = [each.bounds for each in inputs]
    low, high = tuple(low for low, _ in bounds), tuple(high for _, high in bounds)
    return None if np.isinf(bounds).all() else Limits(low, high, outside)


def _settable(description: Any) -> dict[str, Any]:
    """The scalar variables that can be set before a run, by name."""
    from fmpy.simulation import settable_in_initialization_mode, settable_in_instantiated

    return {
        variable.name: variable
        for variable in description.modelVariables
        if (settable_in_instantiated(variable) or settable_in_initialization_mode(variable))
        and variable.causality != "structuralParameter"
        and variable.type in (*SCALARS, "String")
        and not variable.shape
    }


def adjustable(description: Any) -> list[tuple[str, str, float | None, float | None, float | None]]:
    """Numbers that can be set before a run.

    Parameters
    ----------
    description : fmpy.model_description.ModelDescription
        The FMU's description.

    Returns
    -------
    list of (str, str, float or None, float or None, float or None)
        Name, unit, start, least and greatest value of each, None where the FMU states none.
        Parameters come first; other numbers, such as starts of states, have no range.

    """
    able = [
        each
        for each in _settable(description).values()
        if each.type in NUMBERS and each.causality not in ("input", "independent")
    ]
    found = []
    for each in sorted(able, key=lambda each: each.causality != "parameter"):
        ends = Scalar(each.name, each).bounds if each.causality == "parameter" else (np.inf,) * 2
        low, high = (None if np.isinf(end) else end for end in ends)
        start = None if each.start in (None, "") else float(each.start)
        found.append((each.name, _declared(each, "unit") or "1", start, low, high))
    return found


def start_column(
    description: Any, name: str, value: Any, count: int, inputs: Sequence[str]
) -> list[Any]:
    """Check a start value and give each trajectory its own.

    Parameters
    ----------
    description : fmpy.model_description.ModelDescription
        The FMU's description.
    name : str
        Name of a variable.
    value : float, str or array_like, shape (count,)
        One value for all trajectories or one each.
    count : int
        The number of trajectories.
    inputs : sequence of str
        The command channels, which have no start value.

    Returns
    -------
    list
        One value per trajectory, of the variable's type.

    Raises
    ------
    InputError
        A variable that cannot be set before a run, or a value that does not fit its type.

    """
    able = {each: v for each, v in _settable(description).items() if each not in inputs}
    expected = "scalar variables that can be set before a run, and are no commands"
    remedy = _close_matches(name, able)
    require(name in able, "start", expected=expected, got=repr(name), remedy=remedy)
    kind = able[name].type
    array = np.asarray(value)
    fits = array.shape in ((), (count,)) and array.dtype.kind in (
        "U" if kind == "String" else "biuf"
    )
    if fits and kind != "String":
        fits = bool(np.isfinite(array).all())
        if kind not in NUMBERS:
            fits = fits and not np.any(array % 1)
    require(
        fits,
        "start",
        expected=f"for {name} ({kind}) one fitting value, or one per trajectory, {count}",
        got=f"{array.dtype} of shape {array.shape}" if array.ndim else repr(value),
        remedy="give finite numbers, whole ones for whole types",
    )
    return np.broadcast_to(array, (count,)).tolist()
