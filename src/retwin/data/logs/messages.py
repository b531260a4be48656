"""Messages as numbers: the fields of ROS messages and JSON objects, each a signal of its own.

A field is `/topic.field.inner`. An element of an array is `position[shoulder]` where the message
names its elements in a list of texts beside it (`name`, `joint_names`, …), else `position[0]`. An
element of a list of messages is named by its own text `name`, `child_frame_id` or `key`.
"""

from __future__ import annotations

import keyword
import re
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from retwin.checks import at_most, require
from retwin.data.logs.signals import MAX_SIGNALS, NO_STAMP, UNWANTED, Clock, Signal, Skipped, inside

MAX_DEPTH = 12
"""Messages inside messages at most."""
MAX_NAME = 200
"""Characters of an element's name."""
OWN_NAMES = ("name", "child_frame_id", "key")
"""Texts by which an element of a list of messages is named."""
TYPE_NAME = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*){1,3}", re.ASCII)
STAMP = ("sec", "nanosec", "nsec", "secs", "nsecs")
"""Fields of a stamp, of which no signals are made."""


class Undecoded(Exception):
    """Messages that are not decoded; the message of this says why."""


class Types:
    """The types of ROS messages: those that a log defines, else those of ROS itself.

    The library makes Python code of definitions, so that each name in them is checked first.
    """

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self._store = get_typestore(Stores.EMPTY)
        self._known = get_typestore(Stores.LATEST)
        self._ros1 = get_typestore(Stores.ROS1_NOETIC)
        self._of_log: set[str] = set()

    def define(self, name: str, text: str, *, idl: bool = False) -> str:
        """Add the definition of a type, and of those inside it; its normalised name."""
        from rosbags.typesys import get_types_from_idl, get_types_from_msg
        from rosbags.typesys.msg import normalize_msgtype

        name = normalize_msgtype(name)
        if name in self._of_log:
            return name
        found: dict[str, Any] = {}
        if idl:
            separator = "=" * 80 + "\n"
            for part in text.split(separator) if separator in text else [text]:
                body = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
                if body.strip():
                    found.update(get_types_from_idl(body))
        else:
            found.update(get_types_from_msg(text, name))
        for own, (constants, fields) in found.items():
            for each in (*(c[0] for c in constants), *(f[0] for f in fields)):
                _require_name(each.isidentifier() and not each.startswith("__"), each)
            _require_name(TYPE_NAME.fullmatch(own), own)
        new = {own: fields for own, fields in found.items() if own not in self._store.fielddefs}
        self._store.register(new)
        self._of_log |= set(found)
        return name

    def decode(self, data: bytes, name: str, *, ros1: bool = False) -> Any:
        """The message of that type; `Undecoded` if the type is not known."""
        from rosbags.typesys.msg import normalize_msgtype

        name = normalize_msgtype(name)
        own = name in self._store.fielddefs
        store = self._store if own else (self._ros1 if ros1 else self._known)
        try:
            return store.deserialize_ros1(data, name) if ros1 else store.deserialize_cdr(data, name)
        except KeyError:  # of the type, or of one inside it
            raise Undecoded(
                f"messages of the type {name[:80]}, which the log does not define"
            ) from None


def _require_name(fine: object, name: str) -> None:
    expected, remedy = "names of types and fields", "the log is damaged, or was made to do harm"
    require(fine, "message definition", expected=expected, got=repr(name)[:60], remedy=remedy)


def _header_stamp(message: Any) -> int | None:
    """The stamp of a message's header in ns; None if it has none."""
    header = dict(_items(message)).get("header")
    parts = dict(_items(dict(_items(header)).get("stamp")))
    seconds = next((parts[each] for each in ("sec", "secs") if each in parts), None)
    rest = next((parts[each] for each in ("nanosec", "nsec", "nsecs") if each in parts), None)
    if not isinstance(seconds, int) or not isinstance(rest, int):
        return None
    return seconds * 10**9 + rest


class Series:
    """Numbers of messages, collected by their names.

    Where header stamps are wanted, a topic whose first message has none has the times of recording,
    which is noted.

    Parameters
    ----------
    wanted : frozenset of str or None
        The names of the signals to keep.
    clock : Clock
        Whether times are those of the recording or of the header stamps.

    """

    def __init__(self, wanted: frozenset[str] | None, clock: Clock) -> None:
        self._wanted = wanted
        self._stamped = clock.stamps == "header"
        self._has_stamps: dict[str, bool] = {}
        self._undecoded: set[tuple[str, str]] = set()
        self._times: dict[str, array[int]] = {}
        self._values: dict[str, array[float]] = {}
        self._skipped: dict[str, str] = {}

    def wants(self, topic: str) -> bool:
        """Whether a signal of that topic is wanted."""
        fine = self._wanted is None or any(inside(each, topic) for each in self._wanted)
        if not fine:
            self.skip(topic, UNWANTED)
        return fine

    def add(self, topic: str, kind: str, recorded: int, decode: Callable[[], Any]) -> None:
        """The numbers of a message that was recorded at a time in ns.

        Of a topic and kind of messages of which one is `Undecoded`, no other is tried.
        """
        if (topic, kind) in self._undecoded:
            return
        try:
            message = decode()
        except Undecoded as error:
            self._undecoded.add((topic, kind))
            self.skip(topic, str(error))
            return
        time = self._time(topic, recorded, message)
        for name, value in self._leaves(topic, message, 0):
            if self._wanted is not None and name not in self._wanted:
                self.skip(name, UNWANTED)
                continue
            times = self._times.get(name)
            if times is None:
                remedy = "name those that are wanted in the mapping"
                at_most(topic, len(self._times) + 1, MAX_SIGNALS, "signals", remedy=remedy)
                times = self._times[name] = array("q")
                self._values[name] = array("d")
            times.append(time)
            self._values[name].append(value)

    def _time(self, topic: str, recorded: int, message: Any) -> int:
        """The time of a message in ns."""
        if not self._stamped or self._has_stamps.get(topic) is False:
            return recorded
        stamp = _header_stamp(message) or 0  # a stamp of 0 was never set
        if not self._has_stamps.setdefault(topic, stamp > 0):
            self.skip(topic, NO_STAMP)
            return recorded
        return stamp

    def skip(self, name: str, reason: str) -> None:
        """Note that no signal is made of a topic or field."""
        if len(self._skipped) < MAX_SIGNALS:
            self._skipped.setdefault(name, reason)

    def found(self) -> Iterator[Signal | Skipped]:
        """The signals, in the order of their first values, and what was skipped."""
        for name in list(self._times):
            times, values = self._times.pop(name), self._values.pop(name)
            yield Signal(name, np.frombuffer(times, np.int64), np.frombuffer(values, float))
        for name, reason in self._skipped.items():
            yield Skipped(name, reason)

    def _leaves(self, name: str, value: Any, depth: int) -> Iterator[tuple[str, float]]:
        if isinstance(value, bool | int | float | np.number | np.bool_):
            yield name, float(value)
        elif isinstance(value, str) or value is None:
            return
        elif isinstance(value, np.ndarray):
            yield from self._array(name, value.ravel(), None, depth)
        elif isinstance(value, list | tuple):
            yield from self._array(name, value, None, depth)
        elif depth < MAX_DEPTH:
            yield from self._fields(name, value, depth)

    def _fields(self, name: str, message: Any, depth: int) -> Iterator[tuple[str, float]]:
        fields = list(_items(message))
        if {key for key, _ in fields} <= set(STAMP) and len(fields) == 2:
            return
        names = next((value for key, value in fields if _names_elements(key, value)), None)
        for key, value in fields:
            inner = f"{name}.{key}"
            if isinstance(value, list | tuple | np.ndarray):
                flat = value.ravel() if isinstance(value, np.ndarray) else value
                same = names is not None and value is not names and len(flat) == len(names)
                yield from self._array(inner, flat, names if same else None, depth)
            else:
                yield from self._leaves(inner, value, depth + 1)

    def _array(
        self, name: str, values: Sequence[Any] | np.ndarray, names: Sequence[str] | None, depth: int
    ) -> Iterator[tuple[str, float]]:
        # Elements of an array that become signals; images and point clouds have more.
        if len(values) > 64:
            self.skip(name, f"an array of {len(values)} elements")
            return
        for place, value in enumerate(values):
            own = names[place] if names is not None else _own_name(value)
            inner = f"{name}[{place if own is None else own[:MAX_NAME]}]"
            yield from self._leaves(inner, value, depth + 1)


def _names_elements(key: str, value: Any) -> bool:
    """Whether a field names the elements of the arrays beside it."""
    return (
        (key in ("name", "names") or key.endswith("_names"))
        and isinstance(value, list | tuple)
        and len(value) > 0
        and all(isinstance(each, str) and each for each in value)
        and len(set(value)) == len(value)
    )


def _own_name(value: Any) -> str | None:
    """The text by which an element of a list of messages is named."""
    if isinstance(value, bool | int | float | str | np.generic):
        return None
    parts = dict(_items(value))
    found = (parts.get(key) for key in OWN_NAMES)
    return next((each for each in found if isinstance(each, str) and each), None)


def _items(message: Any) -> Iterator[tuple[str, Any]]:
    """The fields of a message: of a dataclass of the library, or of a JSON object."""
    if isinstance(message, Mapping):
        yield from ((str(key)[:MAX_NAME], value) for key, value in message.items())
        return
    for key in getattr(message, "__dataclass_fields__", ()):
        if key != "__msgtype__":
            plain = key[:-1] if key.endswith("_") and keyword.iskeyword(key[:-1]) else key
            yield plain, getattr(message, key)
