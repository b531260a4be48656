"""The log: every edit is found, and what is intact is accepted byte by byte."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retwin.errors import InputError
from retwin.monitor import Entry, export_log, read_log, verify
from retwin.monitor.store.audit import MAX_LINE, START, append, canonical

HOSTILE = "</script>\n\0\ud800 Ω'\"; --"


def chain(count: int, kinds: tuple[str, ...] = ("alarm", "version")) -> list[Entry]:
    """A log of entries of several kinds."""
    made: list[Entry] = []
    for n in range(count):
        data = {"asset": f"{HOSTILE} {n}", "time": 10**18 + n, "evidence": 0.1 * n, "b": [n, None]}
        made.append(append(made[-1] if made else None, kinds[n % len(kinds)], data))
    return made


def exported(entries: list[Entry], folder: Path) -> Path:
    export_log(entries, folder / "log.jsonl")
    return folder / "log.jsonl"


def test_an_intact_log_is_read_as_it_was_written(tmp_path: Path) -> None:
    entries = chain(30)
    file = exported(entries, tmp_path)
    assert list(read_log(file)) == entries
    found = verify(read_log(file), entries[-1].hash)
    assert (found.ok, found.intact, found.head, found.after_head) == (
        True, 30, entries[-1].hash, 0,
    )  # fmt: skip
    assert verify(entries, entries[19].hash).after_head == 10, "the log has grown since"
    assert verify([]).head == START
    again = tmp_path / "again.jsonl"
    assert export_log(read_log(file), again) == entries[-1].hash
    assert again.read_bytes() == file.read_bytes()


@pytest.mark.slow
def test_2000_edits_of_one_byte_are_found(tmp_path: Path) -> None:
    entries = chain(6)
    file = exported(entries, tmp_path)
    text = file.read_bytes()
    ends = np.flatnonzero(np.frombuffer(text, np.uint8) == ord("\n"))
    rng = np.random.default_rng(0)
    edited = tmp_path / "edited.jsonl"
    for place in rng.integers(len(text), size=2000):
        other = (text[place] + int(rng.integers(1, 256))) % 256
        edited.write_bytes(text[:place] + bytes([other]) + text[place + 1 :])
        found = verify(read_log(edited))
        assert not found.ok
        assert found.intact == np.searchsorted(ends, place), "the first broken entry"


def test_entries_that_are_moved_repeated_removed_or_inserted() -> None:
    entries = chain(8)
    forged = append(entries[3], "alarm", {"forged": True})
    for changed, broken in (
        ([*entries[:3], entries[4], entries[3], *entries[5:]], 3),
        ([*entries[:3], entries[2], *entries[3:]], 3),
        ([*entries[:3], *entries[4:]], 3),
        ([*entries[:4], forged, *entries[4:]], 5),
        (entries[1:], 0),
        ([replace(entries[0], sequence=1), *entries[1:]], 0),
    ):
        found = verify(changed)
        assert (found.ok, found.intact) == (False, broken)
        assert f"entry {broken}" in found.reason


def test_a_cut_or_remade_end_is_found_by_the_head_alone() -> None:
    entries = chain(12)
    head = entries[-1].hash
    for kept in range(12):
        assert verify(entries[:kept]).ok
        assert not verify(entries[:kept], head).ok
        remade = entries[:kept]
        for each in entries[kept:]:
            data = each.data | {"evidence": -1.0}
            remade.append(append(remade[-1] if remade else None, each.kind, data))
        assert verify(remade).ok, "every hash is right"
        found = verify(remade, head)
        assert not found.ok
        assert "made anew" in found.reason


def test_alarms_are_a_log_of_their_own(tmp_path: Path) -> None:
    alarms = [{"asset": "b", "time": 2}, {"asset": "a", "time": 2}, {"asset": "a", "time": 1}]
    others = ([], [("started", {"n": 1})])
    files = []
    for between in others:
        log: list[Entry] = []
        for data in alarms[:: 1 if between else -1]:
            for kind, each in [*between, ("alarm", data)]:
                log.append(append(log[-1] if log else None, kind, each))
        files.append(tmp_path / f"{len(files)}.jsonl")
        head = export_log(log, files[-1], kind="alarm", order=("time", "asset"))
        assert verify(read_log(files[-1]), head).ok
    assert files[0].read_bytes() == files[1].read_bytes(), "whatever else was logged"
    data = [entry.data for entry in read_log(files[0])]
    assert data == [alarms[2], alarms[1], alarms[0]]


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inside: st.lists(inside, max_size=3) | st.dictionaries(st.text(), inside, max_size=3),
    max_leaves=8,
)


@settings(max_examples=50, deadline=None)
@given(st.dictionaries(st.text(), VALUES, max_size=4))
def test_data_come_back_as_they_were(data: dict) -> None:
    entry = append(None, "note", data)
    assert canonical(entry.data) == entry.text
    assert repr(entry.data) == repr(json.loads(json.dumps(data, sort_keys=True)))
    assert entry.line.isascii()


@pytest.mark.parametrize(
    "data",
    [
        {"a": float("nan")},
        {"a": [1, {"b": float("-inf")}]},
        {"a": 2**63},
        {"a": 10**5000},
        {1: 2},
        {"a": {None: 1}},
        {"a": np.zeros(2)},
        {"a": b"bytes"},
        {"a": {1, 2}},
        {"a": "x" * MAX_LINE},
        [["a", 1]],
        None,
    ],
    ids=[
        "nan",
        "infinite",
        "65 bits",
        "digits",
        "key",
        "inner key",
        "array",
        "bytes",
        "set",
        "long",
        "list",
        "none",
    ],
)
def test_data_that_are_not_of_json_are_refused(data: object) -> None:
    with pytest.raises(InputError, match="data"):
        append(None, "note", data)


def test_too_many_levels() -> None:
    data: dict = {}
    for _ in range(5_000):
        data = {"a": data}
    with pytest.raises(InputError, match="32 levels"):
        append(None, "note", data)
    while data:  # or its end would be as deep as its levels
        data = data["a"]


@pytest.mark.parametrize("kind", ["", "Alarm", "a b", "a" * 41, "alarm\n", 3])
def test_kinds(kind: object) -> None:
    with pytest.raises(InputError, match="kind"):
        append(None, kind, {})


LINE = chain(1)[0].line
CONTENTS = {
    "text": b"no JSON at all\n",
    "binary": bytes(range(256)) * 10,
    "nested": b"[" * 500_000 + b"\n",
    "long": b'{"data":"' + b"x" * (2 * MAX_LINE) + b'"}\n',
    "no end": LINE[:-1],
    "empty line": b"\n" + LINE,
    "duplicate key": LINE.replace(b'{"data"', b'{"data":{},"data"', 1),
    "added key": LINE.replace(b'{"data"', b'{"a":1,"data"', 1),
    "space": LINE.replace(b":", b": ", 1),
    "large number": LINE.replace(b'"sequence":0', b'"sequence":' + b"9" * 5000),
    "float": LINE.replace(b'"sequence":0', b'"sequence":0.0'),
    "bool": LINE.replace(b'"sequence":0', b'"sequence":false'),
    "no number": LINE.replace(b"1000000000000000000", b"NaN"),
    "escape": LINE.replace(b"alarm", b"\\u0061larm"),
    "list": b"[1,2]\n",
    "data": b'{"data":[["a",1]],"hash":"","kind":"a","previous":"","sequence":0}\n',
    "surrogate": LINE.replace(b'"kind":"alarm"', b'"kind":"\\ud800"'),
}


@pytest.mark.parametrize("name", CONTENTS)
def test_hostile_files(tmp_path: Path, name: str) -> None:
    file = tmp_path / "log.jsonl"
    file.write_bytes(CONTENTS[name])
    found = verify(read_log(file))
    assert (found.ok, found.intact) == (False, 0)
    assert len(found.reason) <= 160
    assert "\n" not in found.reason


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(InputError):
            list(read_log(path))
        assert not verify(read_log(path)).ok
