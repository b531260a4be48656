"""Zarr: chunked folders for sets that are large; needs the extra `scale`."""

from __future__ import annotations

import math
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
TEXTS = ("labels", "ids")


def write_zarr(trajectories: Trajectories, path: Path) -> None:
    """Write `trajectories` to the folder `path`, in chunks of whole trajectories.

    Raises InputError when the package zarr is not installed.
    """
    zarr = _zarr()
    arrays = arrays_of(trajectories)
    group = zarr.open_group(str(path), mode="w", zarr_format=3)
    header = header_of(trajectories, arrays)
    # Zarr has no specification of texts of fixed width, and of texts of any width a damaged chunk
    # can take gigabytes to refuse: they go into the attributes.
    texts = {name: arrays.pop(name).tolist() for name in TEXTS}
    group.attrs[KEY] = header | texts
    for name, array in arrays.items():
        chunks = (CHUNK, *(max(1, size) for size in array.shape[1:]))
        target = group.create_array(name, shape=array.shape, dtype=array.dtype, chunks=chunks)
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
        arrays = {name: np.array(header[name], dtype=np.str_) for name in TEXTS}
        for name in set(NAMES) - set(TEXTS):
            _check_size(group[name], header["arrays"][name]["shape"], f"{path.name}: {name}")
            arrays[name] = np.asarray(group[name][...])
        return restore(header, arrays, path.name)
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            "path",
            expected="a readable Zarr folder of trajectories",
            got=f"{path.name}, which is damaged or of another kind ({brief(error)})",
            remedy="get or make the folder again",
        ) from None


def _check_size(array: Any, shape: list[int], where: str) -> None:
    """Refuse a size that was not written, before memory is taken for it."""
    largest = CHUNK * math.prod(max(1, size) for size in shape[1:])
    if list(array.shape) != shape or math.prod(array.chunks) > largest:
        raise InputError(
            where,
            expected=f"shape {tuple(shape)}",
            got=f"shape {array.shape} in chunks of {array.chunks}",
            remedy="the folder is damaged: get or make it again",
        )


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
