"""What a commit to the store consists of: assets, their new samples and states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import given, require, whole
from retwin.monitor.store.audit import Entry
from retwin.serialisation.files import refusing

T = TypeVar("T")

EARLIEST, LATEST = -(2**63), 2**63 - 1
"""The earliest and the latest stream time, in nanoseconds."""
WORD = np.dtype("<f8")
"""How a value is stored."""


@dataclass(frozen=True)
class Asset:
    """A machine that is watched.

    Attributes
    ----------
    name : str
        Its unique name.
    channels : int
        Values per sample.
    settings : dict
        Settings of its monitor, as JSON values.
    version : int, optional
        The version of the twin that watches it.

    """

    name: str
    channels: int
    settings: dict[str, Any] = field(default_factory=dict)
    version: int | None = None


@dataclass(frozen=True)
class Update:
    """What one asset adds in a commit.

    Parameters
    ----------
    asset : str
        Its name.
    times : array (n,)
        Stream times of new samples in nanoseconds, in any order.
    values : array (n, channels)
        Their values; NaN where missing.
    state : mapping of str to array, optional
        The state of its monitor after these samples, which replaces the former one.
    time : int, optional
        The stream time of the state in nanoseconds; by default the latest of `times`.

    """

    asset: str
    times: ArrayLike = ()
    values: ArrayLike = ()
    state: Mapping[str, NDArray] | None = None
    time: int | None = None


@dataclass(frozen=True)
class Committed:
    """What a commit acknowledged.

    Attributes
    ----------
    repeated : dict of str to array (m,)
        Per asset, times of samples that were stored already or repeated within the commit. Their
        new values are not stored.
    entries : list of Entry
        The new entries of the log.

    """

    repeated: dict[str, NDArray]
    entries: list[Entry]


@dataclass(frozen=True)
class Packed:
    """An update as rows of the tables: the times of its samples, their rows, and the state's."""

    asset: str
    key: int
    times: NDArray
    rows: list[tuple]
    state: tuple | None


def pack(update: Update, known: Mapping[str, tuple[int, int]]) -> Packed:
    """An update as rows, with the keys and the channels of the store's assets by their names.

    Raises
    ------
    InputError
        The asset is unknown, an array has another shape or type, or the state has no time.

    """
    from safetensors.numpy import save

    key, channels = one_asset(known, update.asset)
    where = f"update of {update.asset}"
    expected = f"whole times (n,) and values (n, {channels}), and a state of numeric arrays"
    remedy = "give times in nanoseconds, one row of values for each, and arrays by their names"
    with refusing(where, expected=expected, remedy=remedy):
        times, values = np.asarray(update.times), np.asarray(update.values, dtype=WORD)
        if times.size == 0:
            times, values = np.empty(0, np.int64), values.reshape(0, channels)
        got, shapes = f"{times.dtype} {times.shape} and {values.shape}", (times.shape, values.shape)
        right = times.dtype.kind == "i" and shapes == ((len(times),), (len(times), channels))
        require(right, where, expected=expected, got=got, remedy=remedy)
        # C order, since the writer takes the memory of an array as it lies.
        arrays = {name: np.asarray(each, order="C") for name, each in (update.state or {}).items()}
        blob = save(arrays)
    stamps = times.astype(np.int64)
    data, size = values.tobytes(), channels * WORD.itemsize
    rows = [(key, time, data[i * size : (i + 1) * size]) for i, time in enumerate(stamps.tolist())]
    if update.state is None:
        return Packed(update.asset, key, stamps, rows, None)
    time = update.time if update.time is not None else max(stamps.tolist(), default=None)
    whole(f"time of the state of {update.asset}", time, at_least=EARLIEST, at_most=LATEST)
    return Packed(update.asset, key, stamps, rows, (key, time, blob))


def one_asset(known: Mapping[str, T], name: str) -> T:
    """What is known of an asset by its name; InputError if it is unknown."""
    expected = f"one of the store's assets ({', '.join(list(known)[:5]) or 'none'})"
    remedy = "add it first, with add_asset"
    return given("asset", known.get(name), expected, got=repr(name)[:80], remedy=remedy)
