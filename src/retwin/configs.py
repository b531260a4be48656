"""Frozen config objects as JSON values and back, for a closed list of kinds: files run no code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from retwin.errors import InputError

__all__ = ["from_config", "to_config"]


def to_config(value: Any, kinds: Sequence[type]) -> dict[str, Any]:
    """The settings of a frozen dataclass; InputError for a kind that could not be loaded again."""
    if type(value) not in kinds:
        raise InputError(
            "config",
            expected=f"one of {_names(kinds)}, to be saved",
            got=type(value).__name__,
            remedy="use the model without saving it: loading runs no code that a file names",
        )
    return {"kind": type(value).__name__, **asdict(value)}


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
    parts = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items() if k != "kind"}
    return known[kind](**parts)


def _names(kinds: Sequence[type]) -> str:
    return ", ".join(kind.__name__ for kind in kinds)
