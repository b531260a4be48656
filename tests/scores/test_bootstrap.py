"""Bootstrap draws: intervals of scores near 1, verdicts over few runs, records."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, ttest_1samp

from retwin.scores.bootstrap import Draws, Resampling, bootstrap_means
from retwin.scores.classification import score
from retwin.scores.intervals import share_interval

pytestmark = pytest.mark.numerical

CLASSES = ("Healthy", *map(str, range(1, 9)))
TRUTH = np.arange(36) % 9


def answers(right: np.ndarray) -> np.ndarray:
    """Certain answers (runs, 36, 9): the true class, or the next one where `right` is False."""
    return np.eye(9)[np.where(right, TRUTH, (TRUTH + 1) % 9)]


def least(studies: int, coverage: float) -> int:
    """Fewest hits at that coverage, but for one test in a million."""
    return int(binom.ppf(1e-6, studies, coverage))


def test_weights_keep_the_size_of_every_class() -> None:
    made = Resampling(TRUTH, CLASSES, 50, seed=0)
    made.of("macro_f1", answers(np.ones((1, 36), dtype=bool)))
    for truth, certain, weights in next(iter(made._made.values())):
        assert len(truth) == 36 + len(certain) == weights.shape[1]
        for label in range(9):
            np.testing.assert_allclose(weights[:, truth == label].sum(axis=1), 4)


@pytest.mark.parametrize(("wrong", "n"), [(0, 10), (1, 10), (3, 6), (4, 4)])
def test_the_recall_of_one_run_has_the_interval_of_clopper_and_pearson(wrong: int, n: int) -> None:
    truth = np.repeat([0, 1], [n, 5])
    predicted = truth.copy()
    predicted[:wrong] = 1
    made = Resampling(truth, ("Healthy", "a", "b"), 40_000, seed=1)
    found = made.of("healthy_recall", np.eye(3)[predicted][None]).interval
    assert found == pytest.approx(share_interval(n - wrong, n), abs=0.012)


def test_runs_that_agree_add_nothing() -> None:
    """Diagnoses of one trajectory in several runs are no further trajectories."""
    right = np.random.default_rng(0).random((1, 36)) < 0.8
    made = Resampling(TRUTH, CLASSES, 500, seed=0)
    for metric in ("macro_f1", "healthy_recall", "auroc"):
        one, five = (made.of(metric, answers(np.repeat(right, k, axis=0))) for k in (1, 5))
        assert one.interval == pytest.approx(five.interval)


@pytest.mark.parametrize("true", [0.9, 0.97])
def test_intervals_of_scores_near_one_contain_the_truth(true: float) -> None:
    """Errors go round the classes, so that macro-F1 and every recall are the share of hits.

    At 0.97 a plain bootstrap covers 0.73 (macro-F1) and 0.45 (recall of healthy ones).
    """
    studies, rng = 150, np.random.default_rng(0)
    hits = dict.fromkeys(("macro_f1", "healthy_recall", "accuracy"), 0)
    widths = []
    for seed in range(studies):
        made = Resampling(TRUTH, CLASSES, 400, seed)
        p = answers(rng.random((1, 36)) < true)
        for metric in hits:
            low, high = made.of(metric, p).interval
            hits[metric] += low <= true <= high
        widths.append(high - low)
    assert min(hits.values()) >= least(studies, 0.93), hits
    assert np.mean(widths) < 0.25


def test_the_auroc_without_an_error_has_a_width() -> None:
    right = answers(np.ones((1, 36), dtype=bool))
    low, high = Resampling(TRUTH, CLASSES, 500, seed=0).of("auroc", right).interval
    assert 0.9 < low < 1
    assert high == pytest.approx(1)


def test_differences_are_paired_and_equal_sources_undecided() -> None:
    right = np.random.default_rng(1).random((1, 36)) < 0.7
    better = right.copy()
    better[0, np.flatnonzero(~right[0])[:9]] = True
    made = Resampling(TRUTH, CLASSES, 2000, seed=0)
    a, b = (made.of("macro_f1", answers(each)) for each in (better, right))
    same = a - a
    assert same.interval[0] < 0 < same.interval[1]
    assert same.p > 0.3
    difference = a - b
    assert difference.interval[0] > 0
    assert difference.p < 0.05
    assert difference.p == pytest.approx((b - a).p)
    assert (b - a).interval == pytest.approx(tuple(-end for end in difference.interval[::-1]))
    alone = a.interval[1] - a.interval[0] + b.interval[1] - b.interval[0]
    assert difference.interval[1] - difference.interval[0] < alone


def test_runs_alone_give_student_s_test() -> None:
    """Without any variance over trajectories, p is that of the t-test over runs."""
    rng = np.random.default_rng(3)
    for runs in (5, 10):
        values = rng.normal(0.03, 0.05, size=runs)
        drawn = Draws(*np.full((2, 40_000), values.mean())).with_runs(values.tolist(), seed=0)
        wanted = ttest_1samp(values, 0)
        assert drawn.p == pytest.approx(wanted.pvalue, abs=0.015)
        ends = wanted.confidence_interval()
        assert drawn.interval == pytest.approx((ends.low, ends.high), abs=0.004)


def test_a_difference_of_shares_stays_within_its_range() -> None:
    values = [0.7, 1.0, 1.0, 1.0, 0.9]
    drawn = Draws(*np.full((2, 1000), np.mean(values))).with_runs(values, seed=0, largest=1.0)
    assert drawn.interval[1] == 1.0


def test_undefined_draws_have_no_interval() -> None:
    nothing = Resampling(np.array([1, 1]), ("Healthy", "a"), 10, 0)
    found = nothing.of("healthy_recall", np.eye(2)[[[1, 1]]])
    assert (found.interval, found.p) == (None, None)


@pytest.mark.parametrize("metric", ["accuracy", "macro_f1", "balanced_accuracy", "auroc"])
def test_intervals_contain_the_score_of_the_plain_weights(metric: str) -> None:
    rng = np.random.default_rng(1)
    p = rng.dirichlet(np.ones(9), size=36) + 0.1 * np.eye(9)[TRUTH]
    plain = score(TRUTH, p, CLASSES)
    low, high = Resampling(TRUTH, CLASSES, 2000, seed=0).of(metric, p[None]).interval
    assert low < getattr(plain, metric) < high


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


def test_intervals_over_eight_records_contain_the_truth() -> None:
    """Mean squared errors that are log-normal between records; a plain bootstrap covers 0.88."""
    studies, rng, spread = 1000, np.random.default_rng(0), 0.3
    hits = 0
    for seed in range(studies):
        values = np.exp(spread * rng.standard_normal((8, 1, 1)))
        low, high = np.quantile(bootstrap_means(values, draws=400, seed=seed), [0.025, 0.975])
        hits += low <= np.exp(spread**2 / 2) <= high
    assert hits >= least(studies, 0.925)


@pytest.mark.parametrize("records", [1, 3, 9])
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
