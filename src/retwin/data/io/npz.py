"""NPZ with a JSON header: the file format of retwin, the same bytes for the same trajectories."""

from __future__ import annotations

import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.io.header import NAMES, arrays_of, check_header, header_of, restore
from retwin.data.trajectories import Trajectories
from retwin.serialisation.files import parse_json, refusing
from retwin.serialisation.sizes import Budget

BYTES_PER_BLOCK, BYTES_PER_ENTRY = 2**20, 1024
"""Bytes of a file that are read together to count its entries, and the memory that one takes."""
DATE = (1980, 1, 1, 0, 0, 0)
"""The date of each entry of the ZIP file, its earliest: the time of writing is not in the bytes."""


def write_npz(trajectories: Trajectories, path: Path) -> None:
    """Write `trajectories` to `path`; readable by `numpy.load(path, allow_pickle=False)`."""
    arrays = arrays_of(trajectories)
    header = json.dumps(header_of(trajectories, arrays), sort_keys=True, ensure_ascii=False)
    contents = {"header": np.frombuffer(header.encode(), np.uint8), **arrays}
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in contents.items():
            entry = zipfile.ZipInfo(f"{name}.npy", DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3  # the same on every operating system
            entry.external_attr = 0o644 << 16
            with archive.open(entry, "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


def read_npz(path: Path, *, max_bytes: int | None = None, **_: Any) -> Trajectories:
    """Trajectories that `write_npz` wrote; the file holds all that other formats must be given.

    Raises
    ------
    InputError
        The file is damaged, too large, another kind of NPZ, holds pickled objects, or has a newer
        schema.

    """
    budget = Budget(path.name, max_bytes)
    with path.open("rb") as blocks:  # zipfile reads the list of all entries when it opens a file
        for part in iter(lambda: blocks.read(BYTES_PER_BLOCK), b""):
            budget.take(BYTES_PER_ENTRY * part.count(b"PK\1\2"))
    expected = "a readable NPZ file without pickled objects"
    with (
        refusing(path.name, expected=expected, remedy="get or make the file again"),
        # Not np.load: it leaves a damaged file open.
        zipfile.ZipFile(path) as archive,
    ):
        headed = "header.npy" in archive.namelist()
        expected = "trajectories saved by retwin, with a header"
        remedy = "give a file that `retwin data convert` wrote"
        require(headed, path.name, expected=expected, got="an NPZ file without", remedy=remedy)
        header = parse_json(_array(archive, "header", budget).tobytes(), path.name)
        check_header(header, path.name)
        arrays = {name: _array(archive, name, budget) for name in NAMES}
        return restore(header, arrays, path.name)


def _array(archive: zipfile.ZipFile, name: str, budget: Budget) -> NDArray:
    entry = archive.getinfo(f"{name}.npy")
    budget.take(entry.file_size)
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is compressed in a way that has no limit")
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0
        shape, _, dtype = (read if version[0] == 1 else np.lib.format.read_array_header_2_0)(file)
        if math.prod(shape) * max(1, dtype.itemsize) > entry.file_size:
            raise ValueError(f"{name} of shape {shape} in {entry.file_size} bytes")
        file.seek(0)
        array: NDArray = np.lib.format.read_array(file, allow_pickle=False)
        file.read(1)  # to the very end, where the zip checks its checksum
    return array
