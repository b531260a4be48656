"""NPZ with a JSON header: the file format of retwin, the same bytes for the same trajectories."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.io.header import NAMES, arrays_of, check_header, header_of, restore
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError, brief

__all__ = ["read_npz", "write_npz"]

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


def read_npz(path: Path, **_: Any) -> Trajectories:
    """Trajectories that `write_npz` wrote; the file holds all that other formats must be given.

    Raises
    ------
    InputError
        The file is damaged, another kind of NPZ, holds pickled objects, or has a newer schema.

    """
    try:
        # Not np.load: it leaves a damaged file open.
        with zipfile.ZipFile(path) as archive:
            require(
                "header.npy" in archive.namelist(),
                path.name,
                expected="trajectories saved by retwin, with a header",
                got="an NPZ file without",
                remedy="give a file that `retwin data convert` wrote",
            )
            header = json.loads(_array(archive, "header").tobytes())
            check_header(header, path.name)
            arrays = {name: _array(archive, name) for name in NAMES}
        return restore(header, arrays, path.name)
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            "path",
            expected="a readable NPZ file without pickled objects",
            got=f"{path.name}, which is damaged or of another kind ({brief(error)})",
            remedy="get or make the file again",
        ) from None


def _array(archive: zipfile.ZipFile, name: str) -> NDArray:
    with archive.open(f"{name}.npy") as file:
        array: NDArray = np.lib.format.read_array(file, allow_pickle=False)
        file.read(1)  # to the very end, where the zip checks its checksum
    return array
