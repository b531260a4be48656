"""Bootstrap draws, compared with plain resampling and with known standard errors."""

from __future__ import annotations

import numpy as np
import pytest

from retwin.scores.bootstrap import bootstrap, bootstrap_means, bootstrap_weights
from retwin.scores.classification import score

pytestmark = pytest.mark.numerical

CLASSES = ("Healthy", "a", "b", "c")


def made(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = np.concatenate([np.arange(4), rng.integers(0, 4, n - 4)])
    logits = rng.normal(size=(n, 4)) + 1.5 * np.eye(4)[truth]
    p = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    return truth, p


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
