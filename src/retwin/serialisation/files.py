"""Files as such: written whole or not at all, and known by their SHA-256."""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from retwin.errors import InputError

__all__ = ["sha256", "write_atomically"]


@contextmanager
def write_atomically(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A name in the same folder to write to; moved to `path` on success, removed on failure.

    For a file and for a folder alike: write a file to the name that is given, or make a folder of
    that name and fill it. Folders above `path` are made. Whatever ends the block early, an
    exception or Ctrl-C, leaves what was at `path` before. The name keeps the suffix of `path`,
    because many writers choose their format by it.

    Raises
    ------
    InputError: `path` cannot be written, is of the other kind (file, folder), or is a folder that
        holds anything besides what the new one replaces, which would be lost.
    FileNotFoundError: the block wrote nothing.

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
    """The SHA-256 of a file, or of a folder: over the sorted relative names and the contents.

    Hidden files (names that begin with a dot) do not count: file managers leave them about.
    Raises InputError when there is nothing at `path`.
    """
    path = Path(path)
    if path.is_file():
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    if not path.is_dir():
        raise InputError(
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
    """Make the folder that `target` goes to, or say that it cannot be written."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        writable = os.access(target.parent, os.W_OK | os.X_OK)
        reason = "one without write permission"
    except OSError as error:
        writable, reason = False, error.strerror or type(error).__name__
    if not writable:
        raise InputError(
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
    strangers = {each.name for each in target.iterdir()} - {each.name for each in part.iterdir()}
    if strangers:
        raise InputError(
            "path",
            expected="a name that is free or a folder of the same kind to replace",
            got=f"{target}, which also holds {min(strangers)}",
            remedy="give another name, so that nothing is lost",
        )
    # No call swaps two folders: the old one steps aside and comes back if the new one cannot move.
    aside = target.with_name(f"{part.name}.old")
    os.replace(target, aside)
    try:
        os.replace(part, target)
    except BaseException:
        os.replace(aside, target)
        raise
    shutil.rmtree(aside)


def _remove(part: Path) -> None:
    if part.is_dir():
        shutil.rmtree(part)
    else:
        part.unlink(missing_ok=True)
