"""What a monitor of trajectories remembers of one machine, as arrays to keep, and what it found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.checks import instance, require
from retwin.monitor.detect.detector import DetectorState
from retwin.monitor.detect.validity import ValidityState
from retwin.monitor.models.state import arrays_of, part_of
from retwin.serialisation.files import refusing


@dataclass(frozen=True, eq=False)
class TrajectoryState:
    """What a monitor remembers of the trajectories of one machine.

    Attributes
    ----------
    evidence : NDArray
        (F,), that of each fault, and of `unknown` where the diagnoser has a model of it.
    pooled : NDArray
        (B, S), that of S sizes of each bias of an actuator, from its offsets.
    detector, validity
        Of the errors that the healthy machine leaves unexplained.
    count : int
        Trajectories so far.

    """

    evidence: NDArray
    pooled: NDArray
    detector: DetectorState
    validity: ValidityState
    count: int = 0

    def arrays(self) -> dict[str, NDArray]:
        """All of it as arrays by name, from which `of_arrays` makes the same again."""
        made = {"evidence": self.evidence, "pooled": self.pooled, "count": np.array([self.count])}
        return made | arrays_of("detector", self.detector) | arrays_of("validity", self.validity)

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray]) -> TrajectoryState:
        """The state of arrays; InputError if they are of none."""
        with refusing("state", expected="the arrays of a state", remedy="begin with no state"):
            return cls(
                np.asarray(arrays["evidence"]),
                np.asarray(arrays["pooled"]),
                part_of(DetectorState, "detector", arrays),
                part_of(ValidityState, "validity", arrays),
                int(arrays["count"][0]),
            )

    def checked(self, first: TrajectoryState) -> TrajectoryState:
        """The same, if it has the shapes of `first`; else InputError."""
        remedy = "continue with the monitor that made it, or begin with no state"
        instance("state", self, TrajectoryState, remedy=remedy)
        own, other = ({n: e.shape for n, e in s.arrays().items()} for s in (self, first))
        require(
            own == other,
            "state",
            expected=f"one of this monitor, with evidence for {len(first.evidence)} causes",
            got=f"one with evidence for {len(self.evidence)}",
            remedy=remedy,
        )
        return self


REMARKS = {
    "unmeasured": "without measured samples, which are no evidence",
    "unranked": "measured otherwise than in the calibration, in which only faults of the diagnoser "
    "would be found",
    "implausible": "with readings that no healthy machine can have caused",
    "outside": "with commands outside their range in training, where the twin extrapolates",
}
"""What a trajectory is that is not used as usual, by the attribute that states it."""


@dataclass(frozen=True)
class TrajectoryAlarm:
    """A change that a monitor of trajectories has found.

    Attributes
    ----------
    trajectory : str
        The id of the trajectory after which the alarm was raised.
    number : int
        How many trajectories were watched before it.
    name : str
        The fault with most evidence since the last alarm, or "unknown": a change that no fault
        explains. Of faults with equal evidence, the first of the diagnoser.
    evidence : float
        At least the average run length of the promise.
    probability : float
        The share of that name in the evidence for all causes, which states whether others have as
        much; see `shares`.
    shares : dict of str to float
        The share of each cause of at least 0.01, the largest first.
    outside : bool
        Whether the commands of the trajectory leave their range in training, which no promise
        covers.

    """

    trajectory: str
    number: int
    name: str
    evidence: float
    probability: float
    shares: dict[str, float]
    outside: bool


@dataclass(frozen=True, eq=False)
class WatchedTrajectories:
    """What a monitor found in n trajectories.

    Attributes
    ----------
    score : NDArray
        (n,), of what the healthy machine leaves unexplained: standard Gaussian if it is healthy,
        NaN where it is not ranked.
    evidence : NDArray
        (n,), that of a change; an alarm is raised from the average run length on.
    void, outside : NDArray
        (n,) bool, whether the promise does not apply any more, and whether the commands of the
        trajectory leave their range in training, where the twin extrapolates.
    unmeasured : NDArray
        (n,) bool, nothing was measured: it is no evidence, and counts for no promise.
    unranked : NDArray
        (n,) bool, some output has fewer or more measured values than in the calibration, because
        it is missing or the trajectory has another length: what the healthy machine leaves
        unexplained cannot be compared with the calibration, and only faults of the diagnoser are
        found.
    implausible : NDArray
        (n,) bool, readings that no healthy machine can have caused: they count as the largest
        error, and as evidence for none of the faults.
    alarms : list of TrajectoryAlarm
        The alarms.

    """

    score: NDArray
    evidence: NDArray
    void: NDArray
    outside: NDArray
    unmeasured: NDArray
    unranked: NDArray
    implausible: NDArray
    alarms: list[TrajectoryAlarm]

    @property
    def remarks(self) -> list[str]:
        """How many trajectories were not used as usual, and why; none if all were."""
        counts = {name: int(getattr(self, name).sum()) for name in REMARKS}
        return [f"{each} {REMARKS[name]}" for name, each in counts.items() if each]
