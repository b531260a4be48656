"""Alarm thresholds with a guaranteed false-alarm rate, and what they detect and cost."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import HEALTHY
from retwin.scores.intervals import share_interval

__all__ = ["Cost", "Decision", "decide"]


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
        Its 95 % interval (Clopper and Pearson).
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
        Predicted probabilities.
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
        return Decision(rate, 0.0, math.nan, math.nan, (math.nan, math.nan), math.nan, "", ())
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
        identified=float((diagnosis == truth)[raised].mean()) if raised.any() else math.nan,
        most_missed=classes[int(missed.argmax())] if missed.any() else "",
        most_confused=(classes[true], classes[answer]) if pairs.any() else (),
    )
