"""Frozen config objects as JSON values and back, for a closed list of kinds: files run no code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

from retwin.errors import InputError

__all__ = ["from_config", "named", "to_config"]

T = TypeVar("T")


def to_config(value: Any, kinds: Sequence[type]) -> dict[str, Any]:
    """The settings of a frozen dataclass and of those inside it.

    Raises InputError for a kind that could not be loaded again.
    """
    if type(value) not in kinds:
        raise InputError(
            "config",
            expected=f"one of {_names(kinds)}, to be saved",
            got=type(value).__name__,
            remedy="use the model without saving it: loading runs no code that a file names",
        )
    parts = {each.name: getattr(value, each.name) for each in fields(value)}
    inside = {k: to_config(v, kinds) if is_dataclass(v) else v for k, v in parts.items()}
    return {"kind": type(value).__name__, **inside}


def from_config(values: Mapping[str, Any], kinds: Sequence[type]) -> Any:
    """The object that `to_config` told of; InputError for an unknown kind."""
    known = {kind.__name__: kind for kind in kinds}
    kind = values.get("kind")
    if kind not in known:
        raise InputError(
            "config",
            expected=f"one of {_names(kinds)}",
            got=repr(kind),
            remedy="load the model with the version of retwin that wrote it",
        )
    return known[kind](**{k: _part(v, kinds) for k, v in values.items() if k != "kind"})


def _part(value: Any, kinds: Sequence[type]) -> Any:
    """A setting as it was before JSON, which knows neither tuples nor our kinds."""
    if isinstance(value, Mapping):
        return from_config(value, kinds)
    return tuple(_part(v, kinds) for v in value) if isinstance(value, list) else value


def named(name: str, known: Mapping[str, T], argument: str) -> T:
    """What goes by that name; InputError, about `argument`, when nothing does."""
    if name not in known:
        raise InputError(
            argument,
            expected=f"one of {', '.join(known)}",
            got=repr(name),
            remedy="check the spelling",
        )
    return known[name]


def _names(kinds: Sequence[type]) -> str:
    return ", ".join(kind.__name__ for kind in kinds)
