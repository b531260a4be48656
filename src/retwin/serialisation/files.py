"""Files and folders: written whole or not at all, and identified by their SHA-256."""

from __future__ import annotations

import ctypes
import hashlib
import itertools
import json
import os
import platform
import re
import secrets
import shutil
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from retwin.checks import existing
from retwin.errors import InputError, brief
from retwin.serialisation.places import (
    OCCUPIED,
    real_path,
    refuse_others,
    refuse_use,
    room_for,
    unwritable,
)
from retwin.serialisation.sizes import Budget

AT_FDCWD, EXCHANGE = -100, 2
"""Arguments of `renameat2` in Linux; `EXCHANGE` also of `renamex_np` in macOS."""
MACHINE = f"{zlib.crc32(platform.node().encode()):08x}"
"""This machine in the names of temporary files, whose process others cannot test for."""
TOKEN = secrets.token_hex(4)
"""This process in the same names, since the system gives its number to later ones."""
TEMPORARY = re.compile(
    rf"\..*-{MACHINE}-(?P<process>\d+)-(?P<token>[0-9a-f]{{8}})-\d+(\..*)?", re.DOTALL
)
"""The name of a temporary file or folder of this machine."""
FORMER = ".former"
"""The end of the name of a folder that is being replaced."""
_count = itertools.count()


@contextmanager
def write_atomically(
    path: str | os.PathLike[str],
    *,
    folder: bool = False,
    replace: bool = True,
    holds: Collection[str] = (),
) -> Iterator[Path]:
    """A name in the same folder to write to; moved to `path` on success, removed on failure.

    For a file and for a folder alike: write a file to that name, or make a folder of that name and
    fill it; with `folder`, the folder is made, and a file at `path` is refused at once. Folders
    above `path` are made. If the block fails, with an exception or Ctrl-C, `path` stays as it was;
    a kill leaves the old contents or the new ones, and hidden files that the next process to write
    there removes. The name keeps the suffix of `path`, since many writers choose their format by
    it. Without `replace`, what another process has made there meanwhile stays. A folder that is
    replaced may hold the names of the new one, and those of `holds`, which the new one may lack.

    Raises
    ------
    InputError
        `path` cannot be written, or not that much; is a file instead of a folder or the reverse; is
        a folder with files that the new one does not replace; or has been made meanwhile.
    FileNotFoundError
        The block wrote nothing.

    """
    # Through a link the file behind it is replaced, not the link.
    target = real_path(path)
    mark = f"{os.getpid()}-{TOKEN}-{next(_count)}"
    part = target.with_name(f"{_beginning(target)}{mark}{target.suffix}")
    _make_parent(target, part)
    recover(target)
    _sweep(target.parent)
    try:
        with room_for(target):
            if folder:
                _check_kind(target, folder=True)
                part.mkdir()
            yield part
            if not part.exists():
                raise FileNotFoundError(f"nothing was written for {target.name}")
            _move(part, target, replace=replace, holds=holds)
    finally:
        _remove(part)


def recover(path: str | os.PathLike[str]) -> Path:
    """`path`; a folder there whose replacement was killed halfway is put back first."""
    target = real_path(path)
    # Not `target.exists()`, which raises for a name that is too long.
    if not os.path.exists(target) and target.parent.is_dir():
        for former in _formers(target):
            with suppress(OSError):  # another process has put it back
                os.rename(former, target)
    return Path(path)


def check_regular(path: str | os.PathLike[str]) -> Path:
    """`path`, if what is there can be read into memory at once.

    Raises
    ------
    ValueError
        It is a pipe or a device, from which reading may never end.
    InputError
        It is larger than the free memory permits, as a file with holes may be.

    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise ValueError(f"{path.name} is no regular file")
    if path.exists():
        Budget(path.name).take(path.stat().st_size)
    return path


def read_json(path: str | os.PathLike[str]) -> Any:
    """The values of a JSON file.

    Raises
    ------
    OSError, ValueError
        It is no regular file, or no JSON, or nested too deeply.
    InputError
        Its values may take more memory than there is.

    """
    path = check_regular(path)
    return parse_json(path.read_bytes(), path.name)


def parse_json(text: bytes, where: str, *, bytes_per_json_byte: int = 16) -> Any:
    """The values of a JSON text; raises as `read_json` does, with `where` in the messages.

    Parameters
    ----------
    bytes_per_json_byte : int, default 16
        Memory that the values of a JSON text may take, in multiples of its size.

    """
    Budget(where).take(bytes_per_json_byte * len(text))
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError(f"{where} is nested too deeply") from None


def write_json(path: str | os.PathLike[str], values: Any) -> None:
    """Write values as a JSON file, whole or not at all."""
    with write_atomically(path) as part:
        part.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


@contextmanager
def refusing(file: str | os.PathLike[str], *, expected: str, remedy: str) -> Iterator[None]:
    """Turn every exception that reading untrusted contents raises into an InputError.

    A sealed folder is untrusted too although its seal is intact, since anyone can seal a folder.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        got = f"what is damaged or of another kind ({type(error).__name__}: {brief(error)})"
        if isinstance(error, MemoryError):
            got, remedy = "too little memory to read it", "end what else takes memory"
        raise InputError(str(file), expected=expected, got=got, remedy=remedy) from None


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
    existing("path", path, path.is_dir())
    files = {file.relative_to(path).as_posix(): file for file in path.rglob("*") if file.is_file()}
    total = hashlib.sha256()
    for name in sorted(files):
        if not any(part.startswith(".") for part in name.split("/")):
            total.update(f"{name}\0{sha256(files[name])}\n".encode())
    return total.hexdigest()


def _make_parent(target: Path, part: Path) -> None:
    """Make the folder of `target`; InputError if it cannot be written, or not under that name."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # By trying: the rights of a file do not show whether its file system takes more.
        part.touch()
        part.unlink()
        target.exists()
    except OSError as error:
        raise unwritable(target, error) from None


def _check_kind(target: Path, *, folder: bool) -> None:
    """Raise InputError unless `target` is free, or is a folder where a folder is to be."""
    if target.exists() and target.is_dir() != folder:
        kinds = ("file", "folder") if folder else ("folder", "file")
        raise InputError(
            "path",
            expected=f"a name that is free or a {kinds[1]} to replace",
            got=f"{target}, a {kinds[0]}",
            remedy="give another name",
        )


def _move(part: Path, target: Path, *, replace: bool, holds: Collection[str]) -> None:
    _check_kind(target, folder=part.is_dir())
    if not replace:
        try:
            os.rename(part, target)
        except OSError as error:
            if error.errno not in OCCUPIED:
                raise
            raise refuse_use(target) from None
        return
    if not (target.is_dir() and part.is_dir()):
        os.replace(part, target)
        return
    for former in _formers(target):
        shutil.rmtree(former, ignore_errors=True)
    names = {each.name for each in part.iterdir()} | set(holds)
    refuse_others(target, {each.name for each in target.iterdir()} - names)
    if _exchange(part, target):
        return
    # A kill between the two steps leaves no folder of that name: `recover` puts the former back.
    former = part.with_name(f"{part.name}{FORMER}")
    os.replace(target, former)
    try:
        os.replace(part, target)
    except BaseException:
        os.replace(former, target)
        raise
    shutil.rmtree(former)


def _exchange(part: Path, target: Path) -> bool:
    """Exchange the names of two folders in one step; False where the file system cannot."""
    if os.name != "posix":
        return False
    system = ctypes.CDLL(None)
    names = os.fsencode(part), os.fsencode(target)
    if hasattr(system, "renameat2"):
        failed = system.renameat2(AT_FDCWD, names[0], AT_FDCWD, names[1], EXCHANGE)
    else:
        failed = system.renamex_np(*names, EXCHANGE) if hasattr(system, "renamex_np") else True
    return not failed


def _remove(part: Path) -> None:
    if part.is_dir():
        shutil.rmtree(part)
    else:
        part.unlink(missing_ok=True)


def _beginning(target: Path, *, max_stem: int = 128) -> str:
    """How the names of all temporary files for `target` on this machine begin.

    Parameters
    ----------
    max_stem : int, default 128
        Bytes of a file's name that its temporary name holds; systems allow 255 in all.

    """
    stem = os.fsencode(target.stem)
    short = target.stem if len(stem) <= max_stem else hashlib.sha256(stem).hexdigest()
    return f".{short}-{MACHINE}-"


@cache
def _sweep(folder: Path) -> None:
    """Remove what killed processes were writing there; once per process, for it takes time."""
    for file in _left_in(folder):
        if not file.name.endswith(FORMER):
            with suppress(OSError):  # another process removes it too, or it cannot be removed
                _remove(file)


def _formers(target: Path) -> list[Path]:
    """Folders of that name whose replacement was killed halfway."""
    begin = _beginning(target)
    left = [file for file in _left_in(target.parent) if file.name.startswith(begin)]
    return [file for file in left if file.name.endswith(FORMER)]


def _left_in(folder: Path) -> Iterator[Path]:
    """The temporary files and folders in `folder` whose process has ended."""
    for file in list(folder.iterdir()):
        found = TEMPORARY.fullmatch(file.name)
        if found and _has_ended(int(found["process"]), found["token"]):
            yield file


def _has_ended(process: int, token: str) -> bool:
    """Whether this machine has no such process; False where that cannot be tested."""
    if os.name != "posix":  # elsewhere signal 0 does not test whether a process exists
        return False
    if process == os.getpid():  # or one of a container that began anew
        return token != TOKEN
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):
        return False
    return False
