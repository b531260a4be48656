from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn import metrics
from statsmodels.stats.multitest import multipletests

from retwin.scores.statistics import (
    bootstrap,
    bootstrap_means,
    bootstrap_weights,
    compare_runs,
    confusion,
    holm,
    score,
)

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


def test_bootstrap_is_the_plain_one() -> None:
    """Each draw's metrics equal those of the resampled trajectories themselves."""
    truth, p = made(40, seed=1)
    weights = bootstrap_weights(truth, draws=20, seed=0)
    for label in range(4):
        assert (weights[:, truth == label].sum(axis=1) == (truth == label).sum()).all()
    for name in ("accuracy", "macro_f1", "balanced_accuracy", "auroc", "auroc_micro"):
        got = bootstrap(name, truth, p[None], weights, CLASSES)
        for draw in range(20):
            chosen = np.repeat(np.arange(40), weights[draw].astype(int))
            plain = score(truth[chosen], p[chosen], CLASSES)
            assert got[draw] == pytest.approx(getattr(plain, name)), name


def test_bootstrap_interval_covers_the_truth() -> None:
    """Accuracy of a classifier that is right in 70 % of cases, inside in about 95 % of sets."""
    inside = 0
    rng = np.random.default_rng(0)
    for seed in range(200):
        truth = np.repeat(np.arange(4), 25)
        right = rng.random(100) < 0.7
        p = np.eye(4)[np.where(right, truth, (truth + 1) % 4)]
        draws = bootstrap(
            "accuracy", truth, p[None], bootstrap_weights(truth, draws=400, seed=seed), CLASSES
        )
        low, high = np.quantile(draws, [0.025, 0.975])
        inside += low <= 0.7 <= high
    assert 0.89 <= inside / 200 <= 0.99


def test_welch_reproduces_the_paper_s_table() -> None:
    """Table 1, macro-F1: 0.753 ± 0.026 against 0.644 ± 0.036 over 10 runs."""
    rng = np.random.default_rng(0)

    def runs(mean: float, deviation: float) -> list[float]:
        x = rng.normal(size=10)
        return (mean + deviation * (x - x.mean()) / x.std(ddof=1)).tolist()

    got = compare_runs(runs(0.753, 0.026), runs(0.644, 0.036))
    assert got["mean_diff"] == pytest.approx(0.109)
    # The table's means and deviations are rounded, its t and df are not.
    assert got["t"] == pytest.approx(7.860, abs=0.15)
    assert got["df"] == pytest.approx(16.55, abs=0.4)


def test_one_run_has_no_welch() -> None:
    assert compare_runs([0.5], [0.4]) == {
        "mean_diff": pytest.approx(0.1),
        "t": None,
        "df": None,
        "p": None,
    }


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
@settings(max_examples=25, deadline=None)
def test_holm_is_statsmodels_s(p: list[float]) -> None:
    np.testing.assert_allclose(holm(p), multipletests(p, method="holm")[1], atol=1e-12)


def test_few_records_are_drawn_again_in_blocks() -> None:
    white = np.random.default_rng(0).normal(size=(1, 4096, 1))
    alike = np.cumsum(white, axis=1) - 0.99 * np.cumsum(np.roll(white, 1, axis=1), axis=1)
    spread = bootstrap_means(white, draws=2000, seed=1).std()
    assert spread == pytest.approx(1 / np.sqrt(4096), rel=0.25)
    one_by_one = alike.std() / np.sqrt(4096)
    assert bootstrap_means(alike, draws=2000, seed=1).std() > 2 * one_by_one


def test_many_records_are_drawn_again_whole() -> None:
    level = np.random.default_rng(0).normal(size=(200, 1, 1))
    drawn = bootstrap_means(np.repeat(level, 50, axis=1), draws=2000, seed=1)
    assert drawn.std() == pytest.approx(1 / np.sqrt(200), rel=0.15)


@pytest.mark.parametrize("records", [1, 3, 8])
def test_missing_samples_do_not_count_and_draws_are_paired(records: int) -> None:
    rng = np.random.default_rng(2)
    values = rng.normal(size=(records, 160, 2))
    gaps = np.where(rng.random(values.shape) < 0.2, np.nan, values)
    drawn = bootstrap_means(gaps, draws=500, seed=3)
    assert drawn.mean(axis=0) == pytest.approx(np.nanmean(gaps, axis=(0, 1)), abs=0.03)
    shifted = bootstrap_means(gaps + 1.0, draws=500, seed=3)
    np.testing.assert_allclose(shifted - drawn, 1.0, atol=1e-9)
    nothing = np.full_like(values, np.nan)
    assert np.isnan(bootstrap_means(nothing, draws=5, seed=0)).all()
