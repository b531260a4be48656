"""Zarr: chunked folders for sets that are large; needs the extra `scale`.

`write_zarr` writes a set that is at hand. A set that no memory holds is written by several
processes, chunk by chunk: `create_chunked`, then `write_chunk` in any order, then `seal_chunked`.
Of either kind, what is read is a map of an uncompressed copy on disk (`Scratch`), not memory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from retwin.data.io.header import (
    CHUNKED,
    CHUNKED_NAMES,
    FAILED,
    NAMES,
    arrays_of,
    check_chunk,
    check_header,
    chunk_digest,
    header_of,
    restore,
    restore_chunked,
)
from retwin.data.io.scratch import Scratch
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError, brief

__all__ = [
    "create_chunked",
    "read_header",
    "read_zarr",
    "seal_chunked",
    "write_chunk",
    "write_zarr",
]

CHUNK = 128
"""Trajectories that are stored together, at most."""
CHUNK_BYTES = 2**23
"""Bytes of them, at most: a chunk is in memory as a whole, and more than once while packed."""
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
        rest = [max(1, size) for size in array.shape[1:]]
        count = min(CHUNK, max(1, CHUNK_BYTES // (math.prod(rest) * array.itemsize)))
        target = group.create_array(
            name, shape=array.shape, dtype=array.dtype, chunks=(count, *rest)
        )
        for rows in _chunks(len(array), count) if array.size else ():
            target[rows] = array[rows]


def read_zarr(path: Path, rows: slice = slice(None)) -> Trajectories:
    """Trajectories that `write_zarr` wrote, or that were written chunk by chunk.

    Their arrays are read-only maps of a copy among the temporary files, so a set may be larger than
    the memory. Of a set in chunks, only the chunks that hold `rows` are read; each is checked as a
    whole.

    Raises InputError for a damaged folder, one of another kind, a newer schema, no room for the
    copy, no memory for a chunk, or when the package zarr is not installed.
    """
    zarr = _zarr()
    try:
        group = zarr.open_group(str(path), mode="r")
        header = _header(group, path.name)
        if header["schema"] == CHUNKED:
            return _read_chunks(group, header, path.name, rows)
        arrays = {name: np.array(header[name], dtype=np.str_) for name in TEXTS}
        for name in set(NAMES) - set(TEXTS):
            _check_size(group[name], header["arrays"][name]["shape"], CHUNK, path.name)
            arrays[name] = _copied(group[name])
        return restore(header, arrays, path.name)[rows]
    except InputError:
        raise
    except MemoryError:
        raise InputError(
            "path",
            expected="memory for one chunk of the set, several times over",
            got=f"too little to read {path.name}",
            remedy="end what else takes memory, or read it on a larger machine",
        ) from None
    except Exception as error:
        raise _damaged(path, error) from None


def read_header(path: Path) -> dict[str, Any]:
    """The header of a folder without its arrays; raises as `read_zarr` does."""
    zarr = _zarr()
    try:
        return _header(zarr.open_group(str(path), mode="r"), path.name)
    except InputError:
        raise
    except Exception as error:
        raise _damaged(path, error) from None


def create_chunked(path: Path, header: Mapping[str, Any], dtype: DTypeLike) -> None:
    """Make the arrays of `chunked_header` in the new folder `path`, still without any values.

    Numbers are stored as `dtype`. Raises InputError when the package zarr is not installed.
    """
    group = _zarr().open_group(str(path), mode="w", zarr_format=3)
    kinds = {"mask": np.dtype(bool), "labels": np.dtype(np.int16)}
    for name in CHUNKED_NAMES:
        shape = header["arrays"][name]["shape"]
        chunks = (header["chunk"], *(max(1, size) for size in shape[1:]))
        kind = kinds.get(name, np.dtype(dtype)).newbyteorder("<")
        group.create_array(name, shape=shape, dtype=kind, chunks=chunks)


def write_chunk(path: Path, begin: int, arrays: Mapping[str, NDArray]) -> str:
    """Write the chunk whose first trajectory is `begin`, and return its `chunk_digest`.

    A chunk is a file of its own per array: processes that write different ones do not meet.
    """
    group = _zarr().open_group(str(path), mode="r+")
    for name in CHUNKED_NAMES:
        if arrays[name].size:
            group[name][begin : begin + len(arrays[name])] = arrays[name]
    return chunk_digest(arrays)


def seal_chunked(path: Path, header: Mapping[str, Any]) -> None:
    """Put the header on a folder whose chunks are all written; before that, nobody can read it."""
    for left_over in path.rglob("*.partial"):  # of a process that was killed while it wrote
        left_over.unlink()
    _zarr().open_group(str(path), mode="r+").attrs[KEY] = dict(header)


def _header(group: Any, where: str) -> dict[str, Any]:
    header: Any = dict(group.attrs).get(KEY)
    check_header(header, where, newest=CHUNKED)
    return dict(header)


def _copied(stored: Any) -> NDArray:
    """An array of Zarr as a map, with one chunk at a time in memory."""
    if not stored.size:
        return np.empty(stored.shape, stored.dtype)
    with Scratch(stored.shape[1:], stored.dtype) as scratch:
        for rows in _chunks(stored.shape[0], stored.chunks[0]):
            scratch.append(np.asarray(stored[rows]))
        return scratch.array()


def _read_chunks(group: Any, header: Mapping[str, Any], where: str, rows: slice) -> Trajectories:
    """The trajectories at `rows` that did not fail, with one chunk at a time in memory."""
    size = int(header["chunk"])
    for name in CHUNKED_NAMES:
        _check_size(group[name], header["arrays"][name]["shape"], size, where)
    index = np.arange(group["labels"].shape[0])[rows]
    of_chunks = np.split(index, np.flatnonzero(np.diff(index // size)) + 1) if len(index) else []
    good = [index[:0]]
    with ExitStack() as files:
        scratch = {
            name: files.enter_context(Scratch(group[name].shape[1:], group[name].dtype))
            for name in CHUNKED_NAMES
        }
        for some in of_chunks:
            number = int(some[0]) // size
            begin = number * size
            chunk = {name: np.asarray(group[name][begin : begin + size]) for name in CHUNKED_NAMES}
            check_chunk(header, chunk, number, where)
            good.append(some[chunk["labels"][some - begin] != FAILED])
            for name, array in chunk.items():
                scratch[name].append(array[good[-1] - begin])
        arrays = {name: each.array() for name, each in scratch.items()}
    return restore_chunked(header, arrays, np.concatenate(good))


def _chunks(count: int, size: int) -> list[slice]:
    return [slice(begin, begin + size) for begin in range(0, count, size)]


def _check_size(array: Any, shape: list[int], chunk: int, where: str) -> None:
    """Refuse a size that was not written, before memory is taken for it."""
    largest = chunk * math.prod(max(1, size) for size in shape[1:])
    if list(array.shape) != shape or math.prod(array.chunks) > largest:
        raise InputError(
            f"{where}: {array.basename}",
            expected=f"shape {tuple(shape)}",
            got=f"shape {array.shape} in chunks of {array.chunks}",
            remedy="the folder is damaged: get or make it again",
        )


def _damaged(path: Path, error: Exception) -> InputError:
    return InputError(
        "path",
        expected="a readable Zarr folder of trajectories",
        got=f"{path.name}, which is damaged or of another kind ({brief(error)})",
        remedy="get or make the folder again",
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
