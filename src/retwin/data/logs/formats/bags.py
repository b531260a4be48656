"""ROS bags: folders and files of ROS 2, and files of ROS 1, by rosbags."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path

from retwin.checks import needs_extra
from retwin.data.logs.messages import Series, Types
from retwin.data.logs.signals import Clock, Signal, Skipped
from retwin.errors import InputError


def read(path: Path, wanted: frozenset[str] | None, clock: Clock) -> Iterator[Signal | Skipped]:
    """The fields of all messages; see `data.logs.signals.Reader` and `messages`.

    Types come from the definitions in the bag, else from those of ROS itself.

    Raises
    ------
    InputError
        A database holds more than tables, or has a name that SQLite reads as an address.

    """
    rosbags = needs_extra("rosbags.interfaces", "logs", "reads ROS bags")
    ros1 = path.suffix.lower() == ".bag"
    for each in path.glob("*.db3") if path.is_dir() else [path]:
        if each.suffix.lower() == ".db3":
            _check_database(each)
    version = f"rosbags.rosbag{1 if ros1 else 2}"
    reader = needs_extra(version, "logs", "reads ROS bags").Reader(path)
    types, series = Types(), Series(wanted, clock)
    formats = rosbags.MessageDefinitionFormat
    with reader:
        connections = []
        for each in reader.connections:
            if not series.wants(each.topic):
                continue
            if each.msgdef.format != formats.NONE and each.msgdef.data.strip():
                idl = each.msgdef.format == formats.IDL
                types.define(each.msgtype, each.msgdef.data, idl=idl)
            connections.append(each)
        for each, time, data in reader.messages(connections) if connections else ():
            decode = partial(types.decode, data, each.msgtype, ros1=ros1)
            series.add(each.topic, each.msgtype, time, decode)
    yield from series.found()


def _check_database(path: Path) -> None:
    """Refuse a database with views, triggers or virtual tables, which are programs."""
    import sqlite3

    if re.search(r"[?#%]", str(path)):
        expected = "a path without ?, # and %"
        remedy = "rename the file or its folder"
        raise InputError(str(path), expected=expected, got="one of them", remedy=remedy)
    connection = sqlite3.connect(f"file:{path}?immutable=1", uri=True)
    with closing(connection):
        connection.execute("PRAGMA trusted_schema = OFF")
        found = connection.execute("SELECT type, coalesce(sql, '') FROM sqlite_master").fetchall()
    bad = [
        kind
        for kind, sql in found
        if kind not in ("table", "index") or re.search(r"\b(virtual|generated)\b|\bas\b", sql, re.I)
    ]
    if bad:
        got = f"a {bad[0]} that computes what it holds"
        remedy = "the file is damaged, or was made to do harm"
        raise InputError(path.name, expected="tables of a ROS 2 bag", got=got, remedy=remedy)
