"""`MonitorState`: what a monitor remembers of the machines that it watches, as arrays to keep."""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import count, takewhile
from typing import Any

from numpy.typing import NDArray

from retwin.monitor.detect.detector import DetectorState
from retwin.monitor.detect.disturbance import DisturbanceState
from retwin.monitor.detect.events import Course
from retwin.monitor.detect.validity import ValidityState
from retwin.update.dynamics.online import FilterState

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
        found |= {f"course.{each.name}": getattr(self.course, each.name) for each in fields(Course)}
        scale = self.scale.reshape(len(self.void), -1, 2)
        return found | {"changes": self.changes, "scale": scale, "void": self.void}

    @classmethod
    def of_arrays(cls, arrays: dict[str, NDArray]) -> MonitorState:
        """The state of what `arrays` gave, of some machines or of several joined."""

        def part(name: str, kind: Any) -> Any:
            own = {each.name: arrays[f"{name}.{each.name}"] for each in fields(kind)}
            if name in PARTS:  # one row per stream
                own = {key: each.reshape(-1, *each.shape[2:]) for key, each in own.items()}
            return kind(**own)

        filters = takewhile(lambda name: f"{name}.states" in arrays, map(_filter, count()))
        return cls(
            tuple(part(name, FilterState) for name in filters),
            part("disturbance", DisturbanceState),
            part("detector", DetectorState),
            part("validity", ValidityState),
            part("course", Course),
            arrays["changes"],
            arrays["scale"].reshape(-1, 2),
            arrays["void"],
        )


def _filter(number: int) -> str:
    """The name of a filter among the arrays of a state."""
    return f"filter{number or ''}"
