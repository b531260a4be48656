"""Digests of objects that are equal in all processes, to recognise the same plan or data."""

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


def identity(value: object, *, max_depth: int = 12) -> str:
    """The SHA-256 of an object: its class, settings, arrays, weights and the contents of its files.

    An object whose files name other files has a text `fingerprint` that depends on those. Functions
    and classes count by their names. Pickle is not used, since its bytes depend on which parts are
    the same object, and not on the contents of files.

    Parameters
    ----------
    max_depth : int, default 12
        Levels of nested objects; of deeper ones only the class counts, which ends cycles.

    """
    text = json.dumps(_describe(value, max_depth), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _describe(value: Any, depth: int) -> Any:
    """`value` as JSON."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        value = value.tolist()
    if isinstance(value, np.generic | np.ndarray):
        array = np.ascontiguousarray(value)
        numbers = array.reshape(-1).view(np.uint8).data  # without a copy: it may be a memory map
        return [array.dtype.str, list(array.shape), hashlib.sha256(numbers).hexdigest()]
    if isinstance(value, Path):
        return sha256(value) if value.exists() else str(value)
    if depth == 0:
        return _kind(value)
    if isinstance(value, Mapping):
        return [[str(key), _describe(each, depth - 1)] for key, each in value.items()]
    if isinstance(value, list | tuple):
        return [_describe(each, depth - 1) for each in value]
    if hasattr(value, "__qualname__") and not isinstance(value, MethodType):  # function or class
        return f"{value.__module__}:{value.__qualname__}"
    fingerprint = _describe(getattr(value, "fingerprint", ""), 0)
    return [_kind(value), _describe(_contents(value), depth - 1), fingerprint]


def _contents(value: Any) -> Any:
    if isinstance(value, MethodType):
        return [value.__func__, value.__self__]
    if isinstance(value, partial):
        return [value.func, value.args, value.keywords]
    if dataclasses.is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if hasattr(value, "state_dict"):  # a network, whose private attributes belong to torch
        public = {name: each for name, each in vars(value).items() if name[0] != "_"}
        weights = {name: np.asarray(each) for name, each in value.state_dict().items()}
        return [public, repr(value), weights]
    if hasattr(value, "__dict__"):
        return vars(value)
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))


def _kind(value: object) -> str:
    return f"{type(value).__module__}:{type(value).__qualname__}"
