"""`TrajectoryState`: what a monitor of trajectories remembers of one machine, as arrays to keep."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.checks import instance, require
from retwin.monitor.detect.detector import DetectorState
from retwin.monitor.detect.validity import ValidityState
from retwin.monitor.models.monitor_state import arrays_of, part_of
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
