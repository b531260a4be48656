"""MCAP: ROS 2, ROS 1 and JSON messages, by mcap and rosbags."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from retwin.checks import needs_extra
from retwin.data.logs.messages import Series, Types, Undecoded
from retwin.data.logs.signals import Clock, Signal, Skipped
from retwin.errors import InputError

DEFINED = {"ros2msg": False, "ros2idl": True, "ros1msg": False}
"""Encodings of definitions, and whether they are IDL."""


def read(path: Path, wanted: frozenset[str] | None, clock: Clock) -> Iterator[Signal | Skipped]:
    """The fields of all messages; see `data.logs.signals.Reader` and `messages`.

    Types come from the definitions in the file. Checksums are verified.

    Raises
    ------
    InputError
        The file is cut off: its end is missing.

    """
    mcap = needs_extra("mcap.reader", "logs", "reads MCAP")
    exceptions = needs_extra("mcap.exceptions", "logs", "reads MCAP")
    needs_extra("rosbags", "logs", "decodes ROS messages")
    types, series = Types(), Series(wanted, clock)
    with path.open("rb") as stream:
        reader = mcap.NonSeekingReader(stream, validate_crcs=True)
        try:
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                if series.wants(channel.topic):
                    decode = partial(_decode, types, schema, channel, message.data)
                    series.add(channel.topic, str(channel.id), message.log_time, decode)
        except (exceptions.EndOfFile, struct.error):
            expected = "an MCAP file that is whole"
            got = "one that is cut off"
            remedy = f"recover it: mcap recover {path.name} -o recovered.mcap"
            raise InputError(path.name, expected=expected, got=got, remedy=remedy) from None
    yield from series.found()


def _decode(types: Types, schema: Any, channel: Any, data: bytes) -> Any:
    """A message; `Undecoded` if it is in another encoding or of an unknown type."""
    encoding = channel.message_encoding
    if encoding == "json":
        found = json.loads(data)
        if not isinstance(found, dict | list | int | float):
            raise Undecoded("text")
        return found
    if encoding not in ("cdr", "ros1") or schema is None:
        raise Undecoded(f"messages in the encoding {encoding[:40]!r}, which is not read")
    name = schema.name
    if schema.encoding in DEFINED and schema.data.strip():
        text = schema.data.decode("utf-8", "replace")
        name = types.define(name, text, idl=DEFINED[schema.encoding])
    return types.decode(data, name, ros1=encoding == "ros1")
