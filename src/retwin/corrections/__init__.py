"""Correction operators g: how a discrepancy z changes nominal outputs, and how z is inferred."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from retwin.corrections.delay_offset import DelayOffset
from retwin.corrections.protocol import Context, Correction, Discrepancy, Head
from retwin.errors import InputError

__all__ = [
    "Context",
    "Correction",
    "DelayOffset",
    "Discrepancy",
    "Head",
    "from_config",
    "to_config",
]

_OPERATORS: dict[str, type] = {"DelayOffset": DelayOffset}


def to_config(correction: Any) -> dict[str, Any]:
    """A correction's settings as plain JSON values; InputError for one that cannot be loaded."""
    if type(correction) not in _OPERATORS.values():
        raise InputError(
            "correction",
            expected=f"one of {', '.join(_OPERATORS)}, to be saved",
            got=type(correction).__name__,
            remedy="use the model without saving it: loading runs no code that a file names",
        )
    return {"kind": type(correction).__name__, **asdict(correction)}


def from_config(values: dict[str, Any]) -> Correction:
    """The correction that `to_config` wrote; InputError for an unknown kind."""
    kind = values.get("kind")
    if kind not in _OPERATORS:
        raise InputError(
            "correction",
            expected=f"one of {', '.join(_OPERATORS)}",
            got=repr(kind),
            remedy="load the model with the version of retwin that wrote it",
        )
    parts = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items() if k != "kind"}
    return _OPERATORS[kind](**parts)
