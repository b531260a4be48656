"""Zarr: chunked folders for sets that are large; needs the extra `scale`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from retwin.errors import InputError
from retwin.storage.border import brief
from retwin.storage.header import NAMES, arrays_of, check_header, header_of, restore
from retwin.trajectories import Trajectories

__all__ = ["read_zarr", "write_zarr"]

CHUNK = 128
KEY = "retwin"


def write_zarr(trajectories: Trajectories, path: Path) -> None:
    """Write `trajectories` to the folder `path`, in chunks of whole trajectories.

    Raises InputError when the package zarr is not installed.
    """
    zarr = _zarr()
    arrays = arrays_of(trajectories)
    group = zarr.open_group(str(path), mode="w", zarr_format=3)
    group.attrs[KEY] = header_of(trajectories, arrays)
    for name, array in arrays.items():
        text = array.dtype.kind == "U"
        chunks = (CHUNK, *(max(1, size) for size in array.shape[1:]))
        # Texts of fixed width have no Zarr specification, texts of any width have.
        target = group.create_array(
            name, shape=array.shape, dtype=str if text else array.dtype, chunks=chunks
        )
        if array.size:
            target[...] = array


def read_zarr(path: Path) -> Trajectories:
    """Trajectories that `write_zarr` wrote.

    Raises InputError for a damaged folder, one of another kind, a newer schema, or when the
    package zarr is not installed.
    """
    zarr = _zarr()
    try:
        group = zarr.open_group(str(path), mode="r")
        header: Any = dict(group.attrs).get(KEY)
        check_header(header, path.name)
        arrays = {name: np.asarray(group[name][...]) for name in NAMES}
        for name in ("labels", "ids"):
            arrays[name] = np.array(arrays[name].tolist(), dtype=np.str_)
        return restore(header, arrays, path.name)
    except InputError:
        raise
    except Exception as error:  # noqa: BLE001 - a damaged folder makes zarr raise almost anything
        raise InputError(
            "path",
            expected="a readable Zarr folder of trajectories",
            got=f"{path.name}, which is damaged or of another kind ({brief(error)})",
            remedy="get or make the folder again",
        ) from None


def _zarr() -> Any:
    try:
        import zarr
    except ImportError:
        raise InputError(
            "path",
            expected="the package zarr, which reads and writes Zarr folders",
            got="an installation without it",
            remedy='install it: pip install "retwin[scale]"',
        ) from None
    return zarr
