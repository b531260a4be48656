"""Files and folders: written whole or not at all, and identified by their SHA-256."""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from retwin.checks import require
from retwin.errors import InputError

__all__ = ["sha256", "write_atomically"]


@contextmanager
def write_atomically(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A name in the same folder to write to; moved to `path` on success, removed on failure.

    For a file and for a folder alike: write a file to that name, or make a folder of that name and
    fill it. Folders above `path` are made. If the block fails, with an exception or Ctrl-C, `path`
    stays as it was. The name keeps the suffix of `path`, since many writers choose their format by
    it.

    Raises
    ------
    InputError
        `path` cannot be written, is a file instead of a folder or the reverse, or is a folder with
        files that the new one does not replace.
    FileNotFoundError
        The block wrote nothing.

    """
    # Through a link the file behind it is replaced, not the link.
    target = Path(os.path.realpath(path))
    _make_parent(target)
    part = target.with_name(f".{target.stem}-{secrets.token_hex(4)}{target.suffix}")
    try:
        yield part
        if not part.exists():
            raise FileNotFoundError(f"nothing was written for {target.name}")
        _move(part, target)
    finally:
        _remove(part)


def sha256(path: str | os.PathLike[str]) -> str:
    """The SHA-256 of a file, or of the sorted relative names and the contents in a folder.

    Hidden files (names that begin with a dot) do not count, since file managers write them.

    Raises
    ------
    InputError
        There is nothing at `path`.

    """
    path = Path(path)
    if path.is_file():
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    require(
        path.is_dir(),
        "path",
        expected="an existing file or folder",
        got=f"{path}, where there is none",
        remedy="check the name",
    )
    files = {file.relative_to(path).as_posix(): file for file in path.rglob("*") if file.is_file()}
    total = hashlib.sha256()
    for name in sorted(files):
        if not any(part.startswith(".") for part in name.split("/")):
            total.update(f"{name}\0{sha256(files[name])}\n".encode())
    return total.hexdigest()


def _make_parent(target: Path) -> None:
    """Make the folder of `target`; InputError if it cannot be written."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        writable = os.access(target.parent, os.W_OK | os.X_OK)
        reason = "one without write permission"
    except OSError as error:
        writable, reason = False, error.strerror or type(error).__name__
    require(
        writable,
        "path",
        expected="a place that can be written",
        got=f"{target} ({reason})",
        remedy="give another folder",
    )


def _move(part: Path, target: Path) -> None:
    if target.exists() and target.is_dir() != part.is_dir():
        kinds = ("folder", "file") if target.is_dir() else ("file", "folder")
        raise InputError(
            "path",
            expected=f"a name that is free or a {kinds[1]} to replace",
            got=f"{target}, a {kinds[0]}",
            remedy="give another name",
        )
    if not (target.is_dir() and part.is_dir()):
        os.replace(part, target)
        return
    others = {each.name for each in target.iterdir()} - {each.name for each in part.iterdir()}
    require(
        not others,
        "path",
        expected="a name that is free or a folder of the same kind to replace",
        got=f"{target}, which also holds {min(others, default='')}",
        remedy="give another name, so that nothing is lost",
    )
    # No call swaps two folders: the old one is renamed, and back again if the new one cannot move.
    former = target.with_name(f"{part.name}.old")
    os.replace(target, former)
    try:
        os.replace(part, target)
    except BaseException:
        os.replace(former, target)
        raise
    shutil.rmtree(former)


def _remove(part: Path) -> None:
    if part.is_dir():
        shutil.rmtree(part)
    else:
        part.unlink(missing_ok=True)
