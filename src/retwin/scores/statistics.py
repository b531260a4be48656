"""Scores of a diagnoser, and whether one is better than another (Welch, Holm, bootstrap).

Over runs: Welch's t, which measures training noise only. Over test trajectories: a paired
stratified bootstrap; claims of "better" stand on that one. The unit of resampling is the
trajectory.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import HEALTHY
from retwin.errors import InputError

__all__ = [
    "METRICS",
    "Scores",
    "bootstrap",
    "bootstrap_means",
    "bootstrap_weights",
    "compare_runs",
    "confusion",
    "holm",
    "score",
]

METRICS = (
    "accuracy",
    "macro_f1",
    "balanced_accuracy",
    "auroc",
    "auroc_micro",
    "healthy_recall",
    "ece",
    "ece_classwise",
)
BINS = 10
ENOUGH_RECORDS = 5
"""Records from which whole ones are drawn again."""
BLOCKS = 16
"""Blocks of a record where it is the samples that are drawn again."""


@dataclass(frozen=True)
class Scores:
    """How well labelled trajectories were diagnosed; NaN where a score is not defined.

    Attributes
    ----------
    accuracy: share that is right.
    macro_f1: F1 averaged over the classes that occur.
    balanced_accuracy: recall averaged over the classes that occur.
    auroc: one-vs-rest area under the ROC curve, averaged over the classes that occur.
    auroc_micro: the same over all pairs of trajectory and class (the paper's figure 4).
    healthy_recall: share of healthy trajectories recognised.
    ece: expected calibration error of the top label, 10 bins of equal mass; its noise floor is
        about 0.04 at 90 trajectories and 0.06 at 36.
    ece_classwise: the same gap between probability and frequency for every class on its own, all
        classes averaged (Kull et al., NeurIPS 2019), 10 bins of equal mass each (Nixon et al., CVPR
        workshops 2019). It sees what the top label hides: a class that is never quite believed.
        Most of k probabilities are near 0, so it is smaller than `ece`, by about k / 2.
    n: trajectories.

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
        told = ", ".join(f"{name} {getattr(self, name):.3f}" for name in METRICS)
        return f"{told} ({self.n} trajectories)"


def score(truth: NDArray, probabilities: NDArray, classes: Sequence[str]) -> Scores:
    """Score probabilities (n, classes) against class indices (n,)."""
    weights = np.ones((1, len(truth)))
    each = {
        name: float(_weighted(name, truth, probabilities, weights, classes)[0])
        for name in METRICS
        if not name.startswith("ece")
    }
    top = probabilities.argmax(axis=1) == truth
    hits = np.arange(len(classes)) == truth[:, None]
    by_class = [_calibration_error(hits[:, k], probabilities[:, k]) for k in range(len(classes))]
    return Scores(
        **each,
        ece=_calibration_error(top, probabilities.max(axis=1)),
        ece_classwise=float(np.mean(by_class)),
        n=len(truth),
    )


def confusion(truth: NDArray, predicted: NDArray, classes: int) -> NDArray:
    """Counts (classes, classes); rows are true."""
    return np.bincount(truth * classes + predicted, minlength=classes**2).reshape(classes, classes)


def bootstrap_weights(truth: NDArray, *, draws: int, seed: int) -> NDArray:
    """How often each trajectory is drawn (draws, n), with replacement inside each class."""
    rng = np.random.default_rng(seed)
    weights = np.zeros((draws, len(truth)))
    for label in np.unique(truth):
        members = np.flatnonzero(truth == label)
        share = np.full(len(members), 1 / len(members))
        weights[:, members] = rng.multinomial(len(members), share, size=draws)
    return weights


def bootstrap(
    metric: str,
    truth: NDArray,
    probabilities: NDArray,
    weights: NDArray,
    classes: Sequence[str],
) -> NDArray:
    """The metric of every draw (draws,), averaged over runs: probabilities (runs, n, classes)."""
    return np.mean(
        [_weighted(metric, truth, run, weights, classes) for run in probabilities], axis=0
    )


def bootstrap_means(values: NDArray, *, draws: int, seed: int) -> NDArray:
    """Means over records and their samples of values (n, T, k), NaN where missing: (draws, k).

    Every record counts alike. Records are drawn again with replacement. Where there are fewer than
    `ENOUGH_RECORDS`, each record is instead made anew of `BLOCKS` circular blocks of its samples,
    since neighbouring samples are alike (circular block bootstrap, Politis and Romano 1992). The
    same seed draws the same records or blocks, so that two sources are paired.
    """
    rng = np.random.default_rng(seed)
    n, steps, _ = values.shape
    seen = np.isfinite(values)
    sums = np.where(seen, values, 0.0)
    if n >= ENOUGH_RECORDS:
        with np.errstate(invalid="ignore"):
            each = sums.sum(axis=1) / seen.sum(axis=1)
        return rng.multinomial(n, np.full(n, 1 / n), size=draws) @ each / n
    length = -(-steps // BLOCKS)
    drawn = np.zeros((draws, values.shape[2]))
    for record in range(n):
        begins = rng.integers(steps, size=(draws, BLOCKS))
        total, count = (
            _moving_sums(each[record], length)[begins].sum(axis=1) for each in (sums, seen)
        )
        with np.errstate(invalid="ignore"):
            drawn += total / count / n
    return drawn


def _moving_sums(values: NDArray, length: int) -> NDArray:
    """Sums of `length` samples from each one on, (T, k); the end goes on with the beginning."""
    around = np.concatenate([values, values[:length]]).astype(float)
    whole = np.cumsum(np.concatenate([np.zeros_like(around[:1]), around]), axis=0)
    return whole[length : length + len(values)] - whole[: len(values)]


def compare_runs(a: Sequence[float], b: Sequence[float]) -> dict[str, float | None]:
    """Welch's t-test that two sources have the same mean over runs; None below two runs each."""
    from scipy.stats import ttest_ind

    difference = float(np.mean(a) - np.mean(b))
    spread = np.std(a) + np.std(b)
    if min(len(a), len(b)) < 2 or spread == 0:
        return {"mean_diff": difference, "t": None, "df": None, "p": None}
    with warnings.catch_warnings():
        # Runs that agree to the last digit are possible: few trajectories, few values.
        warnings.filterwarnings("ignore", message="Precision loss occurred")
        test = ttest_ind(a, b, equal_var=False)
    return {
        "mean_diff": difference,
        "t": float(test.statistic),
        "df": float(test.df),
        "p": float(test.pvalue),
    }


def holm(p: Sequence[float]) -> list[float]:
    """Holm's step-down adjustment of a family of p-values."""
    values = np.asarray(p, dtype=float)
    order = np.argsort(values)
    factors = len(values) - np.arange(len(values))
    adjusted = np.minimum(1.0, np.maximum.accumulate(factors * values[order]))
    out = np.empty_like(adjusted)
    out[order] = adjusted
    return out.tolist()


def _weighted(
    metric: str, truth: NDArray, probabilities: NDArray, weights: NDArray, classes: Sequence[str]
) -> NDArray:
    """The metric (draws,) when trajectory i counts weights[:, i] times."""
    if metric == "auroc":
        return _auroc(truth, probabilities, weights)
    if metric == "auroc_micro":
        return _auroc_micro(truth, probabilities, weights)
    count = len(classes)
    cells = np.zeros((len(truth), count * count))
    cells[np.arange(len(truth)), truth * count + probabilities.argmax(axis=1)] = 1
    table = (weights @ cells).reshape(len(weights), count, count)
    right = np.diagonal(table, axis1=1, axis2=2)
    actual, claimed = table.sum(axis=2), table.sum(axis=1)
    occurs = np.isin(np.arange(count), truth)
    with np.errstate(invalid="ignore", divide="ignore"):
        recall = right / actual
        if metric == "accuracy":
            return right.sum(axis=1) / actual.sum(axis=1)
        if metric == "macro_f1":
            return (2 * right / (actual + claimed))[:, occurs].mean(axis=1)
        if metric == "balanced_accuracy":
            return recall[:, occurs].mean(axis=1)
        if metric == "healthy_recall":
            known = HEALTHY in classes
            index = classes.index(HEALTHY) if known else 0
            return recall[:, index] if known else np.full(len(weights), np.nan)
    raise InputError(
        "metric",
        expected=f"one of {', '.join(METRICS)}",
        got=repr(metric),
        remedy="check the spelling",
    )


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


def _calibration_error(happened: NDArray, chance: NDArray) -> float:
    """Mean gap between the chance (n,) that was given and how often it happened (n,), in bins."""
    order = np.argsort(chance, kind="stable")
    bins = np.array_split(order, min(BINS, len(order)))
    gaps = [abs(chance[part].mean() - happened[part].mean()) * len(part) for part in bins]
    return float(sum(gaps) / len(chance))
