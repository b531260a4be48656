"""What a monitor remembers of machines, as arrays or rows of numbers to keep, and what it found."""

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
from retwin.monitor.detect.promise import duration
from retwin.monitor.detect.validity import ValidityState
from retwin.update.dynamics.filter.online import FilterState

Kind = TypeVar("Kind")
PARTS = {"disturbance": DisturbanceState, "detector": DetectorState, "validity": ValidityState}
"""What the state of a monitor has of each stream."""
OWN = ("changes", "scale", "void", "entered")
"""Its other arrays."""
SHARE = 0.9
"""Share of onsets after which a fault must have raised an alarm."""


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
    entered : NDArray
        (n, d_y), of each output 0 before it is measured, 1 while it has only been outside of the
        range of the calibration, and 2 from then on.

    """

    filters: tuple[FilterState, ...]
    disturbance: DisturbanceState
    detector: DetectorState
    validity: ValidityState
    course: Course
    changes: NDArray
    scale: NDArray
    void: NDArray
    entered: NDArray

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
        own = {"changes": self.changes, "void": self.void, "entered": self.entered}
        return found | own | {"scale": scale}

    @classmethod
    def of_arrays(cls, arrays: dict[str, NDArray]) -> MonitorState:
        """The state of what `arrays` gave, of some machines or of several joined."""
        rows = dict(arrays)
        for key, each in arrays.items():
            if key.split(".")[0] in (*PARTS, "scale"):  # a row of each stream
                rows[key] = each.reshape(-1, *each.shape[2:])
        filters = takewhile(lambda name: f"{name}.states" in rows, map(_filter, count()))
        every = tuple(part_of(FilterState, name, rows) for name in filters)
        parts: dict[str, Any] = {name: rows[name] for name in OWN}
        for name, kind in {**PARTS, "course": Course}.items():
            parts[name] = part_of(kind, name, rows)
        return cls(every, **parts)


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


@dataclass(frozen=True)
class Alarm:
    """A change that a monitor has found.

    Attributes
    ----------
    trajectory : str
        The id of the record or machine.
    sample : int
        Number of the sample at which the alarm was raised.
    time : float
        Its time in s from the first sample.
    output : str
        The output with most evidence.
    change : str
        The change of that output's errors for which there is most evidence.
    evidence : float
        At least the average run length of the promise.
    event : int
        Number of the sample of the first alarm of its event; its own, if it opens one.
    promised : bool
        Whether the promise applies; else it is no alarm but a remark.
    machine : tuple of float
        The parameters of the machine along the directions of the filter, see `OnlineFilter`.

    """

    trajectory: str
    sample: int
    time: float
    output: str
    change: str
    evidence: float
    event: int
    promised: bool = True
    machine: tuple[float, ...] = ()

    @property
    def opens(self) -> bool:
        """Whether it is the first one of its event."""
        return self.event == self.sample


@dataclass(frozen=True)
class Ending:
    """The end of an event.

    Attributes
    ----------
    trajectory : str
        The id of the record or machine.
    event, sample : int
        Numbers of the sample of its first alarm, and of the one at which it ends.
    how : str
        `FOLLOWS` or `CHANGED` of `retwin.monitor.detect.events`.

    """

    trajectory: str
    event: int
    sample: int
    how: str


@dataclass(frozen=True, eq=False)
class Watched:
    """What a monitor found in T samples of n machines.

    Attributes
    ----------
    mean, deviation : NDArray
        (n, T, d_y), one-step predictions of the twin.
    score : NDArray
        (n, T, d_y), of the errors: standard Gaussian for a healthy machine; NaN for samples that
        do not count.
    evidence : NDArray
        (n, T), that of a change; an alarm is raised from the average run length on.
    alarm, event, void : NDArray
        (n, T) bool, whether an alarm was raised, whether an event lasts, and whether the promise
        does not apply.
    outside : NDArray
        (n,) bool, whether commands leave the range that they had when the twin was calibrated.
    alarms : list of Alarm
        The alarms; those that open an event are `events`.
    endings : list of Ending
        The ends of events.

    """

    mean: NDArray
    deviation: NDArray
    score: NDArray
    evidence: NDArray
    alarm: NDArray
    event: NDArray
    void: NDArray
    outside: NDArray
    alarms: list[Alarm]
    endings: list[Ending]

    @property
    def events(self) -> list[Alarm]:
        """The first alarm of each event."""
        return [each for each in self.alarms if each.opens]


@dataclass(frozen=True, eq=False)
class Part:
    """What was found in T samples of n machines, none of which begins anew before the last."""

    after: MonitorState
    mean: NDArray
    deviation: NDArray
    low: NDArray
    high: NDArray
    evidence: NDArray
    total: NDArray
    end_evidence: NDArray
    alarm: NDArray
    ended: NDArray
    changed: NDArray
    counted: NDArray
    outside: NDArray

    @property
    def until(self) -> int:
        """Samples up to the first alarm or end of an event of any machine; else all."""
        any_ = (self.alarm | self.ended | self.changed).any(axis=0)
        return int(np.argmax(any_)) + 1 if any_.any() else len(any_)


@dataclass(frozen=True)
class Visible:
    """What is seen of a fault.

    Attributes
    ----------
    fault : str
        Its name.
    size : float or None
        The smallest size of those tried that is seen, and all larger ones are; None where none is,
        or where the fault has no size.
    largest : float or None
        The largest size that was tried; None where the fault has no size.
    share : float
        Share of onsets with an alarm in time: at `size`, or else at the largest one.
    within : float
        That time in s.
    unit : str
        Of the sizes; "" where there are none.
    value : float or None
        What a size is compared with: the parameter, 1 for a command, the range of the output in
        calibration; None where it is nothing.
    compared : str
        The name of that.

    """

    fault: str
    size: float | None
    largest: float | None
    share: float
    within: float
    unit: str = ""
    value: float | None = None
    compared: str = "value"

    @property
    def relative(self) -> float:
        """The size from which on it is seen over what it is compared with; 0 without either."""
        return abs(self.size / self.value) if self.size and self.value else 0.0

    @property
    def hidden(self) -> bool:
        """Whether it is not seen, or only where it is as large as what it changes."""
        return self.share < SHARE or self.relative >= 1

    def _with_unit(self, size: float) -> str:
        return f"{abs(size):.3g}" + (f" {self.unit}" if self.unit not in ("", "1") else "")

    def __str__(self) -> str:
        """One line for the terminal."""
        what = "seen" if self.size is None else f"seen from a size of {self._with_unit(self.size)}"
        percent = 100 * self.relative
        if percent and self.value != 1:
            what += f", {percent:{'.0f' if percent >= 1 else '.2g'}}% of the {self.compared}"
        if self.share < SHARE:
            up_to = "" if self.largest is None else f" up to {self._with_unit(self.largest)}"
            what = f"not seen{up_to}"
        return f"{self.fault}: {what} ({self.share:.0%} within {duration(self.within)})"
