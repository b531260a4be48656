"""Arrays larger than the memory: rows in a temporary file, then a memory map of it."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from retwin.errors import InputError


class Scratch:
    """Rows of one array, appended to a temporary file and then mapped into memory.

    The file has no name, so that it is gone when no map of it exists any more, also if the process
    is killed. After its block as a context manager, no rows can be appended; arrays stay valid.

    Parameters
    ----------
    row : sequence of int
        The shape of one row.
    dtype : numpy.dtype
        The type of the numbers.

    """

    def __init__(self, row: Sequence[int], dtype: np.dtype) -> None:
        self._row, self._dtype = tuple(row), dtype
        self._count = 0
        # Unbuffered, so that a full disk raises where rows are appended.
        self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - closed at exit

    def __enter__(self) -> Scratch:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, rows: NDArray) -> None:
        """Append rows; InputError if the disk has no room for them."""
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
        """All rows (n, …) as a read-only memory map."""
        shape = (self._count, *self._row)
        if math.prod(shape) == 0:
            return np.empty(shape, self._dtype)  # an empty file cannot be mapped
        return np.memmap(self._file, self._dtype, mode="r", shape=shape)
