"""`StoredArrays`: results that consist of arrays, written to an NPZ file and read from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Channels
from retwin.serialisation.files import write_atomically


class StoredArrays:
    """The base of a dataclass of arrays, channels, numbers, and pairs of arrays by their names."""

    def save(self, file: str | Path) -> None:
        """Write an NPZ file; `load` reads it."""
        arrays: dict[str, Any] = {}
        for name in get_type_hints(type(self)):
            value = getattr(self, name)
            if isinstance(value, Mapping):
                pairs = [(key, i, own) for key, pair in value.items() for i, own in enumerate(pair)]
                arrays |= {f"{name}/{key}/{i}": own for key, i, own in pairs}
            else:
                is_channels = isinstance(value, Channels)
                arrays[name] = np.array([value.names, value.units] if is_channels else value)
        with write_atomically(Path(file)) as part:
            np.savez_compressed(part, allow_pickle=False, **arrays)

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """The rows of several results as one; where some have fewer segments, NaN follows."""
        joined: dict[str, Any] = {}
        for name in get_type_hints(cls):
            values = [getattr(part, name) for part in parts]
            first = joined[name] = values[0]
            if isinstance(first, np.ndarray):
                joined[name] = _concatenate(values)
            elif isinstance(first, Mapping):
                joined[name] = {
                    key: tuple(map(_concatenate, zip(*(each[key] for each in values), strict=True)))
                    for key in first
                }
        return cls(**joined)

    @classmethod
    def load(cls, file: str | Path) -> Self:
        """Read what `save` wrote."""
        values: dict[str, Any] = {}
        with np.load(file, allow_pickle=False) as found:
            for name, kind in get_type_hints(cls).items():
                if get_origin(kind) is Mapping:
                    keys = [
                        each.split("/")[1] for each in found.files if each.startswith(f"{name}/")
                    ]
                    values[name] = {
                        key: (found[f"{name}/{key}/0"], found[f"{name}/{key}/1"])
                        for key in dict.fromkeys(keys)
                    }
                elif kind is Channels:
                    values[name] = Channels(*(tuple(row.tolist()) for row in found[name]))
                else:
                    values[name] = kind(found[name]) if kind in (int, float) else found[name]
        return cls(**values)


def _concatenate(arrays: Sequence[NDArray]) -> NDArray:
    """Arrays along their first axis, filled with NaN up to the largest of the others."""
    shape = np.max([each.shape[1:] for each in arrays], axis=0).astype(int)
    padded = []
    for each in arrays:
        missing = [(0, 0), *((0, n) for n in shape - each.shape[1:])]
        padded.append(np.pad(each, missing, constant_values=np.nan) if np.any(missing) else each)
    return np.concatenate(padded)
