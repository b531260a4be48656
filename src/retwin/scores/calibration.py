"""Calibration of class probabilities: expected calibration error and reliability diagrams."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BINS = 10
"""Bins of equal mass of the expected calibration error."""
PER_BIN = 5
"""Trajectories per bin of a reliability diagram, at least."""
DRAWS = 1000
"""Perfectly calibrated classifiers that are drawn for the consistency bars."""


@dataclass(frozen=True)
class Reliability:
    """Diagnoses in bins of equal mass by their confidence, means over runs.

    Attributes
    ----------
    confidence, accuracy : array (bins,)
        Mean confidence and share of correct diagnoses of each bin.
    low, high : array (bins,)
        The central 90 % of that share for perfectly calibrated classifiers with the same
        confidences on as few trajectories (consistency bars).

    References
    ----------
    Bröcker and Smith, Increasing the reliability of reliability diagrams, Weather and Forecasting
    2007.

    """

    confidence: NDArray
    accuracy: NDArray
    low: NDArray
    high: NDArray


def calibration_error(happened: NDArray, probability: NDArray) -> float:
    """Expected calibration error over `BINS` bins of equal mass.

    Parameters
    ----------
    happened : array (n,)
        Whether each event occurred.
    probability : array (n,)
        The predicted probability of each event.

    Returns
    -------
    float
        The mean absolute difference of mean probability and frequency per bin, in [0, 1]. Events of
        equal probability share their frequency, so that the order of the events has no effect.

    """
    order = np.argsort(probability, kind="stable")
    confidence = probability[order]
    frequency = _shared_frequency(happened[order], confidence)
    return float(_binned_error(frequency, confidence))


def _shared_frequency(happened: NDArray, probability: NDArray) -> NDArray:
    """Mean (..., n) of what happened (..., n) over the events of equal, sorted probability (n,)."""
    _, begins, counts = np.unique(probability, return_index=True, return_counts=True)
    sums = np.add.reduceat(np.asarray(happened, dtype=float), begins, axis=-1)
    return np.repeat(sums / counts, counts, axis=-1)


def _binned_error(frequency: NDArray, probability: NDArray) -> NDArray:
    """Calibration error (...) of frequencies (..., n) of events of sorted probability (n,)."""
    difference = frequency - probability
    bins = np.array_split(np.arange(len(probability)), min(BINS, len(probability)))
    errors: NDArray = np.sum([np.abs(difference[..., part].sum(axis=-1)) for part in bins], axis=0)
    return errors / len(probability)


def calibration_floor(probabilities: NDArray, *, draws: int = 200) -> float:
    """Mean top-label calibration error of a perfectly calibrated classifier.

    Parameters
    ----------
    probabilities : array (runs, n, classes)
        The classifier's confidences are the largest probability of each trajectory; whether each
        diagnosis is correct is drawn with its confidence as the probability.
    draws : int
        Classifiers that are drawn.

    Returns
    -------
    float
        The error that comes from the finite number of trajectories alone. It depends on the
        confidences: about √(20 c (1 - c) / (π n)) for n trajectories of about the confidence c.

    """
    rng = np.random.default_rng(0)
    floors = []
    for confidence in np.sort(probabilities.max(axis=2), axis=1):
        correct = rng.random((draws, len(confidence))) < confidence
        floors.append(_binned_error(_shared_frequency(correct, confidence), confidence).mean())
    return float(np.mean(floors))


def reliability(probabilities: NDArray, truth: NDArray) -> Reliability:
    """The reliability diagram of predicted probabilities.

    Parameters
    ----------
    probabilities : array (runs, n, classes)
        Predicted probabilities.
    truth : array (n,)
        True class indices.

    Notes
    -----
    All runs diagnose the same trajectories, so a drawn classifier has one uniform number per
    trajectory in all runs; numbers of their own would make the bars too narrow.

    """
    uniform = np.random.default_rng(0).random((DRAWS, len(truth)))
    bins = max(1, min(BINS, len(truth) // PER_BIN))
    confidence, accuracy, drawn = [], [], []
    for run in probabilities:
        order = np.argsort(run.max(axis=1), kind="stable")
        top, parts = run.max(axis=1)[order], np.array_split(np.arange(len(truth)), bins)
        correct = _shared_frequency((run.argmax(axis=1) == truth)[order], top)
        perfect = _shared_frequency(uniform[:, order] < top, top)
        confidence.append([top[part].mean() for part in parts])
        accuracy.append([correct[part].mean() for part in parts])
        drawn.append([perfect[:, part].mean(axis=1) for part in parts])
    low, high = np.quantile(np.mean(drawn, axis=0), [0.05, 0.95], axis=1)
    return Reliability(np.mean(confidence, axis=0), np.mean(accuracy, axis=0), low, high)
