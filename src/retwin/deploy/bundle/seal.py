"""Sealed folders: `SHA256SUMS` lists every file of the folder, and one changed byte is refused.

`sha256sum --check SHA256SUMS` verifies the same file. The seal detects damage; it does not
authenticate, since whoever can change a file can seal the folder again. A forged folder can do no
harm because reading it runs no code that it names.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from retwin.checks import require
from retwin.errors import InputError, brief
from retwin.serialisation.files import check_regular, read_json, recover, refusing, sha256
from retwin.serialisation.sizes import Budget

SUMS = "SHA256SUMS"
"""Name of the file with the checksums, in the format of `sha256sum`."""
SCHEMAS = {"bundle": 1, "portable": 2}
"""Schema that is written and read, for each kind of sealed folder: a bundle, or its ONNX export.

Exports of schema 1 named inputs of their graphs otherwise, so they are refused.
"""
REMEDIES = {
    "bundle": "make it anew with Bundle.save",
    "portable": "make it anew with retwin export onnx",
}
EXPECTED = {"bundle": "a bundle", "portable": "the ONNX export of a bundle"}


@contextmanager
def open_sealed(folder: str | Path, kind: str) -> Iterator[dict[str, Any]]:
    """Verify a sealed folder and yield its description, for whatever loads it.

    Parameters
    ----------
    folder : path
        The sealed folder.
    kind : {"bundle", "portable"}
        Kind that the folder must be of.

    Raises
    ------
    InputError
        If `read_sealed` raises it, or if the block inside `with` raises anything.

    """
    about = read_sealed(folder, kind)
    with refusing(folder, expected=EXPECTED[kind], remedy=REMEDIES[kind]):
        yield about


def seal(folder: Path) -> None:
    """Write the checksums of all files that are in `folder` now."""
    (folder / SUMS).write_bytes(_sums(folder))


def verify_seal(folder: str | Path) -> None:
    """Compare every file of a sealed folder with its checksum.

    Hidden files (names that begin with a dot) are ignored, since file managers create them.

    Raises
    ------
    InputError
        If the folder is not sealed, if a file was changed, removed or added, or if one is a link.

    """
    folder = recover(folder)
    try:
        written = check_regular(folder / SUMS).read_bytes()
        found = _sums(folder)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise _damaged(folder, f"{type(error).__name__}: {brief(error)}") from None
    if written != found:
        raise _damaged(folder, _difference(written, found))


def read_sealed(folder: str | Path, *kinds: str) -> dict[str, Any]:
    """The description in a sealed folder of one of these kinds, after the seal was verified.

    Raises
    ------
    InputError
        If `verify_seal` raises it, or if the folder is of another kind or schema.

    """
    verify_seal(folder)
    try:
        about = read_json(Path(folder) / "model.json")
        kind, schema = about["kind"], about["schema"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _damaged(Path(folder), f"model.json with {type(error).__name__}") from None
    require(
        kind in kinds and schema == SCHEMAS[kind],
        str(folder),
        expected=" or ".join(f"a {each} of schema {SCHEMAS[each]}" for each in kinds),
        got=f"{str(kind)[:40]!r} of schema {str(schema)[:40]}",
        remedy=REMEDIES[kind if kind in kinds else kinds[0]]
        + ", or read it with the version of retwin that made it",
    )
    return dict(about)


def _sums(folder: Path) -> bytes:
    """One line per file, sorted by name: its SHA-256 and its name."""
    lines, budget = [], Budget(str(folder))
    for file in sorted(folder.rglob("*")):
        name = file.relative_to(folder).as_posix()
        if any(part.startswith(".") for part in name.split("/")) or name == SUMS:
            continue
        if file.is_symlink():
            raise _damaged(folder, f"a link, {name}")
        if file.is_file():
            budget.take(file.stat().st_size)
            lines.append(f"{sha256(file)}  {name}\n")
    return "".join(lines).encode("utf-8", "surrogateescape")


def _difference(written: bytes, found: bytes) -> str:
    """The first difference between the checksums as written and as found, in a few words."""
    sealed, present = (
        dict(line.rpartition(b"  ")[::-2] for line in text.splitlines())
        for text in (written, found)
    )
    for state, names in (
        ("changed", [name for name in present if sealed.get(name, present[name]) != present[name]]),
        ("missing", sorted(sealed.keys() - present.keys())),
        ("not of the bundle", sorted(present.keys() - sealed.keys())),
    ):
        if names:
            return f"{names[0].decode('utf-8', 'replace')[:80]!r}, which is {state}"
    return f"{SUMS}, which is changed"


def _damaged(folder: Path, got: str) -> InputError:
    return InputError(
        str(folder),
        expected=f"a bundle whose files are those of its {SUMS}",
        got=got,
        remedy="copy the whole folder again, or make it anew",
    )
