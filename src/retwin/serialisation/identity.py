"""What an object is, as a SHA-256 that is the same in another process: is this the same plan?"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import MethodType
from typing import Any

import numpy as np

from retwin.serialisation.files import sha256

__all__ = ["identity"]

DEEPEST = 12
"""Levels of objects within objects; deeper ones are told by their kind alone."""


def identity(value: object) -> str:
    """The SHA-256 of what `value` is: kind, settings, arrays, weights, contents of its files.

    An object whose files name other files tells in `fingerprint`, a text, what it is with those.
    A function or class is known by its name. Not by pickle, which depends on what happens to be
    the same object, and is silent on files.
    """
    text = json.dumps(_told(value, DEEPEST), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _told(value: Any, deep: int) -> Any:
    """`value` as JSON."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        value = value.tolist()
    if isinstance(value, np.generic | np.ndarray):
        array = np.ascontiguousarray(value)
        numbers = array.reshape(-1).view(np.uint8).data  # as they lie there: they may be a map
        return [array.dtype.str, list(array.shape), hashlib.sha256(numbers).hexdigest()]
    if isinstance(value, Path):
        return sha256(value) if value.exists() else str(value)
    if deep == 0:
        return _kind(value)
    if isinstance(value, Mapping):
        return [[str(key), _told(each, deep - 1)] for key, each in value.items()]
    if isinstance(value, list | tuple):
        return [_told(each, deep - 1) for each in value]
    if hasattr(value, "__qualname__") and not isinstance(value, MethodType):  # function or class
        return f"{value.__module__}:{value.__qualname__}"
    fingerprint = _told(getattr(value, "fingerprint", ""), 0)
    return [_kind(value), _told(_contents(value), deep - 1), fingerprint]


def _contents(value: Any) -> Any:
    if isinstance(value, MethodType):
        return [value.__func__, value.__self__]
    if isinstance(value, partial):
        return [value.func, value.args, value.keywords]
    if dataclasses.is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if hasattr(value, "state_dict"):  # a network: what is private there is torch's bookkeeping
        public = {name: each for name, each in vars(value).items() if name[0] != "_"}
        weights = {name: np.asarray(each) for name, each in value.state_dict().items()}
        return [public, repr(value), weights]
    if hasattr(value, "__dict__"):
        return vars(value)
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))


def _kind(value: object) -> str:
    return f"{type(value).__module__}:{type(value).__qualname__}"
