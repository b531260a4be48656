"""Checks of arguments: each returns the value, or raises an `InputError` in one line.

A message has four parts: the argument, what was expected, what came, and the remedy, for which each
check has a default. `require` states what no other check covers.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterable, Sequence, Sized
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution
from math import inf, isfinite
from numbers import Integral, Real
from types import ModuleType
from typing import Any, TypeVar
from urllib.parse import unquote, urlsplit

from retwin.errors import InputError

T = TypeVar("T")


def require(condition: object, argument: str, *, expected: str, got: object, remedy: str) -> None:
    """Raise an `InputError` unless `condition` is true; the message shows `got` by its `str`.

    Write comparisons so that NaN makes the condition false: `x > 0`, not `not x <= 0`.
    """
    if not condition:
        raise InputError(argument, expected=expected, got=str(got), remedy=remedy)


def instance(argument: str, value: Any, kind: type[T], *, remedy: str) -> T:
    """`value`, if it is an object of a class; another one is an `InputError`."""
    got = type(value).__name__
    require(isinstance(value, kind), argument, expected=kind.__name__, got=got, remedy=remedy)
    return value


def one_of(argument: str, value: T, choices: Iterable[T], *, remedy: str = "") -> T:
    """`value`, if it is one of `choices` and of the same type.

    Raises
    ------
    InputError
        It is not.

    """
    known = list(choices)
    require(
        any(type(value) is type(each) and value == each for each in known),
        argument,
        expected=f"one of {', '.join(map(str, known))}",
        got=repr(value),
        remedy=remedy or "check the spelling",
    )
    return value


def finite(
    argument: str,
    value: Any,
    *,
    at_least: float = -inf,
    at_most: float = inf,
    unit: str = "",
    remedy: str = "",
) -> float:
    """`value`, if it is a finite number from `at_least` to `at_most`, ends included.

    Parameters
    ----------
    argument : str
        The name of the argument in the message.
    value : number
        A Python or numpy number; a bool is none.
    at_least, at_most : float
        The bounds.
    unit : str
        The unit that the message states.
    remedy : str
        What to do; by default to give a number in that range.

    Raises
    ------
    InputError
        It is NaN, infinite, out of range or no number.

    """
    low = f"of at least {at_least:g}" if at_least > -inf else ""
    high = f"of at most {at_most:g}" if at_most < inf else ""
    bounds = f"from {at_least:g} to {at_most:g}" if low and high else low or high
    expected = ["a finite number", bounds, unit and f"in {unit}"]
    require(
        _real(value) and at_least <= value <= at_most,
        argument,
        expected=" ".join(filter(None, expected)),
        got=repr(value),
        remedy=remedy or "give a number in that range",
    )
    return float(value)


def positive(argument: str, value: Any, *, unit: str = "", remedy: str = "") -> float:
    """`value`, if it is a finite number above 0; see `finite`."""
    require(
        _real(value) and value > 0,
        argument,
        expected=f"a positive number{f' of {unit}' if unit else ''}",
        got=repr(value),
        remedy=remedy or (f"give it in {unit}" if unit else "give a number above 0"),
    )
    return float(value)


def apart(one: float, other: float) -> tuple[str, str]:
    """Two numbers as texts, with three digits or as many as make them differ."""
    for digits in range(3, 17):
        made = f"{one:.{digits}g}", f"{other:.{digits}g}"
        if made[0] != made[1]:
            break
    return made


def whole(
    argument: str, value: Any, *, at_least: int = 0, at_most: int | None = None, remedy: str = ""
) -> int:
    """`value`, if it is a whole number from `at_least` to `at_most`, ends included.

    Raises
    ------
    InputError
        It is a bool, a float, out of range or no number.

    """
    number = isinstance(value, Integral) and not isinstance(value, bool)
    span = f"of at least {at_least}" if at_most is None else f"from {at_least} to {at_most}"
    require(
        number and at_least <= value and (at_most is None or value <= at_most),
        argument,
        expected=f"a whole number {span}",
        got=repr(value),
        remedy=remedy or "give a whole number in that range",
    )
    return int(value)


def _real(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and isfinite(value)


def at_least(argument: str, values: Sized, count: int, what: str, *, remedy: str) -> None:
    """Require a collection to have at least `count` members, which `what` names in the plural."""
    require(
        len(values) >= count,
        argument,
        expected=f"at least {count} {what}",
        got=str(len(values)),
        remedy=remedy,
    )


def at_most(argument: str, count: int, limit: int, what: str, *, remedy: str) -> None:
    """Require no more than `limit` of something, which `what` names in the plural."""
    require(count <= limit, argument, expected=f"at most {limit} {what}", got=count, remedy=remedy)


def nothing(argument: str, found: Iterable[object], expected: str, *, remedy: str) -> None:
    """Require that nothing was found; the message lists what was."""
    listed = [str(each) for each in found]
    require(not listed, argument, expected=expected, got=", ".join(listed), remedy=remedy)


def same_names(
    argument: str, names: Iterable[str], wanted: Iterable[str], what: str, *, remedy: str
) -> None:
    """Require the names that `wanted` has, each once, in any order; `what` stands before them."""
    names, wanted = list(names), list(wanted)
    require(
        sorted(names) == sorted(wanted),
        argument,
        expected=f"{what} {', '.join(wanted)}",
        got=", ".join(names) or "none",
        remedy=remedy,
    )


def ends_in(argument: str, path: object, suffixes: Sequence[str], *, remedy: str) -> None:
    """Require the name of a file to end in one of some suffixes, in small letters or capitals."""
    expected = f"a name that ends in {' or '.join(suffixes)}"
    fits = str(path).lower().endswith(tuple(suffixes))
    require(fits, argument, expected=expected, got=path, remedy=remedy)


def existing(
    argument: str,
    path: object,
    there: bool,
    what: str = "an existing file or folder",
    *,
    remedy: str = "check the name",
) -> None:
    """Require what is at a path to be there, which `what` names."""
    got = f"{path}, where there is none"
    require(there, argument, expected=what, got=got, remedy=remedy)


def given(argument: str, value: T | None, expected: str, *, got: object = "none", remedy: str) -> T:
    """`value`, if it is not None."""
    if value is None:
        raise InputError(argument, expected=expected, got=str(got), remedy=remedy)
    return value


def one_per(argument: str, values: Sized, count: int, what: str, *, remedy: str = "") -> None:
    """Require a collection to have `count` members, one for each `what`."""
    require(
        len(values) == count,
        argument,
        expected=f"one per {what}, {count}",
        got=str(len(values)),
        remedy=remedy or f"give one for each {what}",
    )


def agree(
    argument: str,
    given: object,
    model: object,
    whose: str,
    *,
    names: Iterable[str] = ("inputs", "outputs", "rate"),
    remedy: str,
) -> None:
    """Require an object to have the channels and the rate of a model, or other attributes of it.

    `whose` describes those of the model in the message: "that of the twin".
    """
    for name in names:
        expected, got = getattr(model, name), getattr(given, name)
        require(
            got == expected,
            f"{argument}.{name}",
            expected=f"{whose}, {expected}",
            got=got,
            remedy=remedy,
        )


def needs_extra(module: str, extra: str, purpose: str) -> ModuleType:
    """The imported module of an optional package.

    Parameters
    ----------
    module : str
        Its dotted name.
    extra : str
        The extra of retwin that installs it.
    purpose : str
        A verb phrase that says what the package does, for the message.

    Raises
    ------
    InputError
        The package is missing; the message holds the command that installs it.

    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"the package {module.partition('.')[0]}",
            expected=f"it to be installed, since it {purpose}",
            got=str(error),
            remedy=f"install it: {install_command(extra)}",
        ) from None


def install_command(extra: str = "") -> str:
    """The command that installs retwin or an extra of it; in a clone, from there."""
    extra = extra and f"[{extra}]"
    with suppress(PackageNotFoundError):
        about = json.loads(distribution("retwin").read_text("direct_url.json") or "{}")
        if about.get("dir_info", {}).get("editable"):
            folder = unquote(urlsplit(about["url"]).path)
            return f'pip install -e "{folder}{extra}"'
    return f'pip install "retwin{extra}"'
