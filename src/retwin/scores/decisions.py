"""Alarm thresholds with a guaranteed false-alarm rate, and what they detect and cost."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr, betainc, betaincinv

from retwin.data.trajectories import HEALTHY
from retwin.scores.intervals import share_interval

TAIL = 0.025
"""The probability beyond each end of an interval."""


@dataclass(frozen=True)
class Cost:
    """Expected number of false alarms and of missed faults, and their cost in false alarms."""

    false_alarms: float
    missed_faults: float
    total: float


@dataclass(frozen=True)
class Decision:
    """The rule that an alarm is raised where the probability of a fault exceeds `threshold`.

    Attributes
    ----------
    requested : float
        The requested false-alarm rate, in [0, 1].
    guaranteed : float
        The false-alarm rate that the threshold guarantees: the largest multiple of 1 / (healthy
        trajectories + 1) that is not above `requested`.
    threshold : float
        NaN where there are too few healthy trajectories to guarantee the rate.
    detected : float
        Share of faulty trajectories that raise an alarm.
    interval : (float, float)
        Its 95 % interval for this threshold (Clopper and Pearson).
    at_rate : (float, float)
        The 95 % interval of the share that would be detected at exactly the requested rate. It is
        wider, since the healthy trajectories show only about where the threshold of that rate is.
    false_alarms : (float, float)
        The central 95 % of the false-alarm rate of such a threshold over sets of healthy
        trajectories; on average it is `guaranteed`.
    identified : float
        Share of these whose fault is diagnosed correctly.
    most_missed : str
        The class that is missed most often; "" for none.
    most_confused : (str, str)
        The class and the diagnosis that are confused most often among alarms; () for none.

    """

    requested: float
    guaranteed: float
    threshold: float
    detected: float
    interval: tuple[float, float]
    at_rate: tuple[float, float]
    false_alarms: tuple[float, float]
    identified: float
    most_missed: str
    most_confused: tuple[str, str] | tuple[()]

    def cost(self, *, trajectories: int, faulty: float, missed: float) -> Cost:
        """The expected cost of so many trajectories.

        Parameters
        ----------
        trajectories : int
            Their number.
        faulty : float
            The share of faulty ones, in [0, 1].
        missed : float
            The cost of a missed fault, in false alarms.

        """
        alarms = self.guaranteed * trajectories * (1 - faulty)
        misses = (1 - self.detected) * trajectories * faulty
        return Cost(alarms, misses, alarms + missed * misses)


def decide(probabilities: NDArray, truth: NDArray, classes: list[str], rate: float) -> Decision:
    """The threshold for a false-alarm rate, and what it detects.

    Parameters
    ----------
    probabilities : array (n, classes)
        Predicted probabilities of one model: the mean over several has other thresholds.
    truth : array (n,)
        True class indices.
    classes : list of str
        Their names, one of which is "Healthy".
    rate : float
        The requested false-alarm rate, in [0, 1].

    Notes
    -----
    The threshold comes from the healthy trajectories alone, by split conformal prediction, so that
    the rate holds on average for further healthy ones. What is detected is counted on the faulty
    ones.

    """
    healthy = classes.index(HEALTHY)
    fault = 1 - probabilities[:, healthy]
    reference = np.sort(fault[truth == healthy])
    rank = math.ceil((1 - rate) * (len(reference) + 1) - 1e-9)
    faulty = truth != healthy
    if rank > len(reference) or not faulty.any():
        none = (math.nan, math.nan)
        return Decision(rate, 0.0, math.nan, math.nan, none, none, none, math.nan, "", ())
    # An alarm needs more than the threshold, so the trajectory that sets it raises none.
    threshold = float(reference[rank - 1]) if rank else -math.inf
    raised = faulty & (fault > threshold)
    others = np.delete(np.arange(len(classes)), healthy)
    diagnosis = others[probabilities[:, others].argmax(axis=1)]
    missed = np.bincount(truth[faulty & ~raised], minlength=len(classes))
    wrong = raised & (diagnosis != truth)
    pairs = np.bincount(truth[wrong] * len(classes) + diagnosis[wrong], minlength=len(classes) ** 2)
    true, answer = divmod(int(pairs.argmax()), len(classes))
    return Decision(
        requested=rate,
        guaranteed=1 - rank / (len(reference) + 1),
        threshold=threshold,
        detected=float(raised.sum() / faulty.sum()),
        interval=share_interval(int(raised.sum()), int(faulty.sum())),
        at_rate=_at_rate(reference, fault[faulty], rate),
        false_alarms=_false_alarms(rank, len(reference)),
        identified=float((diagnosis == truth)[raised].mean()) if raised.any() else math.nan,
        most_missed=classes[int(missed.argmax())] if missed.any() else "",
        most_confused=(classes[true], classes[answer]) if pairs.any() else (),
    )


def healthy_needed(rate: float) -> int:
    """The number of healthy trajectories from which on a false-alarm rate is certain.

    From so many on there is a threshold, the largest of their values, whose false-alarm rate is
    at most `rate` with a probability of 97.5 %.

    Parameters
    ----------
    rate : float
        The false-alarm rate, in (0, 1).

    """
    return math.ceil(math.log(TAIL) / math.log1p(-rate) - 1e-9)


def certain_decision(
    probabilities: NDArray, truth: NDArray, classes: list[str], rate: float
) -> Decision | None:
    """The threshold that detects most while its false-alarm rate is certainly at most `rate`.

    Parameters
    ----------
    probabilities, truth, classes
        See `decide`.
    rate : float
        The false-alarm rate that the upper end of the interval must not exceed, in (0, 1).

    Returns
    -------
    Decision or None
        None for fewer healthy trajectories than `healthy_needed`.

    """
    n = int((truth == classes.index(HEALTHY)).sum())
    if n < healthy_needed(rate):
        return None
    rank = min(r for r in range(1, n + 1) if _false_alarms(r, n)[1] <= rate * (1 + 1e-9))
    return decide(probabilities, truth, classes, (n + 1 - rank) / (n + 1))


def _false_alarms(rank: int, n: int) -> tuple[float, float]:
    """Central 95 % of the false-alarm rate of the threshold at that rank of n healthy ones."""
    if rank == 0:
        return 1.0, 1.0
    low, high = betaincinv(n + 1 - rank, rank, [TAIL, 1 - TAIL])
    return float(low), float(high)


def _at_rate(reference: NDArray, faulty: NDArray, rate: float) -> tuple[float, float]:
    """Interval of the share of faulty trajectories that is detected at the false-alarm rate.

    The number of n healthy values below the threshold of the rate is binomial (n, 1 - rate), so
    that this threshold lies between two neighbours among them. The ends mix the distributions of
    Clopper and Pearson over these intervals: at their upper neighbour for the lower end, at their
    lower one for the upper end.

    Parameters
    ----------
    reference : array (n,)
        Probabilities of a fault of the healthy trajectories, increasing.
    faulty : array (m,)
        The same of the faulty ones.
    rate : float
        The false-alarm rate.

    """
    from scipy.optimize import brentq

    n, m = len(reference), len(faulty)
    weights = np.diff(bdtr(np.arange(n + 1), n, 1 - rate), prepend=0.0)
    found = (faulty > reference[:, None]).sum(axis=1)
    fewest, most = np.append(found, 0), np.insert(found, 0, m)

    def below(share: float, hits: NDArray, more: int) -> float:
        """Probability that the detected share is at most `share`, in (0, 1)."""
        a, b = hits + more, m - hits + 1 - more
        inside = betainc(np.maximum(a, 1), np.maximum(b, 1), share)
        return float(weights @ np.where(a == 0, 1.0, np.where(b == 0, 0.0, inside)))

    def end(hits: NDArray, more: int, level: float) -> float:
        low, high = below(0.0, hits, more), 1 - weights[m - hits + 1 - more == 0].sum()
        if low >= level:
            return 0.0
        if high <= level:
            return 1.0
        return float(brentq(lambda share: below(share, hits, more) - level, 0.0, 1.0))

    return end(fewest, 0, 0.025), end(most, 1, 0.975)
