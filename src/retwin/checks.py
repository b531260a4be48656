"""Checks of arguments: each returns the value, or raises an `InputError` in one line.

A message has four parts: the argument, what was expected, what came, and the remedy. The checks
here cover what most functions ask for; `require` states anything else.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Sized
from math import inf, isfinite
from numbers import Integral, Real
from types import ModuleType
from typing import Any, TypeVar

from retwin.errors import InputError

__all__ = ["at_least", "finite", "needs_extra", "one_of", "one_per", "positive", "require", "whole"]

T = TypeVar("T")


def require(condition: object, argument: str, *, expected: str, got: object, remedy: str) -> None:
    """Raise an `InputError` unless `condition` is true; `got` is shown by its `str`."""
    if not condition:
        raise InputError(argument, expected=expected, got=str(got), remedy=remedy)


def one_of(argument: str, value: T, choices: Iterable[T], *, remedy: str = "") -> T:
    """`value`, if it is one of `choices`."""
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
    least: float = -inf,
    most: float = inf,
    unit: str = "",
    remedy: str = "",
) -> float:
    """`value`, if it is a finite number from `least` to `most`, ends included; never a bool."""
    bounds = [f"of at least {least:g}"] * (least > -inf) + [f"of at most {most:g}"] * (most < inf)
    expected = ["a finite number", " and ".join(bounds), unit and f"in {unit}"]
    require(
        _real(value) and least <= value <= most,
        argument,
        expected=" ".join(filter(None, expected)),
        got=repr(value),
        remedy=remedy or "give a number in that range",
    )
    return float(value)


def positive(argument: str, value: Any, *, unit: str = "", remedy: str = "") -> float:
    """`value`, if it is a finite number above 0."""
    require(
        _real(value) and value > 0,
        argument,
        expected=f"a positive number{f' of {unit}' if unit else ''}",
        got=repr(value),
        remedy=remedy or (f"give it in {unit}" if unit else "give a number above 0"),
    )
    return float(value)


def whole(
    argument: str, value: Any, *, least: int = 0, most: int | None = None, remedy: str = ""
) -> int:
    """`value`, if it is a whole number from `least` to `most`; never a bool."""
    number = isinstance(value, Integral) and not isinstance(value, bool)
    span = f"of at least {least}" if most is None else f"from {least} to {most}"
    require(
        number and least <= value and (most is None or value <= most),
        argument,
        expected=f"a whole number {span}",
        got=repr(value),
        remedy=remedy or "give a whole number in that range",
    )
    return int(value)


def _real(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and isfinite(value)


def at_least(argument: str, values: Sized, least: int, what: str, *, remedy: str) -> None:
    """Require a collection to have at least `least` members, which `what` names in the plural."""
    require(
        len(values) >= least,
        argument,
        expected=f"at least {least} {what}",
        got=str(len(values)),
        remedy=remedy,
    )


def one_per(argument: str, values: Sized, count: int, what: str, *, remedy: str = "") -> None:
    """Require a collection to have `count` members, one for each `what`."""
    require(
        len(values) == count,
        argument,
        expected=f"one per {what}, {count}",
        got=str(len(values)),
        remedy=remedy or f"give one for each {what}",
    )


def needs_extra(module: str, extra: str, purpose: str) -> ModuleType:
    """The imported module of an optional package.

    Raises InputError, with the command that installs the extra, if the package is missing.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"the package {module.partition('.')[0]}",
            expected=f"it to be installed, since it {purpose}",
            got=str(error),
            remedy=f'install it: pip install "retwin[{extra}]"',
        ) from None
