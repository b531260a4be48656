"""The header of retwin's own formats: schema 1, the same in NPZ and Zarr."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.errors import InputError
from retwin.trajectories import Channels, Source, Trajectories

__all__ = ["NAMES", "SCHEMA", "arrays_of", "check_header", "header_of", "restore"]

FORMAT = "retwin-trajectories"
SCHEMA = 1
NAMES = ("commands", "nominal", "observed", "mask", "labels", "ids")


def arrays_of(trajectories: Trajectories) -> dict[str, NDArray]:
    """The arrays to write, in an order, byte order and text width that only content decides."""
    arrays = {}
    for name in NAMES:
        array = np.asarray(getattr(trajectories, name))
        if array.dtype.kind == "U":
            # A part of a set inherits the text width of the whole: measure it anew.
            array = np.array(array.tolist(), dtype=np.str_)
        arrays[name] = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    return arrays


def header_of(trajectories: Trajectories, arrays: Mapping[str, NDArray]) -> dict[str, Any]:
    """What the arrays do not say, as JSON values, and their shapes and SHA-256."""
    return {
        "format": FORMAT,
        "schema": SCHEMA,
        "rate": trajectories.rate,
        "inputs": _channels(trajectories.inputs),
        "outputs": _channels(trajectories.outputs),
        "provenance": [{"name": s.name, "sha256": s.sha256} for s in trajectories.provenance],
        "emulated": trajectories.emulated,
        "arrays": {
            name: {"shape": list(arrays[name].shape), "sha256": _digest(arrays[name])}
            for name in NAMES
        },
    }


def check_header(header: Any, where: str) -> None:
    """Refuse a header of another format or of a schema that this version cannot read."""
    schema = header.get("schema") if isinstance(header, dict) else None
    if not isinstance(header, dict) or header.get("format") != FORMAT or type(schema) is not int:
        raise InputError(
            where,
            expected="trajectories saved by retwin",
            got="another kind of file",
            remedy="give a file that `retwin data convert` wrote",
        )
    if not 1 <= schema <= SCHEMA:
        raise InputError(
            where,
            expected=f"schema {SCHEMA} or older",
            got=f"schema {schema}",
            remedy="upgrade retwin: pip install --upgrade retwin",
        )


def restore(header: Mapping[str, Any], arrays: Mapping[str, NDArray], where: str) -> Trajectories:
    """The trajectories that `header` and `arrays` describe, checked against their SHA-256.

    Raises InputError when the arrays are not those that were written.
    """
    for name in NAMES:
        if header["arrays"][name]["sha256"] != _digest(arrays[name]):
            raise InputError(
                where,
                expected=f"the array {name!r} as it was written",
                got="other bytes",
                remedy="the file is damaged: get or make it again",
            )
    return Trajectories(
        **arrays,
        rate=header["rate"],
        inputs=_read_channels(header["inputs"]),
        outputs=_read_channels(header["outputs"]),
        provenance=tuple(Source(s["name"], s["sha256"]) for s in header["provenance"]),
        emulated=bool(header["emulated"]),
    )


def _digest(array: NDArray) -> str:
    total = hashlib.sha256(f"{array.dtype.str} {array.shape}".encode())
    total.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return total.hexdigest()


def _channels(channels: Channels) -> dict[str, list[str]]:
    return {"names": list(channels.names), "units": list(channels.units)}


def _read_channels(told: Mapping[str, Any]) -> Channels:
    return Channels(tuple(map(str, told["names"])), tuple(map(str, told["units"])))
