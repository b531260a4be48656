"""`MonitorState`: what a monitor remembers of the machines that it watches, as arrays to keep."""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import count, takewhile
from typing import Any

from numpy.typing import NDArray

from retwin.monitor.detector import DetectorState
from retwin.monitor.disturbance import DisturbanceState
from retwin.monitor.validity import ValidityState
from retwin.update.dynamics.online import FilterState

PARTS = {
    "disturbance": DisturbanceState,
    "detector": DetectorState,
    "validity": ValidityState,
}
"""What the state of a monitor consists of, beside the filters."""


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
    samples, blank : NDArray
        (n,), samples since the start, and samples for which no alarm is raised any more.
    void : NDArray
        (n,) bool, whether the promise does not apply to the machine.

    """

    filters: tuple[FilterState, ...]
    disturbance: DisturbanceState
    detector: DetectorState
    validity: ValidityState
    samples: NDArray
    blank: NDArray
    void: NDArray

    def arrays(self) -> dict[str, NDArray]:
        """All arrays by name, whose first axis is that of machines."""
        found = {
            f"{_filter(number)}.{each.name}": getattr(own, each.name)
            for number, own in enumerate(self.filters)
            for each in fields(own)
        }
        for name in PARTS:
            value = getattr(self, name)
            for each in fields(value):
                array = getattr(value, each.name)
                array = array.reshape(len(self.void), -1, *array.shape[1:])
                found[f"{name}.{each.name}"] = array
        return found | {name: getattr(self, name) for name in ("samples", "blank", "void")}

    @classmethod
    def of_arrays(cls, arrays: dict[str, NDArray]) -> MonitorState:
        """The state of what `arrays` gave, of some machines or of several joined."""

        def part(name: str, kind: Any) -> Any:
            own = {each.name: arrays[f"{name}.{each.name}"] for each in fields(kind)}
            if kind is not FilterState:
                own = {key: each.reshape(-1, *each.shape[2:]) for key, each in own.items()}
            return kind(**own)

        filters = takewhile(lambda name: f"{name}.states" in arrays, map(_filter, count()))
        return cls(
            tuple(part(name, FilterState) for name in filters),
            *(part(name, kind) for name, kind in PARTS.items()),
            *(arrays[name] for name in ("samples", "blank", "void")),
        )


def _filter(number: int) -> str:
    """The name of a filter among the arrays of a state."""
    return f"filter{number or ''}"
