"""The header of NPZ and Zarr sets, as JSON values, with the digests of the arrays.

Schema 1, in NPZ and Zarr: a set that was saved as a whole, with the SHA-256 of every array. Schema
2, in Zarr only: a set that was written chunk by chunk, in any order, with the SHA-256 of every
chunk; labels are numbers and ids are indices there, since a million texts do not fit a header.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.data.trajectories import Channels, Provenance, Trajectories

FORMAT = "retwin-trajectories"
SCHEMA = 1
"""The schema of sets that were saved as a whole."""
CHUNKED = 2
"""The schema of sets that were written chunk by chunk."""
NAMES = ("commands", "nominal", "observed", "mask", "labels", "ids")
"""The arrays of a set that was saved as a whole, in the order of their digests."""
CHUNKED_NAMES = NAMES[:-1]
"""The arrays of a set that was written chunk by chunk."""
FAILED = -1
"""The label, in place of a class's number, of a trajectory that could not be simulated."""


def arrays_of(trajectories: Trajectories) -> dict[str, NDArray]:
    """The arrays to write; their order, byte order and text width depend on the content alone."""
    arrays = {}
    for name in NAMES:
        array = np.asarray(getattr(trajectories, name))
        if array.dtype.kind == "U":
            # A part of a set inherits the text width of the whole: measure it anew.
            array = np.array(array.tolist(), dtype=np.str_)
        arrays[name] = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    return arrays


def header_of(trajectories: Trajectories, arrays: Mapping[str, NDArray]) -> dict[str, Any]:
    """Sample rate, channels and provenance as JSON values; shapes and SHA-256 of the arrays."""
    return _about(trajectories, SCHEMA) | {
        "arrays": {
            name: {"shape": list(arrays[name].shape), "sha256": _digest(arrays[name])}
            for name in NAMES
        }
    }


def chunked_header(
    some: Trajectories,
    *,
    count: int,
    classes: Sequence[str],
    chunk: int,
    digests: Sequence[str],
    failed: Mapping[int, str],
) -> dict[str, Any]:
    """The header of a set that is written chunk by chunk, as JSON values.

    Parameters
    ----------
    some : Trajectories
        Some trajectories of the set, or none: for samples, channels, rate and provenance.
    count : int
        The number of trajectories, with those that failed.
    classes : sequence of str
        The class names for which the numbers in `labels` stand.
    chunk : int
        Trajectories per chunk; the last chunk may be shorter.
    digests : sequence of str
        The `chunk_digest` of every chunk, in order.
    failed : mapping of int to str
        The index of every trajectory that could not be simulated, and the reason.

    """
    shapes = {name: [count, *getattr(some, name).shape[1:]] for name in CHUNKED_NAMES}
    return _about(some, CHUNKED) | {
        "arrays": {name: {"shape": shape} for name, shape in shapes.items()},
        "classes": list(classes),
        "chunk": chunk,
        "chunks": list(digests),
        "failed": {str(index): failed[index] for index in sorted(failed)},
    }


def check_header(header: Any, where: str, newest: int = SCHEMA) -> None:
    """Check the format and schema of a header.

    Raises
    ------
    InputError
        It is of another format, or of a schema above `newest`, the latest that is known.

    """
    schema = header.get("schema") if isinstance(header, dict) else None
    fits = isinstance(header, dict) and header.get("format") == FORMAT and type(schema) is int
    expected = "trajectories saved by retwin"
    remedy = "give a file that `retwin data convert` wrote"
    require(fits, where, expected=expected, got="another kind of file", remedy=remedy)
    fits = isinstance(schema, int) and 1 <= schema <= newest
    expected = f"schema {newest} or older"
    remedy = "upgrade retwin: pip install --upgrade retwin"
    require(fits, where, expected=expected, got=f"schema {schema}", remedy=remedy)


def restore(header: Mapping[str, Any], arrays: Mapping[str, NDArray], where: str) -> Trajectories:
    """The trajectories that `header` and `arrays` describe, checked against their SHA-256.

    Raises
    ------
    InputError
        The arrays are not those that were written.

    """
    for name in NAMES:
        same = header["arrays"][name]["sha256"] == _digest(arrays[name])
        _require_same(same, where, f"the array {name!r}", "file")
    return Trajectories(**{**arrays, **_read_about(header)})


def restore_chunked(
    header: Mapping[str, Any], arrays: Mapping[str, NDArray], index: NDArray
) -> Trajectories:
    """The trajectories at `index` of a set written in chunks, none of which failed.

    `arrays` holds the rows at `index`; the ids are the indices.
    """
    kept: dict[str, Any] = {name: arrays[name] for name in CHUNKED_NAMES}
    kept["labels"] = np.array(header["classes"], dtype=np.str_)[kept["labels"]]
    kept["ids"] = np.array([f"{i:05d}" for i in index], dtype=np.str_)
    return Trajectories(**kept, **_read_about(header))


def chunk_digest(arrays: Mapping[str, NDArray]) -> str:
    """The SHA-256 of one chunk: its arrays' own, in their fixed order."""
    total = hashlib.sha256()
    for name in CHUNKED_NAMES:
        total.update(f"{name} {_digest(arrays[name])}\n".encode())
    return total.hexdigest()


def check_chunk(
    header: Mapping[str, Any], arrays: Mapping[str, NDArray], number: int, where: str
) -> None:
    """Check the arrays of a chunk against their SHA-256.

    Raises
    ------
    InputError
        They are not those that were written.

    """
    same = header["chunks"][number] == chunk_digest(arrays)
    _require_same(same, where, f"chunk {number}", "folder")


def _require_same(same: bool, where: str, what: str, kind: str) -> None:
    expected, remedy = f"{what} as it was written", f"the {kind} is damaged: get or make it again"
    require(same, where, expected=expected, got="other bytes", remedy=remedy)


def _digest(array: NDArray) -> str:
    total = hashlib.sha256(f"{array.dtype.str} {array.shape}".encode())
    total.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return total.hexdigest()


def _about(trajectories: Trajectories, schema: int) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "schema": schema,
        "rate": trajectories.rate,
        "inputs": vars(trajectories.inputs),
        "outputs": vars(trajectories.outputs),
        "provenance": [source.plain() for source in trajectories.provenance],
        "emulated": trajectories.emulated,
    }


def _read_about(header: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "rate": header["rate"],
        "inputs": Channels.of(header["inputs"]),
        "outputs": Channels.of(header["outputs"]),
        "provenance": tuple(map(Provenance.of, header["provenance"])),
        "emulated": bool(header["emulated"]),
    }
