"""A log to which entries are only appended, each with the hash of the one before.

Whoever changes an entry must change the hashes of all that follow, and so the last one, the head.
An intact chain therefore proves that nothing was changed before a head that was kept elsewhere;
without such a head, it detects damage and careless edits, but not a log that was made anew.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from retwin.checks import require
from retwin.errors import InputError, brief
from retwin.serialisation.files import check_regular, refusing, write_atomically

START = "0" * 64
"""The previous hash of the first entry."""
MAX_LINE = 2**20
"""Bytes of an entry at most, so that a file is read in bounded memory."""
KIND = re.compile(r"[a-z][a-z_]{0,39}")
"""What the kind of an entry may be."""
KEYS = {"data", "hash", "kind", "previous", "sequence"}


@dataclass(frozen=True)
class Entry:
    """One entry of the log.

    Attributes
    ----------
    sequence : int
        Its place, from 0.
    kind : str
        What it is: lower-case letters and underscores, such as "alarm".
    text : str
        Its data as canonical JSON, see `canonical`.
    previous, hash : str
        The hash of the entry before it and its own, as 64 hexadecimal digits.

    """

    sequence: int
    kind: str
    text: str
    previous: str
    hash: str

    @property
    def data(self) -> dict[str, Any]:
        """The values of `text`; InputError where it is no JSON object."""
        with refusing(f"entry {self.sequence}", expected="JSON", remedy="verify the log"):
            return dict(json.loads(self.text))

    @property
    def line(self) -> bytes:
        """The entry as canonical JSON, with its hash and the end of the line."""
        return self._object(hash=json.dumps(self.hash)) + b"\n"

    def digest(self) -> str:
        """The hash that the entry must have: SHA-256 of its canonical JSON without the hash."""
        return hashlib.sha256(self._object()).hexdigest()

    def _object(self, **more: str) -> bytes:
        """The entry as canonical JSON; its parts are JSON already."""
        parts = {
            "data": self.text,
            **more,
            "kind": json.dumps(self.kind),
            "previous": json.dumps(self.previous),
            "sequence": str(self.sequence),
        }
        inside = ",".join(f'"{key}":{text}' for key, text in parts.items())
        return f"{{{inside}}}".encode("utf-8", "surrogatepass")


@dataclass(frozen=True)
class Audit:
    """What `verify` found.

    Attributes
    ----------
    intact : int
        Entries from the first one on that are intact; this is also the sequence of the first
        broken one, if one is.
    head : str
        The hash of the last intact entry.
    after_head : int
        Entries after the head that was kept elsewhere, which it does not cover.
    reason : str
        What is wrong with the first broken entry, or with the log; "" if nothing is.

    """

    intact: int
    head: str
    after_head: int
    reason: str

    @property
    def ok(self) -> bool:
        """Whether the log is intact, and contains the head that was kept elsewhere."""
        return not self.reason


def canonical(data: Mapping[str, Any]) -> str:
    """The one JSON text of an object: sorted keys, no spaces, ASCII with escapes.

    Floats are written with the fewest digits that give the same float again.

    Raises
    ------
    InputError
        A value is none of JSON's (NaN and infinity are none), a whole number needs more than 64
        bits, a key is no text, or there are too many levels or bytes.

    """
    plain = {**data} if isinstance(data, Mapping) else data
    expected, remedy = "an object with texts as keys", "log named values"
    got = type(data).__name__
    require(isinstance(plain, dict), "data", expected=expected, got=got, remedy=remedy)
    _check(plain, 0)
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"), allow_nan=False)
    limit, remedy = MAX_LINE - 512, "log a summary of the data"
    got = f"{len(text)} bytes"
    require(len(text) <= limit, "data", expected=f"at most {limit} bytes", got=got, remedy=remedy)
    return text


def append(last: Entry | None, kind: str, data: Mapping[str, Any]) -> Entry:
    """The entry that follows `last`, the newest entry; None where there is none.

    Raises
    ------
    InputError
        The kind is not in lower-case letters and underscores, or `canonical` raises it.

    """
    fits = isinstance(kind, str) and KIND.fullmatch(kind)
    expected = "at most 40 lower-case letters and underscores"
    got = repr(kind)[:80]
    require(fits, "kind", expected=expected, got=got, remedy="name the kind of entry by a word")
    sequence, previous = (0, START) if last is None else (last.sequence + 1, last.hash)
    entry = Entry(sequence, kind, canonical(data), previous, "")
    return Entry(sequence, kind, entry.text, previous, entry.digest())


def verify(entries: Iterable[Entry], head: str | None = None) -> Audit:
    """Find the first broken entry of a log.

    Parameters
    ----------
    entries : iterable of Entry
        The whole log from its first entry on; an InputError that the iterable raises, as
        `read_log` does, counts as a broken entry.
    head : str, optional
        The hash of a former last entry, kept where nobody who can change the log can change it.
        The log may have grown since; it must still contain that entry.

    Returns
    -------
    Audit
        What was found. Edits, entries that were inserted, removed, repeated or moved are always
        found; a log that was cut off, or whose last entries were made anew with valid hashes, is
        found by the head alone.

    """
    count, last, covered = 0, START, 0 if head == START else None
    try:
        for entry in entries:
            reason = _reason(entry, count, last)
            if reason:
                return Audit(count, last, 0, reason)
            count, last = count + 1, entry.hash
            covered = count if last == head else covered
    except InputError as error:
        return Audit(count, last, 0, brief(error))
    if head is not None and covered is None:
        lost = "no entry has the head as its hash: the end was cut off, or made anew"
        return Audit(count, last, 0, lost)
    return Audit(count, last, 0 if covered is None else count - covered, "")


def export_log(
    entries: Iterable[Entry],
    path: str | os.PathLike[str],
    *,
    kind: str | None = None,
    order: Sequence[str] = (),
) -> str:
    """Write entries to a file of JSON lines, whole or not at all.

    Parameters
    ----------
    entries : iterable of Entry
        The log.
    path : path
        The file to make or replace.
    kind : str, optional
        Only entries of this kind. They are numbered and chained anew, so that the file can be
        verified by itself, and its bytes depend on these entries alone.
    order : sequence of str
        Keys of the data by which entries of a kind are sorted first, such as ("time", "asset").
        The entries are then held in memory.

    Returns
    -------
    str
        The head of what was written.

    """
    if kind is not None:
        entries = _chained_anew(entries, kind, order)
    head = START
    with write_atomically(path) as part, part.open("wb") as file:
        for entry in entries:
            file.write(entry.line)
            head = entry.hash
        file.flush()
        os.fsync(file.fileno())
    return head


def read_log(path: str | os.PathLike[str]) -> Iterator[Entry]:
    """The entries of a file of `export_log`, read line by line; hashes are left to `verify`.

    Raises
    ------
    InputError
        A line is not, byte by byte, what `export_log` writes, or there is no such file. Entries
        before that line are still given.

    """
    with refusing(path, expected="a log as JSON lines", remedy="check the name"):
        file = check_regular(path).open("rb")
    with file:
        number = 0
        while line := file.readline(MAX_LINE + 1):
            number += 1
            yield _parsed(line, f"{Path(path).name}, line {number}")


def _parsed(line: bytes, where: str) -> Entry:
    expected = "an entry of the log, in canonical JSON"
    remedy = "restore the file from a copy: it was damaged or edited"
    with refusing(where, expected=expected, remedy=remedy):
        if not line.endswith(b"\n"):
            raise ValueError("the line is too long, or its end is missing")
        found = json.loads(line)
        if not isinstance(found, dict) or found.keys() != KEYS:
            raise ValueError("it has other keys")
        entry = Entry(text=canonical(found.pop("data")), **found)
        if [*map(type, vars(entry).values())] != [int, str, str, str, str]:
            raise ValueError("a value is of another type")
        if entry.line != line:
            raise ValueError("it is written in another way")
    return entry


def _reason(entry: Entry, count: int, last: str) -> str:
    """What is wrong with the entry at a place, after the hash `last`; "" for nothing."""
    if entry.hash != entry.digest():
        return f"entry {count}: its contents do not give its hash"
    if entry.sequence != count:
        return f"entry {count}: its sequence is {entry.sequence}"
    if entry.previous != last:
        return f"entry {count}: it does not follow the entry before it"
    return ""


def _chained_anew(entries: Iterable[Entry], kind: str, order: Sequence[str]) -> Iterator[Entry]:
    chosen: Iterable[Entry] = (entry for entry in entries if entry.kind == kind)
    if order:
        chosen = sorted(chosen, key=lambda entry: [entry.data[key] for key in order])
    last = None
    for entry in chosen:
        last = append(last, kind, entry.data)
        yield last


def _check(value: Any, depth: int, *, max_depth: int = 32) -> None:
    """Raise InputError unless JSON represents the value exactly.

    Parameters
    ----------
    max_depth : int, default 32
        Levels of nested values at most.

    """
    remedy = "log finite numbers, texts, true, false, null, lists, and objects with texts as keys"
    named = repr(value) if isinstance(value, float) else type(value).__name__
    expected = f"values of JSON, at most {max_depth} levels of them"
    fits = value is None or isinstance(value, str | bool | list | tuple | dict)
    if isinstance(value, float):
        fits = abs(value) < float("inf")
    elif isinstance(value, int):
        named, fits = "a whole number of more than 64 bits", -(2**63) <= value < 2**63
    inside: Iterable[Any] = ()
    if isinstance(value, dict):
        inside, fits = value.values(), all(isinstance(key, str) for key in value)
        named = "an object with a key that is no text"
    elif isinstance(value, list | tuple):
        inside = value
    fits = fits and depth <= max_depth
    require(fits, "data", expected=expected, got=named, remedy=remedy)
    for each in inside:
        _check(each, depth + 1)
