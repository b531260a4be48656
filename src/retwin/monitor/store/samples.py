"""What the store takes: machines, their samples and states; and the JSON of samples."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import at_most, given, require, whole
from retwin.data.logs.signals import nanoseconds
from retwin.errors import InputError
from retwin.monitor.store.audit import Entry
from retwin.serialisation.files import refusing

T = TypeVar("T")

EARLIEST, LATEST = -(2**63), 2**63 - 1
"""The earliest and the latest stream time, in nanoseconds."""
SECOND = 10**9
"""Nanoseconds of a second."""
LONGEST = 100_000
"""Samples of a document at most."""
KEYS = {"asset", "time", "time_ns", "values"}
REMEDY = 'send {"asset": "line1", "time": 1700000000.0, "values": {"T1": 21.3}}'
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


def pack(
    update: Update, known: Mapping[str, tuple[int, int]]
) -> tuple[int, NDArray, list[tuple], list[tuple]]:
    """An update as rows of the tables: the key of its asset, times and rows of its samples, and the
    row of its state, if it has one. `known` are keys and channels of the store's assets.

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
        return key, stamps, rows, []
    time = update.time if update.time is not None else max(stamps.tolist(), default=None)
    whole(f"time of the state of {update.asset}", time, at_least=EARLIEST, at_most=LATEST)
    return key, stamps, rows, [(key, time, blob)]


def one_asset(known: Mapping[str, T], name: str) -> T:
    """What is known of an asset by its name; InputError if it is unknown."""
    expected = f"one of the store's assets ({', '.join(list(known)[:5]) or 'none'})"
    remedy = "add it first, with add_asset"
    return given("asset", known.get(name), expected, got=repr(name)[:80], remedy=remedy)


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of one machine.

    Parameters
    ----------
    asset : str
        Its name.
    times : array (n,) of int64
        Nanoseconds since the epoch, in the order of arrival.
    values : array (n, d_u + d_y)
        Commands, then outputs; what is not finite is missing.

    Raises
    ------
    InputError
        Arrays of other shapes or types.

    """

    asset: str
    times: NDArray
    values: NDArray

    def __post_init__(self) -> None:
        times, values = np.asarray(self.times), np.asarray(self.values, dtype=float)
        require(
            times.dtype.kind == "i"
            and times.ndim == 1
            and values.shape[:1] == times.shape
            and values.ndim == 2,
            f"samples of {self.asset}",
            expected="whole times (n,) in nanoseconds and values (n, channels)",
            got=f"{times.dtype} {times.shape} and {values.shape}",
            remedy="give one row of values for each time",
        )
        object.__setattr__(self, "times", times.astype(np.int64))
        object.__setattr__(self, "values", np.where(np.isfinite(values), values, np.nan))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A complete trajectory of one machine, at the sample rate of its twin.

    Parameters
    ----------
    asset : str
        Its name.
    begin : int
        Time of the first sample, in nanoseconds since the epoch.
    values : array (T, d_u + d_y)
        Commands, then outputs; what is not finite is missing.

    """

    asset: str
    begin: int
    values: NDArray

    def samples(self, rate: float) -> Samples:
        """Its samples at that rate in Hz; times end before they are out of range."""
        period = SECOND / rate
        times = [min(self.begin + round(k * period), LATEST) for k in range(len(self.values))]
        return Samples(self.asset, np.array(times, dtype=np.int64), self.values)


def places(times: NDArray, begin: int, rate: float) -> tuple[NDArray, NDArray]:
    """Places from `begin` on at a rate in Hz that times (n,) in ns are nearest to, each once in
    order, and the first time of each.
    """
    place = np.round((times - begin) * (rate / SECOND)).astype(np.int64)
    return np.unique(place, return_index=True)


def parse(
    document: bytes | str, channels: Callable[[str], Sequence[str]], asset: str | None = None
) -> list[Samples | Trajectory]:
    """The samples of a JSON document, of one machine after the other, and then its trajectories.

    Parameters
    ----------
    document : bytes or str
        An object `{"asset": "line1", "time": 1700000000.25, "values": {"heater": 1, "T1": 21.3}}`,
        an array of such objects, or one on each line. `time` is in s since the epoch or ISO 8601
        with an offset; `time_ns` in its place is a whole number of nanoseconds. A channel that is
        absent, null or not finite is missing. Where `values` are arrays, the object is a
        trajectory, `time` is that of its first sample, and the others follow at the sample rate of
        the twin.
    channels : callable
        Gives the names of the channels of a machine, commands first; it raises an InputError for an
        unknown one (`Live.channels`).
    asset : str, optional
        The one machine that the document is about; its objects need not name it.

    Raises
    ------
    InputError
        No such document, more than 100 000 samples, or an unknown machine or channel.

    """
    rows: dict[str, list[tuple[int, list[float]]]] = {}
    known = cache(lambda name: {channel: i for i, channel in enumerate(channels(name))})
    trajectories: list[Samples | Trajectory] = []
    count = 0
    needed = {"values"} if asset is not None else {"asset", "values"}
    for number, each in enumerate(_objects(document)):
        place = f"sample {number}"
        given = each.get("values") if isinstance(each, dict) else None
        columns = given.values() if isinstance(given, dict) else ()
        length = max((len(column) for column in columns if isinstance(column, list)), default=0)
        count += max(1, length)
        at_most("samples", count, LONGEST, "in a document", remedy="send them in parts")
        fits = isinstance(each, dict) and needed <= each.keys() <= KEYS
        expected = f"an object with {', '.join(sorted(needed))} and time"
        got = f"{type(each).__name__} {repr(each)[:60]}"
        require(fits, place, expected=expected, got=got, remedy=REMEDY)
        name = each.get("asset", asset)
        if not isinstance(name, str) or asset not in (None, name):
            raise _refused(f"{place}: asset", name, "its name" if asset is None else repr(asset))
        order = known(name)
        time, block = _time(each, place), _block(given, length, order, place)
        if length:
            trajectories.append(Trajectory(name, time, np.array(block)))
        else:
            rows.setdefault(name, []).append((time, block[0]))
    samples = []
    for name, own in rows.items():
        times, values = zip(*own, strict=True)
        samples.append(Samples(name, np.array(times, np.int64), np.array(values)))
    return [*samples, *trajectories]


def _objects(document: bytes | str) -> Iterator[Any]:
    """The objects of a document: one, those of an array, or one of each line."""
    expected = "a JSON object, an array of them, or one on each line"
    with refusing("samples", expected=expected, remedy=REMEDY):
        text = document if isinstance(document, str) else document.decode("utf-8")
        lines = [each for each in text.split("\n") if each.strip()]
        try:
            whole = json.loads(text)
        except json.JSONDecodeError:
            if len(lines) < 2:
                raise
            yield from map(json.loads, lines)
        else:
            yield from whole if isinstance(whole, list) else [whole]


def _refused(place: str, given: object, expected: str, remedy: str = REMEDY) -> InputError:
    """The error about a part of a document."""
    return InputError(place, expected=expected, got=repr(given)[:60], remedy=remedy)


def _time(each: dict[str, Any], place: str) -> int:
    """The time of a sample in nanoseconds."""
    given = each.get("time_ns", each.get("time"))
    made: int | None = None
    if len({"time", "time_ns"} & each.keys()) == 1:
        if isinstance(given, str) and "time" in each:
            try:
                moment = datetime.fromisoformat(given)
                made = nanoseconds(moment) if moment.tzinfo else None
            except ValueError:
                made = None
        elif isinstance(given, int) and not isinstance(given, bool):
            made = given if "time_ns" in each else given * SECOND
        elif isinstance(given, float) and "time" in each and abs(given) < LATEST:
            made = round(given * SECOND)
    if made is not None and EARLIEST < made < LATEST:
        return made
    expected = "seconds since the epoch, ISO 8601 with an offset, or whole time_ns"
    raise _refused(f"{place}: time", given, expected)


def _block(values: Any, length: int, places: dict[str, int], place: str) -> list[list[float]]:
    """The values (T, channels) of a trajectory, or of one sample if its length is 0.

    NaN where one is missing.
    """
    if not isinstance(values, dict):
        raise _refused(f"{place}: values", values, "an object of channels")
    made = [[np.nan] * len(places) for _ in range(max(1, length))]
    for name, value in values.items():
        if name not in places:
            expected = f"channels among {', '.join(places)}"
            remedy = "leave it out, or correct its name"
            raise _refused(f"{place}: values", name, expected, remedy)
        column, several = value if length else [value], isinstance(value, list)
        if length and not (several and len(value) == length):
            got, expected = len(value) if several else value, f"an array of {length} numbers"
            remedy = "send one value per sample of each channel, null where it is missing"
            where = f"{place}: {repr(name)[:60]}"
            raise _refused(where, got, f"{expected}, as another channel has", remedy)
        for row, each in zip(made, column, strict=True):
            try:
                if not isinstance(each, int | float | None):
                    raise TypeError
                row[places[name]] = np.nan if each is None else float(each)
            except (TypeError, OverflowError):
                remedy = "send numbers as JSON numbers"
                raise _refused(f"{place}: {name}", each, "a number or null", remedy) from None
    return made
