"""`MonitorState`: what a monitor remembers of machines, as arrays or as rows of numbers to keep."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import count, takewhile
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from retwin.monitor.detect.detector import DetectorState
from retwin.monitor.detect.disturbance import DisturbanceState
from retwin.monitor.detect.events import Course
from retwin.monitor.detect.validity import ValidityState
from retwin.update.dynamics.filter.online import FilterState

Kind = TypeVar("Kind")
PARTS = ("disturbance", "detector", "validity")
"""What the state of a monitor has of each stream."""


@dataclass(frozen=True, eq=False)
class MonitorState:
    """What a monitor remembers of n machines with d_y outputs each; all of it.

    Attributes
    ----------
    filters : tuple of FilterState
        Of the n machines, one for each predictive model.
    disturbance, detector, validity
        Of n * M * d_y streams: those of the first machine first, and of these the d_y outputs of
        the first of M predictive models.
    course : Course
        Samples, and the event that lasts, of the n machines.
    changes : NDArray
        (n, 3, d_u), changes of commands that are remembered; see `features`.
    scale : NDArray
        (n * M * d_y, 2), of the noise of each stream; see `own_scale`.
    void : NDArray
        (n,) bool, whether the promise does not apply to the machine.

    """

    filters: tuple[FilterState, ...]
    disturbance: DisturbanceState
    detector: DetectorState
    validity: ValidityState
    course: Course
    changes: NDArray
    scale: NDArray
    void: NDArray

    def arrays(self) -> dict[str, NDArray]:
        """All arrays by name, whose first axis is that of machines."""
        count, found = len(self.void), dict[str, NDArray]()
        for number, each_filter in enumerate(self.filters):
            found |= arrays_of(_filter(number), each_filter)
        for name in PARTS:
            own = arrays_of(name, getattr(self, name))
            found |= {key: each.reshape(count, -1, *each.shape[1:]) for key, each in own.items()}
        scale = self.scale.reshape(count, -1, 2)
        found |= arrays_of("course", self.course)
        return found | {"changes": self.changes, "scale": scale, "void": self.void}

    @classmethod
    def of_arrays(cls, arrays: dict[str, NDArray]) -> MonitorState:
        """The state of what `arrays` gave, of some machines or of several joined."""
        rows = dict(arrays)
        for key, each in arrays.items():
            if key.split(".")[0] in (*PARTS, "scale"):  # a row of each stream
                rows[key] = each.reshape(-1, *each.shape[2:])
        filters = takewhile(lambda name: f"{name}.states" in rows, map(_filter, count()))
        return cls(
            tuple(part_of(FilterState, name, rows) for name in filters),
            part_of(DisturbanceState, "disturbance", rows),
            part_of(DetectorState, "detector", rows),
            part_of(ValidityState, "validity", rows),
            part_of(Course, "course", rows),
            *(rows[name] for name in ("changes", "scale", "void")),
        )


class Layout:
    """The states of machines of one monitor as rows (n, K) of numbers.

    Parameters
    ----------
    start : MonitorState
        That of one machine, before its first sample.
    digest : str
        The hexadecimal hash of its files: its states are of no use to another one.

    """

    def __init__(self, start: MonitorState, digest: str = "") -> None:
        self.digest = np.frombuffer(bytes.fromhex(digest), dtype=np.uint8)
        arrays = start.arrays()
        self._parts = {name: (each.dtype, each.shape[1:]) for name, each in arrays.items()}
        self._ends = np.cumsum([each[0].size for each in arrays.values()])
        self.start = self.rows(start)[0]
        """(K,), the state before the first sample."""

    def rows(self, state: MonitorState) -> NDArray:
        """The rows (n, K) of a state."""
        arrays = state.arrays()
        count = len(state.void)
        # Whole numbers and truth values are exact as floats.
        flat = [arrays[name].reshape(count, -1).astype(float) for name in self._parts]
        return np.concatenate(flat, axis=1)

    def state(self, rows: NDArray) -> MonitorState:
        """The state of rows (n, K)."""
        parts = np.split(rows, self._ends[:-1], axis=1)
        return MonitorState.of_arrays(
            {
                name: part.reshape(-1, *shape).astype(dtype)
                for (name, (dtype, shape)), part in zip(self._parts.items(), parts, strict=True)
            }
        )


def arrays_of(name: str, part: Any) -> dict[str, NDArray]:
    """The arrays of a part of a state, by names that begin with that of the part."""
    return {f"{name}.{each.name}": getattr(part, each.name) for each in fields(part)}


def part_of(kind: type[Kind], name: str, arrays: Mapping[str, NDArray]) -> Kind:
    """The part of a state of what `arrays_of` gave."""
    own = {each.name: np.asarray(arrays[f"{name}.{each.name}"]) for each in fields(kind)}  # type: ignore[arg-type]
    return kind(**own)


def _filter(number: int) -> str:
    """The name of a filter among the arrays of a state."""
    return f"filter{number or ''}"
