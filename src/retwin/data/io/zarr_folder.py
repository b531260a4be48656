"""Zarr: chunked folders for sets that are large; needs the extra `scale`.

`write_zarr` writes a set that is in memory. A set that is larger than the memory is written by
several processes, chunk by chunk: `create_chunked`, then `write_chunk` in any order, then
`seal_chunked`. Either kind is read into a memory map of an uncompressed copy on disk (`Scratch`).
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from retwin.checks import needs_extra, require
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
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.serialisation.files import check_regular, read_json, refusing
from retwin.serialisation.sizes import Budget

TRAJECTORIES_PER_CHUNK = 128
"""The largest number of trajectories in one chunk: enough that a set has few files."""
BYTES_PER_CHUNK = 2**23
"""The largest size of a chunk in bytes: a chunk is in memory as a whole, with its packed copies."""
KEY = "retwin"
"""The attribute of the Zarr group that holds the header."""
CODECS = ["BytesCodec", "ZstdCodec"]
"""How arrays are stored, which is what Zarr does by default."""
TEXTS = ("labels", "ids")
"""The arrays of texts, which are stored in the header."""


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
            expected = "a folder for temporary files with room for all numbers of the set"
            got = f"{tempfile.gettempdir()} ({error.strerror or error})"
            remedy = "set TMPDIR to a folder on a larger disk, or read a part of the set"
            raise InputError("TMPDIR", expected=expected, got=got, remedy=remedy) from error
        self._count += len(rows)

    def array(self) -> NDArray:
        """All rows (n, …) as a read-only memory map."""
        shape = (self._count, *self._row)
        if math.prod(shape) == 0:
            return np.empty(shape, self._dtype)  # an empty file cannot be mapped
        return np.memmap(self._file, self._dtype, mode="r", shape=shape)


def write_zarr(trajectories: Trajectories, path: Path) -> None:
    """Write `trajectories` to the folder `path`, in chunks of whole trajectories.

    Raises
    ------
    InputError
        The package zarr is not installed.

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
        count = min(
            TRAJECTORIES_PER_CHUNK, max(1, BYTES_PER_CHUNK // (math.prod(rest) * array.itemsize))
        )
        target = group.create_array(
            name, shape=array.shape, dtype=array.dtype, chunks=(count, *rest)
        )
        for begin in range(0, len(array) if array.size else 0, count):
            target[begin : begin + count] = array[begin : begin + count]


def read_zarr(
    path: Path, rows: slice = slice(None), *, max_bytes: int | None = None, **_: Any
) -> Trajectories:
    """Trajectories that `write_zarr` wrote, or that were written chunk by chunk.

    Parameters
    ----------
    path : Path
        The folder; it holds all that other formats must be given.
    rows : slice
        The trajectories to read. Of a set that was written chunk by chunk, only the chunks that
        hold them are read, each of which is checked as a whole.
    max_bytes : int
        The largest size of the copy; by default nine tenths of the free disk.

    Returns
    -------
    Trajectories
        Its arrays are read-only memory maps of a copy among the temporary files, so that a set may
        be larger than the memory.

    Raises
    ------
    InputError
        The folder is damaged, of another kind or of a newer schema, the disk has no room for the
        copy, the memory has none for a chunk, or the package zarr is not installed.

    """
    with _open(path) as (group, header):
        budget = Budget(path.name, max_bytes, disk=tempfile.gettempdir())
        if header["schema"] == CHUNKED:
            return _read_chunks(group, header, path.name, rows, budget)
        arrays = {name: np.array(header[name], dtype=np.str_) for name in TEXTS}
        for name in set(NAMES) - set(TEXTS):
            shape = header["arrays"][name]["shape"]
            _check_size(group[name], shape, TRAJECTORIES_PER_CHUNK, path.name)
            budget.take(group[name].nbytes)
            arrays[name] = _copy(group[name])
        return restore(header, arrays, path.name)[rows]


def read_header(path: Path) -> dict[str, Any]:
    """The header of a folder without its arrays.

    Raises
    ------
    InputError
        See `read_zarr`.

    """
    with _open(path) as (_, header):
        return header


@contextmanager
def _open(path: Path) -> Iterator[tuple[Any, dict[str, Any]]]:
    """The group in a folder, and its header; InputError for every exception in the block."""
    zarr, about = _zarr(), "zarr.json"
    expected = "a readable Zarr folder of trajectories"
    with refusing(path.name, expected=expected, remedy="get or make the folder again"):
        for file in (path / about, *(path / name / about for name in NAMES)):
            if file.exists():  # a pipe may never end, and deep nesting is no JSON
                read_json(file)
        group = zarr.open_group(str(path), mode="r", zarr_format=3)
        header: Any = dict(group.attrs).get(KEY)
        check_header(header, path.name, newest=CHUNKED)
        yield group, dict(header)


def create_chunked(path: Path, header: Mapping[str, Any], dtype: DTypeLike) -> None:
    """Make the arrays of `chunked_header` in the new folder `path`, still without any values.

    Numbers are stored as `dtype`.

    Raises
    ------
    InputError
        The package zarr is not installed.

    """
    zarr = _zarr()
    group = zarr.open_group(str(path), mode="w", zarr_format=3)
    kinds = {"mask": np.dtype(bool), "labels": np.dtype(np.int16)}
    for name in CHUNKED_NAMES:
        shape = header["arrays"][name]["shape"]
        chunks = (header["chunk"], *(max(1, size) for size in shape[1:]))
        kind = kinds.get(name, np.dtype(dtype)).newbyteorder("<")
        # Level of the compression of chunks: half the time of the default, for a file 1 % larger.
        codec = zarr.codecs.ZstdCodec(level=1)
        group.create_array(name, shape=shape, dtype=kind, chunks=chunks, compressors=codec)


def write_chunk(path: Path, begin: int, arrays: Mapping[str, NDArray]) -> str:
    """Write the chunk whose first trajectory is `begin`, and return its `chunk_digest`.

    Each array has one file per chunk, so that processes that write different chunks never write
    the same file.
    """
    zarr = _zarr()
    for name in CHUNKED_NAMES:
        if arrays[name].size:
            # All chunks are written, so that none need be compared with an empty one.
            every = {"write_empty_chunks": True}
            stored = zarr.open_array(str(path / name), mode="r+", config=every)
            stored[begin : begin + len(arrays[name])] = arrays[name]
    return chunk_digest(arrays)


def seal_chunked(path: Path, header: Mapping[str, Any]) -> None:
    """Write the header of a folder whose chunks are complete; without it, reading is refused."""
    for unfinished in path.rglob("*.partial"):  # a process was killed while it wrote
        unfinished.unlink()
    _zarr().open_group(str(path), mode="r+").attrs[KEY] = dict(header)


def _copy(stored: Any) -> NDArray:
    """An array of Zarr as a memory map; one chunk at a time is in memory."""
    if not stored.size:
        return np.empty(stored.shape, stored.dtype)
    with Scratch(stored.shape[1:], stored.dtype) as scratch:
        for number in range(stored.cdata_shape[0]):
            scratch.append(_chunk(stored, number))
        return scratch.array()


def _read_chunks(
    group: Any, header: Mapping[str, Any], where: str, rows: slice, budget: Budget
) -> Trajectories:
    """The trajectories at `rows` that did not fail; one chunk at a time is in memory."""
    size = int(header["chunk"])
    for name in CHUNKED_NAMES:
        _check_size(group[name], header["arrays"][name]["shape"], size, where)
    count = group["labels"].shape[0]
    # Memory for the place of a trajectory in a set of which a part is read.
    Budget(where).take(32 * count)
    index = np.arange(count)[rows]
    for name in CHUNKED_NAMES:
        budget.take(len(index) * group[name].nbytes // max(1, count))
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
            chunk = {name: _chunk(group[name], number) for name in CHUNKED_NAMES}
            check_chunk(header, chunk, number, where)
            good.append(some[chunk["labels"][some - begin] != FAILED])
            for name, array in chunk.items():
                scratch[name].append(array[good[-1] - begin])
        arrays = {name: each.array() for name, each in scratch.items()}
    return restore_chunked(header, arrays, np.concatenate(good))


def _check_size(array: Any, shape: list[int], chunk: int, where: str, *, copies: int = 3) -> None:
    """Check the layout of an array, and the size of its chunks, before memory is allocated.

    Parameters
    ----------
    copies : int, default 3
        Arrays of the size of a chunk that are in memory while one is unpacked and checked.

    """
    where = f"{where}: {array.basename}"
    chunks = (min(array.chunks[0], chunk), *(max(1, size) for size in shape[1:]))
    intact = list(array.shape) == shape and array.chunks == chunks
    got = f"shape {array.shape} in chunks of {array.chunks}"
    remedy = "the folder is damaged: get or make it again"
    require(intact, where, expected=f"shape {tuple(shape)}", got=got, remedy=remedy)
    # Other codecs may unpack a small file to any size.
    codecs = [type(codec).__name__ for codec in array.metadata.codecs]
    expected = f"numbers that are packed by {' and '.join(CODECS)}"
    remedy = "the folder is damaged: get or make it again"
    require(codecs == CODECS, where, expected=expected, got=", ".join(codecs), remedy=remedy)
    Budget(where).take(copies * math.prod(chunks) * array.dtype.itemsize)


def _chunk(stored: Any, number: int) -> NDArray:
    """A chunk of an array, whose file is checked before it is unpacked.

    A packed file can declare any size, or none: then it is unpacked to its end.
    """
    size = stored.chunks[0]
    key = stored.metadata.encode_chunk_key((number, *(0 for _ in stored.shape[1:])))
    file = Path(stored.store_path.store.root) / stored.store_path.path / key
    if file.exists():  # zeros are not always stored
        with check_regular(file).open("rb") as opened:
            _check_frame(
                opened.read(18).ljust(18), math.prod(stored.chunks) * stored.dtype.itemsize
            )
    return np.asarray(stored[number * size : (number + 1) * size])


def _check_frame(head: bytes, size: int) -> None:
    """Check that the head of a Zstandard frame declares `size` bytes (RFC 8878, 3.1.1.1)."""
    code, single = head[4] >> 6, head[4] >> 5 & 1
    begin = 5 + (not single) + (0, 1, 2, 4)[head[4] & 3]
    width = (single, 2, 4, 8)[code]
    declared = int.from_bytes(head[begin : begin + width], "little") + 256 * (width == 2)
    if head[:4] != b"\x28\xb5\x2f\xfd" or not width or declared != size:
        raise ValueError(f"a chunk that is not one frame of {size} bytes")


def _zarr() -> Any:
    return needs_extra("zarr", "scale", "reads and writes Zarr folders")
