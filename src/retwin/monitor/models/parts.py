"""What a monitor works with: its models for so many machines, and what it finds in some samples."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from retwin.monitor.detect.detector import Detector
from retwin.monitor.detect.disturbance import Disturbance
from retwin.monitor.detect.validity import Validity
from retwin.monitor.models.monitor_state import MonitorState
from retwin.monitor.models.saved import DISTURBANCE


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


@dataclass(frozen=True, eq=False)
class Streams:
    """The parts of a monitor for the outputs of so many machines."""

    disturbance: Disturbance
    detector: Detector
    validity: Validity

    @classmethod
    def of(cls, known: Disturbance, validity: Validity, count: int) -> Streams:
        """Those of so many machines, from those of one."""
        repeated = {name: np.concatenate([getattr(known, name)] * count) for name in DISTURBANCE}
        detector = Detector(tuple(validity.detector.slack) * count)  # type: ignore[arg-type]
        return cls(replace(known, **repeated), detector, replace(validity, detector=detector))
