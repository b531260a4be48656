"""Predictive models of a monitor: the twin, following what is measured more or less closely.

No single model of the noise shows every fault. A filter that follows the machine within a few
samples takes a sensor's offset for a change of the state, and an actuator without effect for a
disturbance; one that hardly follows keeps predicting what the equations give, but is slow to
forget what they do not describe. Evidence of all is averaged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from retwin.checks import finite
from retwin.monitor.detect.detector import Detector
from retwin.monitor.detect.slack import Slack
from retwin.update.dynamics.filter.online import FilterState, OnlineFilter
from retwin.update.dynamics.filter.prediction import root_of, whitened
from retwin.update.dynamics.twin import DynamicsTwin

SLOWER = (1e-4, 1e-3, 1e-2, 1e-1)
"""Factors of the variance of the process noise of the second model, of which the first is taken
that describes the calibration: with the smallest its filter needs about a hundred times as long to
follow. Not 0: states that integrate would drift away for ever."""

IMPLAUSIBLE = 100.0
"""Ranges of a command in calibration by which it may leave that range. What is farther away stands
for a missing one, such as 1e9 or 3.4e38; a filter that took it for real would predict nothing until
the states have decayed from there."""
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
    effect : float
        By how many posterior deviations machines differ from the twin; see `OnlineFilter`.

    """

    process: float = 1.0
    warm_up: float = 0.0
    effect: float = 0.0

    def __post_init__(self) -> None:
        for name in ("process", "warm_up", "effect"):
            finite(name, getattr(self, name), at_least=0.0)

    def filter(self, twin: DynamicsTwin) -> OnlineFilter:
        """Its filter."""
        if self.process == 1:
            return OnlineFilter(twin, self.effect)
        process, proportional = (each * self.process for each in (twin.process, twin.proportional))
        slower = replace(twin, process=process, proportional=proportional)
        return OnlineFilter(slower, self.effect)

    def used(self, samples: NDArray, steps: int, rate: float) -> NDArray:
        """Whether evidence of the next samples (n, steps) is used, after so many before (n,)."""
        return samples[:, None] + np.arange(steps) >= round(self.warm_up * rate)


def span_of(twin: DynamicsTwin) -> NDArray:
    """The range (d_u,) of each command in calibration; infinite where it has none."""
    low, high = (each[len(twin.process) :] for each in (twin.domain.low, twin.domain.high))
    return np.where(high > low, high - low, np.inf)


def implausible(twin: DynamicsTwin, commands: NDArray) -> NDArray:
    """Whether commands (n, T, d_u) are so far from those of the calibration."""
    low, high = (each[len(twin.process) :] for each in (twin.domain.low, twin.domain.high))
    largest = np.maximum(high - low, np.maximum(np.abs(low), np.abs(high)))
    far = IMPLAUSIBLE * np.where(largest > 0, largest, np.inf)
    return np.isfinite(commands) & ((commands < low - far) | (commands > high + far))


def standardised(
    error: NDArray, covariance: NDArray, seen: NDArray, steps: NDArray
) -> tuple[NDArray, NDArray]:
    """Independent errors (n, T, d_y) of variance 1, and widths of their rounding intervals.

    Errors are NaN where a sample is not seen.
    """
    factor = root_of(covariance, seen)
    made = np.where(seen, whitened(error, factor, seen), np.nan)
    return made, steps / np.diagonal(factor, axis1=2, axis2=3)


def settled(online: OnlineFilter, count: int, given: tuple[NDArray, ...]) -> int:
    """Number of samples after which the start of the filter does not matter.

    `given` are commands, outputs and masks of so many records; 0 is returned where the start never
    mattered, and at most half of the samples count.
    """
    start = online.start(count)
    own, other = (
        np.diagonal(online.step(each, *given)[2], axis1=2, axis2=3)
        for each in (start, replace(start, spread=start.spread / 4))
    )
    ratio = own / other
    # Where nothing is measured, as after the end of a shorter record, nothing is known better.
    # Ratio of predicted standard deviations, for starts of which one is twice as uncertain, up to
    # which the filter knows the states of a machine that it did not see start.
    differs = ((np.abs(np.log(ratio)) > 2 * np.log(1.05)) & given[2]).any(axis=(0, 2))
    differs = differs[: own.shape[1] // 2]
    return int(np.flatnonzero(differs)[-1]) + 1 if differs.any() else 0


Scored: TypeAlias = tuple[NDArray, NDArray]
"""Lower and upper ends of scores (streams, T)."""


def agreeing(
    slacks: tuple[Slack, ...], parts: Sequence[Scored], alpha: float = 0.05
) -> tuple[Slack, ...]:
    """Slacks that are widened until the calibration itself does not contradict them.

    Within the class, the evidence of a detector reaches n / alpha in n samples with a probability
    of at most alpha, and the product of an alternative's bets over any number of successive samples
    has a mean of at most 1. Held-out errors of the calibration for which that is not so, since they
    are more dependent than their number of parameters lets expect, or their variance clusters, or
    they are another day's, are not of that class.

    Parameters
    ----------
    slacks : tuple of Slack
        One for each stream.
    parts : sequence of tuple of ndarray
        Scores of parts of the calibration, each left out of what they were ranked among.
    alpha : float
        Probability with which the evidence widens where it is not needed, for each stream.

    """
    made = list(slacks)
    wrong = list(range(len(slacks)))
    for factor in (None, *WIDER):
        for i in wrong if factor is not None else ():
            made[i] = slacks[i].wider(float(factor))
        detector, above = Detector([made[i] for i in wrong]), np.zeros(len(wrong), dtype=bool)
        for low, high in parts:
            limit = np.isfinite(low[wrong]).sum(axis=1) * len(parts) / alpha
            _, evidence = detector.run(detector.start(len(wrong)), low[wrong], high[wrong])
            above |= evidence.max(axis=1) >= np.maximum(limit, 1.0)
        above |= _bets_win(detector, [(low[wrong], high[wrong]) for low, high in parts])
        wrong = [i for i, each in zip(wrong, above, strict=True) if each]
        if not wrong:
            break
    return tuple(made)


def _bets_win(detector: Detector, parts: Sequence[Scored], *, windows: int = 16) -> NDArray:
    """Streams with an alternative whose bets over successive samples have a mean product above 1.

    All lengths that the parts contain `windows` times are tried, in powers of two.

    Parameters
    ----------
    windows : int, default 16
        Windows of successive samples that the calibration contains at least, for their mean
        product.

    """
    first = np.zeros(len(detector.which))
    logs = []
    for low, high in parts:
        factors = detector.factors(first, *detector.intervals(first, low, high))
        logs.append(np.cumsum(np.log([factor for factor, _, _ in factors]), axis=0))
    made = np.zeros(len(first), dtype=bool)
    length, longest = 1, sum(len(each) for each in logs) // windows
    while length <= longest:
        products = [np.exp(each[length:] - each[:-length]) for each in logs]
        made |= (np.concatenate(products).mean(axis=0) > 1 + 1e-9).any(axis=0)
        length *= 2
    return made


def finite_state(online: OnlineFilter, state: FilterState) -> FilterState:
    """The state of a filter, begun anew where it is not finite."""
    kept = np.isfinite(state.states).all(axis=(1, 2)) & np.isfinite(state.root).all(axis=(1, 2))
    kept &= np.isfinite(state.spread).all(axis=(1, 2, 3))
    lost = np.flatnonzero(~kept)
    if not len(lost):
        return state
    return state.merged(lost, replace(online.start(len(lost)), commands=state.commands[lost]))


def by_stream(values: NDArray) -> NDArray:
    """(n * d_y, T) of (n, T, d_y)."""
    return np.moveaxis(values, 2, 1).reshape(-1, values.shape[1])
