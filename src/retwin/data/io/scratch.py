"""Arrays that no memory holds: rows on disk, in a file without a name, then a map of it."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from retwin.errors import InputError

__all__ = ["Scratch"]


class Scratch:
    """Rows of one array, taken one after the other to a file in the folder for temporary files.

    The file has no name: when nobody holds its map any more, or the process is killed, it is gone.
    A context manager: after it no rows are taken, and what was made is still there.

    Parameters
    ----------
    row: shape of one row.
    dtype: of the numbers.

    """

    def __init__(self, row: Sequence[int], dtype: np.dtype) -> None:
        self._row, self._dtype = tuple(row), dtype
        self._count = 0
        # Unbuffered, so that a full disk is told where the rows are given.
        self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - closed at exit

    def __enter__(self) -> Scratch:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, rows: NDArray) -> None:
        """Take these rows; InputError when the disk has no room for them."""
        rest = np.ascontiguousarray(rows, self._dtype).reshape(-1).view(np.uint8).data
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            raise InputError(
                "TMPDIR",
                expected="a folder for temporary files with room for all numbers of the set",
                got=f"{tempfile.gettempdir()} ({error.strerror or error})",
                remedy="set TMPDIR to a folder on a larger disk, or read a part of the set",
            ) from error
        self._count += len(rows)

    def array(self) -> NDArray:
        """All rows (n, …), read-only; those looked at come into memory, and may leave it again."""
        shape = (self._count, *self._row)
        if math.prod(shape) == 0:
            return np.empty(shape, self._dtype)  # nothing cannot be mapped
        return np.memmap(self._file, self._dtype, mode="r", shape=shape)
