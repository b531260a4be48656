"""Places to write to: checked before long work, and used by one process at a time."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from retwin.checks import require
from retwin.errors import InputError

TOKEN = "-" * 16
"""As many characters as a name gets in addition while it is written, and one or two more."""

NO_SPACE = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
"""Errors of a disk, a file or a quota that is full."""
OCCUPIED = {errno.ENOTEMPTY, errno.EEXIST}
"""Errors of a name to which a folder cannot be moved, since another one is there."""


def real_path(path: str | os.PathLike[str]) -> Path:
    """The path without links; InputError for a name with a zero character, which no system has."""
    require(
        "\0" not in os.fspath(path),
        "path",
        expected="a name without a zero character",
        got=repr(os.fspath(path)),
        remedy="give another name",
    )
    return Path(os.path.realpath(path))


def check_place(
    path: str | os.PathLike[str], *, folder: bool = False, holds: Collection[str] | None = None
) -> None:
    """Require that `write_atomically` will be able to write a file or folder; nothing is made.

    Parameters
    ----------
    path : path
        The file or folder to be made or replaced.
    folder : bool
        Whether it is to be a folder.
    holds : collection of str, optional
        The names that the folder will hold. A folder that is there may hold no other, since it is
        replaced; by default its contents are not checked.

    Raises
    ------
    InputError
        It is of the other kind, holds something else, or cannot be written.

    """
    kind = "folder" if folder else "file"
    target = real_path(path)
    try:
        present = {each.name for each in target.iterdir()} if target.is_dir() else set()
        right = target.is_dir() if folder else target.is_file()
        require(
            target.name and (right or not target.exists()),
            "path",
            expected=f"a name that is free or a {kind} to replace",
            got=f"{target}, which is none",
            remedy="give another name",
        )
        _try_to_write(target)
    except OSError as error:
        raise unwritable(target, error) from None
    refuse_others(target, present - set(present if holds is None else holds))


def unwritable(target: Path, error: OSError) -> InputError:
    """The error about a place where the system does not let anything be written."""
    return InputError(
        "path",
        expected="a place that can be written",
        got=f"{_shorten(target)} ({error.strerror or type(error).__name__})",
        remedy="give another folder or name",
    )


@contextmanager
def room_for(target: Path) -> Iterator[None]:
    """Name the place where an error in the block is that of a full disk, file or quota."""
    try:
        yield
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise
        raise unwritable(target, error) from None


def refuse_others(target: Path, others: Collection[str]) -> None:
    """Refuse to replace a folder that holds something else, which would be lost."""
    require(
        not others,
        "path",
        expected="a name that is free or a folder of the same kind to replace",
        got=f"{target}, which also holds {min(others, default='')}",
        remedy="give another name, so that nothing is lost",
    )


@contextmanager
def in_use(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Let no other process that calls this use `folder` inside the block.

    The folder is made, and removed if it is empty at the end. The system ends the use when the
    process ends, however that happens, and no file is left. Where there are no locks, in a file
    system or on Windows, none is used.

    Raises
    ------
    InputError
        Another process uses it, or it cannot be made.

    """
    check_place(folder, folder=True)
    if os.name != "posix":
        yield
        return
    opened = _open(Path(folder))
    try:
        _lock(opened, folder)
        try:
            yield
        finally:
            with suppress(OSError):  # it is not empty
                os.rmdir(folder)
    finally:
        os.close(opened)


def refuse_use(folder: str | os.PathLike[str]) -> InputError:
    """The error about a folder that another process uses."""
    return InputError(
        "path",
        expected="a folder that no other process writes to",
        got=f"{folder}, which one writes to now",
        remedy="wait until it has ended, or give another folder",
    )


def _lock(opened: int, folder: str | os.PathLike[str]) -> None:
    """Lock the folder until its descriptor is closed."""
    import fcntl

    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise refuse_use(folder) from None
    except OSError:
        return  # the file system has no locks


def _open(folder: Path) -> int:
    """A descriptor of the folder, which is made if it is not there."""
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # another process removed it when it was empty
            return os.open(folder, os.O_RDONLY | os.O_DIRECTORY)


def _try_to_write(target: Path) -> None:
    """Raise OSError unless the names of `target` are possible and its folder can be written."""
    above = next(each for each in target.parents if each.exists())
    for name in target.relative_to(above).parts:
        with suppress(FileNotFoundError):
            os.lstat(above / f"{name}{TOKEN}")
    # Permissions alone do not decide: the file system may be read-only or full.
    with tempfile.TemporaryFile(dir=above):
        pass


def _shorten(path: Path) -> str:
    text = str(path)
    return text if len(text) <= 160 else f"{text[:159]}…"
