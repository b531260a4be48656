"""Calibration errors and reliability diagrams, compared with known distributions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from retwin.scores.calibration import calibration_error, calibration_floor, reliability

pytestmark = pytest.mark.numerical


def around(confidence: float, count: int) -> np.ndarray:
    """Different confidences (count,) within 1e-6, so that bins of equal mass are defined."""
    return confidence + 1e-6 * np.linspace(-1, 1, count)


def test_ties_do_not_depend_on_the_order_of_the_file() -> None:
    """Nine of ten right at a confidence of 0.9 each: no error, wherever the wrong ones stand."""
    happened = np.repeat([1.0, 0.0], [90, 10])
    for order in range(3):
        shuffled = np.random.default_rng(order).permutation(happened)
        assert calibration_error(shuffled, np.full(100, 0.9)) == pytest.approx(0, abs=1e-12)
    rng = np.random.default_rng(3)
    confidence = rng.integers(5, 10, size=100) / 10
    right = rng.random(100) < confidence
    found = [
        calibration_error(right[order], confidence[order])
        for order in (np.arange(100), rng.permutation(100), np.argsort(right))
    ]
    assert found == pytest.approx([found[0]] * 3)


@pytest.mark.parametrize("confidence", [0.5, 0.8, 0.95])
def test_the_floor_depends_on_the_confidence(confidence: float) -> None:
    top = around(confidence, 360)
    wanted = np.sqrt(20 * confidence * (1 - confidence) / (np.pi * 360))
    found = calibration_floor(np.stack([top, 1 - top], axis=1)[None], draws=1000)
    assert found == pytest.approx(wanted, rel=0.12)


def test_the_floor_falls_with_the_root_of_the_count() -> None:
    tops = [around(0.8, count) for count in (100, 10_000)]
    few, many = (np.stack([top, 1 - top], axis=1)[None] for top in tops)
    # Ten bins of n / 10 answers, each right with probability 0.8: E|mean - 0.8|.
    wanted = np.sqrt(2 / np.pi * 0.8 * 0.2 / 1000)
    assert calibration_floor(many) == pytest.approx(wanted, rel=0.1)
    assert calibration_floor(few) / calibration_floor(many) == pytest.approx(10, rel=0.15)
    assert calibration_floor(np.eye(2)[None]) == 0


def test_reliability_of_a_calibrated_classifier_lies_within_its_bars() -> None:
    """Sure by 0.9 and right in nine of ten; then with half of the right answers made wrong."""
    truth = np.repeat(np.arange(9), 10)
    place = np.arange(90)
    for wrong, calibrated in ((place % 10 == 0, True), (place % 10 % 2 == 0, False)):
        answers = np.full((2, 90, 9), 0.1 / 8)
        answers[:, place, np.where(wrong, (truth + 1) % 9, truth)] = around(0.9, 90)
        found = reliability(answers, truth)
        assert len(found.confidence) == 10
        np.testing.assert_allclose(found.confidence, 0.9, atol=1e-5)
        assert found.accuracy.mean() == pytest.approx(1 - wrong.mean())
        kept = (found.low <= found.accuracy) & (found.accuracy <= found.high)
        assert kept.all() == calibrated


def test_bars_are_the_binomial_distribution_however_many_runs() -> None:
    """Nine answers to a bin, each right with probability 0.8, and the same nine in every run."""
    answers = np.full((3, 90, 9), 0.2 / 8)
    answers[..., 0] = around(0.8, 90)
    found = reliability(answers, np.repeat(np.arange(9), 10))
    wanted = binom.ppf([0.05, 0.95], 9, 0.8) / 9
    np.testing.assert_allclose(np.median([found.low, found.high], axis=1), wanted)
