"""Predictive models of a monitor: the twin, following what is measured more or less closely.

No single model of the noise shows every fault. A filter that follows the machine within a few
samples takes a sensor's offset for a change of the state, and an actuator without effect for a
disturbance; one that hardly follows keeps predicting what the equations give, but is slow to
forget what they do not describe. Evidence of all is averaged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from retwin.checks import finite
from retwin.monitor.detector import Detector
from retwin.monitor.slack import Slack
from retwin.update.dynamics.online import FilterState, OnlineFilter
from retwin.update.dynamics.prediction import root_of, whitened
from retwin.update.dynamics.twin import DynamicsTwin

SLOWER = 1e-4
"""Factor of the variance of the process noise of the second model, whose filter needs about a
hundred times as long to follow. Not 0: states that integrate would drift away for ever."""
SETTLED = 1.05
"""Ratio of predicted standard deviations, for starts of which one is twice as uncertain, up to
which the filter knows the states of a machine that it did not see start."""
WIDER = 1.25 ** np.arange(1, 17)
"""Factors of the slack of which the first is taken with which the calibration agrees."""


@dataclass(frozen=True)
class Predictor:
    """One of the predictive models of a monitor.

    Attributes
    ----------
    process : float
        Factor of the variance of the twin's process noise: 1 is the twin as it was fitted, and less
        follows what is measured more slowly.
    warm_up : float
        Time in s after the first sample in which its evidence is not counted: states are unknown.

    """

    process: float = 1.0
    warm_up: float = 0.0

    def __post_init__(self) -> None:
        finite("process", self.process, least=0.0)
        finite("warm_up", self.warm_up, least=0.0)

    def filter(self, twin: DynamicsTwin) -> OnlineFilter:
        """Its filter."""
        if self.process == 1:
            return OnlineFilter(twin)
        process, proportional = (each * self.process for each in (twin.process, twin.proportional))
        return OnlineFilter(replace(twin, process=process, proportional=proportional))

    def used(self, samples: NDArray, steps: int, rate: float) -> NDArray:
        """Whether evidence of the next samples (n, steps) is used, after so many before (n,)."""
        return samples[:, None] + np.arange(steps) >= round(self.warm_up * rate)


def standardised(
    error: NDArray, covariance: NDArray, seen: NDArray, steps: NDArray
) -> tuple[NDArray, NDArray]:
    """Independent errors (n, T, d_y) of variance 1, and widths of their rounding intervals.

    Errors are NaN where a sample is not seen.
    """
    factor = root_of(covariance, seen)
    made = np.where(seen, whitened(error, factor, seen), np.nan)
    return made, steps / np.diagonal(factor, axis1=2, axis2=3)


def settled(
    online: OnlineFilter, start: FilterState, given: tuple[NDArray, ...], covariance: NDArray
) -> int:
    """Number of samples after which the start of the filter does not matter.

    `covariance` (n, T, d_y, d_y) is that of its predictions of the samples `given`; 0 is returned
    where the start never mattered, and at most half of the samples count.
    """
    certain = replace(start, spread=start.spread / 4)
    other = online.step(certain, *given)[2]
    ratio = np.diagonal(covariance / other, axis1=2, axis2=3)
    differs = (np.abs(np.log(ratio)) > 2 * np.log(SETTLED)).any(axis=(0, 2))
    differs = differs[: covariance.shape[1] // 2]
    return int(np.flatnonzero(differs)[-1]) + 1 if differs.any() else 0


def agreeing(
    slacks: tuple[Slack, ...], low: NDArray, high: NDArray, alpha: float = 0.05
) -> tuple[Slack, ...]:
    """Slacks that are widened until the calibration itself does not contradict them.

    Within the class, the evidence of a detector reaches n / alpha in n samples with a probability
    of at most alpha. Held-out errors of the calibration that reach it, since they are more
    dependent than their number of parameters lets expect, are not of that class.

    Parameters
    ----------
    slacks : tuple of Slack
        One for each stream.
    low, high : ndarray, shape (streams, T)
        Held-out scores of the calibration; NaN is missing.
    alpha : float
        Probability of widening where it is not needed.

    """
    made = list(slacks)
    wrong, limit = list(range(len(slacks))), np.isfinite(low).sum(axis=1) / alpha
    for factor in WIDER:
        detector = Detector([made[i] for i in wrong])
        _, evidence = detector.run(detector.start(len(wrong)), low[wrong], high[wrong])
        above = evidence.max(axis=1) >= limit[wrong]
        wrong = [i for i, each in zip(wrong, above, strict=True) if each]
        if not wrong:
            break
        for i in wrong:
            made[i] = slacks[i].wider(float(factor))
    return tuple(made)
