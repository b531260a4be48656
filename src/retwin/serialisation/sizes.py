"""How many bytes may be taken for what a file or a plan declares, before anything is allocated."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

from retwin.checks import require, whole

CGROUP = Path("/sys/fs/cgroup")
"""The folder with the limits of the container, where there are some."""
MEMORY_SHARE = 0.5
"""The share of the free memory that one file or plan may take: the work on it needs memory too."""
DISK_SHARE = 0.9
"""The same of the free disk."""


class Budget:
    """Bytes that the contents of one file, or the results of one plan, may take in all.

    Parameters
    ----------
    where : str
        The file or the argument, for messages.
    limit : int, optional
        The largest number of bytes, at least 1; by default a share of the free memory, or of
        the free disk.
    disk : path, optional
        A folder on the disk that is written to; memory is limited without one.

    Raises
    ------
    InputError
        `limit` is no whole number above 0.

    """

    def __init__(
        self, where: str, limit: int | None = None, *, disk: str | os.PathLike[str] | None = None
    ) -> None:
        self._where = where
        self._given = limit is not None
        self._kind = "memory" if disk is None else "disk"
        if limit is not None:
            self._limit = whole("max_bytes", limit, at_least=1)
        elif disk is None:
            self._limit = int(MEMORY_SHARE * (memory()[1] or sys.maxsize))
        else:
            existing = next(each for each in (Path(disk), *Path(disk).parents) if each.exists())
            self._limit = int(DISK_SHARE * shutil.disk_usage(existing).free)
        self._taken = 0

    @property
    def left(self) -> int:
        """Bytes that can still be taken."""
        return self._limit - self._taken

    def take(self, size: int) -> None:
        """Count `size` bytes that will be allocated or written.

        Raises
        ------
        InputError
            They are more than what is left.

        """
        self._taken += int(size)
        share = MEMORY_SHARE if self._kind == "memory" else DISK_SHARE
        limit = "as given" if self._given else f"{share:.0%} of the free {self._kind}"
        require(
            self._taken <= self._limit,
            self._where,
            expected=f"contents of at most {_readable(self._limit)}, {limit}",
            got=f"{_readable(self._taken)} or more",
            remedy=f"if that size is right, free some {self._kind}, or raise the limit where there "
            "is max_bytes (--max-bytes)",
        )


def memory() -> tuple[int, int]:
    """Total and free memory in bytes, in a container too; 0 if the system does not state it."""
    total = free = 0
    try:
        total = free = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        fields = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        free = 1024 * int(fields["MemAvailable"].split()[0])
    except (AttributeError, OSError, ValueError, KeyError):
        pass  # what is not stated stays as it is
    limit, used = container("memory.max"), container("memory.current")
    if limit.isdecimal() and used.isdecimal():
        total, free = min(total, int(limit)), min(free, max(0, int(limit) - int(used)))
    return total, free


def container(name: str) -> str:
    """A limit of the container, "" for none."""
    try:
        return (CGROUP / name).read_text().strip()
    except OSError:
        return ""


def _readable(size: int) -> str:
    """A size with three digits."""
    for unit, name in ((10**9, "GB"), (10**6, "MB"), (10**3, "kB")):
        if size >= unit:
            return f"{size / unit:.3g} {name}"
    return f"{size} bytes"
