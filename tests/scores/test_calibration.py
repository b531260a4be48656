"""Calibration errors and reliability diagrams, compared with known distributions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from retwin.scores.calibration import calibration_floor, reliability

pytestmark = pytest.mark.numerical


def test_the_floor_falls_with_the_root_of_the_count() -> None:
    few, many = (np.full((1, count, 2), [0.8, 0.2]) for count in (100, 10_000))
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
        answers[:, place, np.where(wrong, (truth + 1) % 9, truth)] = 0.9
        found = reliability(answers, truth)
        assert len(found.confidence) == 10
        np.testing.assert_allclose(found.confidence, 0.9)
        assert found.accuracy.mean() == pytest.approx(1 - wrong.mean())
        kept = (found.low <= found.accuracy) & (found.accuracy <= found.high)
        assert kept.all() == calibrated


def test_bars_are_the_binomial_distribution_however_many_runs() -> None:
    """Nine answers to a bin, each right with probability 0.8, and the same nine in every run."""
    answers = np.full((3, 90, 9), 0.2 / 8)
    answers[..., 0] = 0.8
    found = reliability(answers, np.repeat(np.arange(9), 10))
    wanted = binom.ppf([0.05, 0.95], 9, 0.8) / 9
    np.testing.assert_allclose(np.median([found.low, found.high], axis=1), wanted)
