"""What a monitor found in the samples of machines: alarms, predictions and evidence."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import NDArray


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

    """

    trajectory: str
    sample: int
    time: float
    output: str
    change: str
    evidence: float


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
    alarm, void : NDArray
        (n, T) bool, whether an alarm was raised, and whether the promise does not apply.
    outside : NDArray
        (n,) bool, whether commands leave the range that they had when the twin was calibrated.
    alarms : list of Alarm
        The alarms.

    """

    mean: NDArray
    deviation: NDArray
    score: NDArray
    evidence: NDArray
    alarm: NDArray
    void: NDArray
    outside: NDArray
    alarms: list[Alarm]
