"""Scores of diagnoses, compared with scikit-learn's and with cases that can be counted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn import metrics

from retwin.errors import InputError
from retwin.scores.classification import confusion, row_shares, score, weighted_score

pytestmark = pytest.mark.numerical

CLASSES = ("Healthy", "a", "b", "c")


def made(n: int, seed: int, *, ties: bool = False) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = np.concatenate([np.arange(4), rng.integers(0, 4, n - 4)])
    logits = rng.normal(size=(n, 4)) + 1.5 * np.eye(4)[truth]
    p = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    return truth, np.round(p, 1) + 1e-9 if ties else p


@given(st.integers(8, 60), st.integers(0, 10_000), st.booleans())
@settings(max_examples=60, deadline=None)
def test_scores_are_scikit_learn_s(n: int, seed: int, ties: bool) -> None:
    truth, p = made(n, seed, ties=ties)
    got = score(truth, p, CLASSES)
    predicted = p.argmax(axis=1)
    assert got.accuracy == pytest.approx(metrics.accuracy_score(truth, predicted))
    assert got.macro_f1 == pytest.approx(metrics.f1_score(truth, predicted, average="macro"))
    assert got.balanced_accuracy == pytest.approx(metrics.balanced_accuracy_score(truth, predicted))
    assert got.healthy_recall == pytest.approx(
        metrics.recall_score(truth, predicted, labels=[0], average=None)[0]
    )
    hits = np.eye(4)[truth]
    assert got.auroc == pytest.approx(metrics.roc_auc_score(hits, p, average="macro"))
    assert got.auroc_micro == pytest.approx(metrics.roc_auc_score(hits, p, average="micro"))
    np.testing.assert_array_equal(
        confusion(truth, predicted, 4), metrics.confusion_matrix(truth, predicted, labels=range(4))
    )


def test_calibrated_probabilities_have_little_calibration_error() -> None:
    rng = np.random.default_rng(0)
    p = rng.dirichlet(np.ones(4), size=3_000)
    truth = (p.cumsum(axis=1) < rng.random((3_000, 1))).sum(axis=1)
    assert score(truth, p, CLASSES).ece < 0.04
    sure = np.eye(4)[p.argmax(axis=1)]
    wrong = (truth != p.argmax(axis=1)).mean()
    assert score(truth, sure, CLASSES).ece == pytest.approx(wrong, abs=1e-9)


def test_calibration_is_seen_class_by_class() -> None:
    """Against cases that can be counted: ten bins of one value each, and two classes mixed up."""
    share = np.repeat(np.linspace(0.05, 0.95, 10), 100)
    p = np.stack([share, 1 - share], axis=1)
    truth = np.concatenate([np.repeat([0, 1], [n, 100 - n]) for n in range(5, 100, 10)])
    assert score(truth, p, ("Healthy", "a")).ece_classwise == pytest.approx(0.0, abs=1e-12)
    skewed = np.stack([share**2, 1 - share**2], axis=1)
    gap = np.abs(share**2 - share).mean()
    assert score(truth, skewed, ("Healthy", "a")).ece_classwise == pytest.approx(gap)
    truth, p = np.array([0, 1] * 50 + [2] * 50), np.zeros((150, 3))
    p[:100, :2], p[100:, 2] = (0.7, 0.3), 1.0
    got = score(truth, p, ("Healthy", "a", "b"))
    assert got.ece == pytest.approx(2 / 3 * 0.2)
    assert got.ece_classwise == pytest.approx(2 / 3 * 2 / 3 * 0.2)


def test_classes_that_do_not_occur_do_not_count() -> None:
    truth = np.array([1, 1, 2, 2])
    p = np.eye(4)[[1, 1, 2, 1]]
    got = score(truth, p, CLASSES)
    assert np.isnan(got.healthy_recall)
    assert got.balanced_accuracy == pytest.approx(0.75)


def test_what_is_not_defined_is_called_so() -> None:
    shown = str(score(np.array([0]), np.array([[0.8, 0.2]]), ("Healthy", "leak")))
    assert "auroc undefined" in shown
    assert "nan" not in shown


def test_shares_of_rows() -> None:
    np.testing.assert_array_equal(row_shares([[1, 3], [0, 0]]), [[0.25, 0.75], [0, 0]])


def test_an_unknown_metric_is_refused() -> None:
    truth, p = made(8, seed=0)
    with pytest.raises(InputError, match="metric: expected one of accuracy"):
        weighted_score("f2", truth, p, np.ones((1, 8)), CLASSES)
