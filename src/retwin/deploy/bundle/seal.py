"""A sealed folder: SHA256SUMS names every file in it, and one changed byte is refused.

The seal is what `sha256sum` writes and `sha256sum --check SHA256SUMS` reads. It tells damage, not
who wrote the folder: whoever can change a file can seal it again. What keeps a forged folder from
doing harm is that reading it runs no code that it names.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from retwin.errors import InputError
from retwin.serialisation.files import sha256

__all__ = ["SCHEMA", "SUMS", "distrusting", "read_sealed", "seal", "verify_seal"]

SUMS = "SHA256SUMS"
SCHEMA = 1
"""Of bundles and of their exports; older ones would be migrated in `read_sealed`."""
LARGEST = 2**20
"""Bytes of a description at most; no bundle's is near it."""


@contextmanager
def distrusting(folder: str | Path, *, expected: str, remedy: str) -> Iterator[None]:
    """InputError for whatever goes wrong when the contents of a sealed folder are read.

    Its seal is whole, so nothing was damaged: whoever made it put anything at all in there.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        got = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:100]}"
        raise InputError(str(folder), expected=expected, got=got, remedy=remedy) from None


def seal(folder: Path) -> None:
    """Write the sums of all files that are in `folder` now."""
    (folder / SUMS).write_bytes(_sums(folder))


def verify_seal(folder: str | Path) -> None:
    """Hold every file of a sealed folder against its sum.

    Hidden files (names that begin with a dot) do not count: file managers leave them about.

    Raises
    ------
    InputError: no sealed folder, a file that was changed, is missing or was added, or a link.

    """
    folder = Path(folder)
    try:
        written = (folder / SUMS).read_bytes()
        found = _sums(folder)
    except OSError as error:
        raise _refused(folder, f"{type(error).__name__}: {error.strerror}") from None
    if written != found:
        raise _refused(folder, _difference(written, found))


def read_sealed(folder: str | Path, *kinds: str) -> dict[str, Any]:
    """The description of a sealed folder of one of these kinds, after its seal was verified.

    Raises InputError as `verify_seal` does, and for another kind or schema.
    """
    verify_seal(folder)
    file = Path(folder) / "model.json"
    try:
        if file.stat().st_size > LARGEST:
            raise ValueError("too long")
        about = json.loads(file.read_text(encoding="utf-8"))
        found = about["kind"], about["schema"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise _refused(Path(folder), f"model.json with {type(error).__name__}") from None
    if found[0] not in kinds or found[1] != SCHEMA:
        raise InputError(
            str(folder),
            expected=f"a {' or '.join(kinds)} of schema {SCHEMA}",
            got=f"{str(found[0])[:40]!r} of schema {str(found[1])[:40]}",
            remedy="make it anew with this version of retwin, or read it with the one that made it",
        )
    return dict(about)


def _sums(folder: Path) -> bytes:
    """One line per file, sorted by name: its SHA-256 and its name."""
    lines = []
    for file in sorted(folder.rglob("*")):
        name = file.relative_to(folder).as_posix()
        if any(part.startswith(".") for part in name.split("/")) or name == SUMS:
            continue
        if file.is_symlink():
            raise _refused(folder, f"a link, {name}")
        if file.is_file():
            lines.append(f"{sha256(file)}  {name}\n")
    return "".join(lines).encode("utf-8", "surrogateescape")


def _difference(written: bytes, found: bytes) -> str:
    """What of a folder differs from its seal, in a few words."""
    told, there = (
        dict(line.rpartition(b"  ")[::-2] for line in text.splitlines())
        for text in (written, found)
    )
    for words, names in (
        ("changed", [name for name in there if name in told and told[name] != there[name]]),
        ("missing", sorted(told.keys() - there.keys())),
        ("not of the bundle", sorted(there.keys() - told.keys())),
    ):
        if names:
            return f"{names[0].decode('utf-8', 'replace')[:80]!r}, which is {words}"
    return f"{SUMS}, which is changed"


def _refused(folder: Path, got: str) -> InputError:
    return InputError(
        str(folder),
        expected=f"a bundle whose files are those of its {SUMS}",
        got=got,
        remedy="copy the whole folder again, or make it anew",
    )
