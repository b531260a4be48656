"""Scores of class probabilities: accuracy, F1, recall, areas under ROC curves, confusions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from retwin.checks import one_of
from retwin.data.trajectories import HEALTHY
from retwin.scores.calibration import calibration_error


@dataclass(frozen=True)
class Scores:
    """Scores of the diagnoses of labelled trajectories; NaN where a score is not defined.

    Attributes
    ----------
    accuracy : float
        Share of correct diagnoses.
    macro_f1 : float
        F1 averaged over the classes that occur.
    balanced_accuracy : float
        Recall averaged over the classes that occur.
    auroc : float
        One-vs-rest area under the ROC curve, averaged over the classes that occur.
    auroc_micro : float
        The same over all pairs of trajectory and class (the paper's figure 4).
    healthy_recall : float
        Share of healthy trajectories that are recognised.
    ece : float
        Expected calibration error of the top label, 10 bins of equal mass; its noise floor depends
        on the number of trajectories and their confidence, see
        `retwin.scores.calibration.calibration_floor`.
    ece_classwise : float
        The expected calibration error of each class's probability, averaged over all classes, 10
        bins of equal mass each. It detects a class whose probability is always too low, which the
        top label does not show. Most of k probabilities are near 0, so it is smaller than `ece` by
        a factor of about k / 2.
    n : int
        Trajectories.

    References
    ----------
    Kull et al., Beyond temperature scaling, NeurIPS 2019 (class-wise calibration). Nixon et al.,
    Measuring calibration in deep learning, CVPR workshops 2019 (bins of equal mass).

    """

    accuracy: float
    macro_f1: float
    balanced_accuracy: float
    auroc: float
    auroc_micro: float
    healthy_recall: float
    ece: float
    ece_classwise: float
    n: int

    def __str__(self) -> str:
        found = {name: getattr(self, name) for name in METRICS}
        values = ", ".join(
            f"{name} {each:.3f}" if np.isfinite(each) else f"{name} undefined"
            for name, each in found.items()
        )
        return f"{values} ({self.n} trajectories)"


METRICS = tuple(each.name for each in fields(Scores) if each.name != "n")
"""The names of the scores of diagnoses, as in `retwin.catalog.METRICS`."""


def score(truth: NDArray, probabilities: NDArray, classes: Sequence[str]) -> Scores:
    """All scores of predicted probabilities.

    Parameters
    ----------
    truth : array (n,)
        True class indices.
    probabilities : array (n, classes)
        Predicted probabilities.
    classes : sequence of str
        The names of the classes; "Healthy" is the one whose recall is a score of its own.

    Returns
    -------
    Scores
        NaN where a score is not defined.

    """
    weights = np.ones((1, len(truth)))
    each = {
        name: float(weighted_score(name, truth, probabilities, weights, classes)[0])
        for name in METRICS
        if not name.startswith("ece")
    }
    top = probabilities.argmax(axis=1) == truth
    hits = np.arange(len(classes)) == truth[:, None]
    by_class = [calibration_error(hits[:, k], probabilities[:, k]) for k in range(len(classes))]
    return Scores(
        **each,
        ece=calibration_error(top, probabilities.max(axis=1)),
        ece_classwise=float(np.mean(by_class)),
        n=len(truth),
    )


def confusion(truth: NDArray, predicted: NDArray, classes: int) -> NDArray:
    """Counts of every pair of true and predicted class.

    Parameters
    ----------
    truth, predicted : array (n,)
        Class indices.
    classes : int
        The number of classes.

    Returns
    -------
    array (classes, classes)
        Rows are true, columns predicted classes.

    """
    return np.bincount(truth * classes + predicted, minlength=classes**2).reshape(classes, classes)


def row_shares(counts: Sequence[Sequence[int]] | NDArray) -> NDArray:
    """Confusion counts divided by the sums of their rows.

    Parameters
    ----------
    counts : array (classes, classes)
        Rows are true classes.

    Returns
    -------
    array (classes, classes)
        Shares, recalls on the diagonal; 0 in a row without counts.

    """
    table = np.asarray(counts, dtype=float)
    return table / np.maximum(table.sum(axis=1, keepdims=True), 1)


def weighted_score(
    metric: str, truth: NDArray, probabilities: NDArray, weights: NDArray, classes: Sequence[str]
) -> NDArray:
    """The metric (draws,) where trajectory i counts `weights[:, i]` times.

    Parameters
    ----------
    metric : str
        One of `METRICS`, calibration errors apart.
    truth : array (n,)
        True class indices.
    probabilities : array (n, classes)
        Predicted probabilities.
    weights : array (draws, n)
        Counts.
    classes : sequence of str
        Their names.

    Raises
    ------
    InputError
        If there is no such metric.

    """
    one_of("metric", metric, [name for name in METRICS if not name.startswith("ece")])
    if metric == "auroc":
        return _auroc(truth, probabilities, weights)
    if metric == "auroc_micro":
        return _auroc_micro(truth, probabilities, weights)
    count = len(classes)
    members, answers = np.eye(count)[truth], np.eye(count)[probabilities.argmax(axis=1)]
    actual, predicted, correct = (weights @ each for each in (members, answers, members * answers))
    occurs = np.isin(np.arange(count), truth)
    with np.errstate(invalid="ignore", divide="ignore"):
        recall = correct / actual
        if metric == "accuracy":
            return correct.sum(axis=1) / actual.sum(axis=1)
        if metric == "macro_f1":
            return (2 * correct / (actual + predicted))[:, occurs].mean(axis=1)
        if metric == "balanced_accuracy":
            return recall[:, occurs].mean(axis=1)
    if HEALTHY not in classes:
        return np.full(len(weights), np.nan)
    return recall[:, classes.index(HEALTHY)]


def _auroc(truth: NDArray, probabilities: NDArray, weights: NDArray) -> NDArray:
    """Mean over the classes that occur of P(a member scores above a non-member), ties half."""
    areas = []
    for label in np.unique(truth):
        inside = truth == label
        if inside.all():
            continue
        areas.append(_area(probabilities[:, label], inside, weights))
    return np.mean(areas, axis=0) if areas else np.full(len(weights), np.nan)


def _area(values: NDArray, inside: NDArray, weights: NDArray) -> NDArray:
    above = values[inside][:, None] - values[~inside][None, :]
    wins = (above > 0) + 0.5 * (above == 0)
    members, others = weights[:, inside], weights[:, ~inside]
    with np.errstate(invalid="ignore", divide="ignore"):
        won = np.einsum("wi,wi->w", members @ wins, others)
        return won / (members.sum(axis=1) * others.sum(axis=1))


def _auroc_micro(truth: NDArray, probabilities: NDArray, weights: NDArray) -> NDArray:
    """All pairs of trajectory and class pooled, one area."""
    hit = np.zeros(probabilities.shape, dtype=bool)
    hit[np.arange(len(truth)), truth] = True
    values, inside = probabilities.ravel(), hit.ravel()
    # Sorted cumulative weights instead of all pairs: there are (n classes)^2 of those.
    _, place = np.unique(values, return_inverse=True)
    levels = place.max() + 1
    owner = np.repeat(np.arange(len(truth)), probabilities.shape[1])
    member = np.zeros((len(truth), levels))
    other = np.zeros((len(truth), levels))
    np.add.at(member, (owner[inside], place[inside]), 1)
    np.add.at(other, (owner[~inside], place[~inside]), 1)
    areas = []
    for part in np.array_split(weights, max(1, len(weights) // 500)):
        wins, losses = part @ member, part @ other
        below = np.cumsum(losses, axis=1) - 0.5 * losses
        areas.append((wins * below).sum(axis=1) / (wins.sum(axis=1) * losses.sum(axis=1)))
    return np.concatenate(areas)
