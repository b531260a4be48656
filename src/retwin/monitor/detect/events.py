"""Events: from the first alarm until the twin follows the machine again.

An alarm has no end, but a fault and what it leaves behind do. The first alarm opens an event, and
those that follow belong to it. With each alarm filter and detector begin anew, since the states of
the machine are not what was predicted. The event ends when the detector, since it began anew, has
seen as many samples as show a shift by one standard deviation, has no evidence against them, and
has evidence that the change of the newest alarm is over. A small change, which is seen slowly, so
needs more samples to end than a large one. An event that lasts longer than a stated time is a
change: the machine of now is followed from there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FOLLOWS = "the twin follows again: the fault is over, or does not show now"
"""How an event ends where the predictions agree with the machine again."""
CHANGED = "changed"
"""How an event ends that lasts: the machine is followed from where it is now."""
CERTAIN = 0.05
"""Probability of more evidence than samples over this: for a change in a healthy machine, and for a
healthy machine while the change lasts."""


@dataclass(frozen=True)
class Course:
    """Where each of n machines is.

    Attributes
    ----------
    samples : NDArray
        (n,), samples since the start.
    begun : NDArray
        (n,), number of the sample at which filter and detector began anew.
    event : NDArray
        (n,), number of the first alarm's sample of the event that lasts; -1 for none.
    quiet : NDArray
        (n,), samples of which evidence was counted since the detector began anew.
    change : NDArray
        (n, 2), stream and number of the alternative of the newest alarm.
    end_evidence : NDArray
        (n,), evidence that this change is over, see `Detector.evidence_of_end`.

    """

    samples: NDArray
    begun: NDArray
    event: NDArray
    quiet: NDArray
    change: NDArray
    end_evidence: NDArray

    @classmethod
    def start(cls, count: int) -> Course:
        """Before the first sample."""
        zeros = np.zeros(count, dtype=np.int64)
        return cls(
            zeros, zeros, zeros - 1, zeros, np.zeros((count, 2), dtype=np.int64), zeros + 1.0
        )


@dataclass(frozen=True)
class Rules:
    """When events begin and end.

    Parameters
    ----------
    arl : float
        Evidence from which on an alarm is raised.
    wanted : int
        Samples with evidence that an event needs to end.
    lasting : int
        Samples after which an event is a change.

    """

    arl: float
    wanted: int
    lasting: int

    @classmethod
    def of(cls, arl: float, lasting: int) -> Rules:
        """Those of an average run length: a shift by one is seen in 2 log(ARL) samples."""
        return cls(arl, int(np.ceil(2 * np.log(arl))), lasting)

    def alarms(self, evidence: NDArray) -> NDArray:
        """Where an alarm is raised."""
        return np.asarray(evidence >= self.arl)

    def ends(
        self, course: Course, evidence: NDArray, end_evidence: NDArray, counted: NDArray
    ) -> NDArray:
        """Where (n, T) an event ends, for machines that began a part with `course`."""
        quiet = course.quiet[:, None] + np.cumsum(counted, axis=1)
        calm = (
            (quiet >= self.wanted)
            & (evidence * CERTAIN < quiet)
            & (end_evidence * CERTAIN >= quiet)
        )
        return np.asarray((course.event >= 0)[:, None] & calm & counted)

    def changes(self, course: Course, steps: int) -> NDArray:
        """Where (n, T) an event has lasted for so long that it is a change."""
        age = course.samples[:, None] + np.arange(steps) - course.event[:, None]
        return np.asarray((course.event >= 0)[:, None] & (age >= self.lasting))

    def after(
        self,
        course: Course,
        counted: NDArray,
        alarm: NDArray,
        ended: NDArray,
        changed: NDArray,
        change: NDArray,
        end_evidence: NDArray,
    ) -> Course:
        """The course after a part of T samples.

        `counted` is (n, T); an alarm, an end and a change of the machine (n,) are those of its last
        sample, and so is what an alarm is for, `change` (n, 2), and `end_evidence` (n,).
        """
        last = course.samples + counted.shape[1] - 1
        opened = np.where(alarm & (course.event < 0), last, course.event)
        anew = alarm | ended | changed
        return Course(
            last + 1,
            np.where(alarm | changed, last + 1, course.begun),
            np.where(ended | changed, -1, opened),
            np.where(anew, 0, course.quiet + counted.sum(axis=1)),
            np.where(alarm[:, None], change, course.change),
            np.where(anew, 1.0, end_evidence),
        )
