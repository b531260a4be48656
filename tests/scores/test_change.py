"""The error before and after an update, and decisions that are certain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from retwin.scores.change import ErrorChange, error_change, needed_to_decide
from retwin.scores.decisions import (
    certain_decision,
    healthy_needed,
)

CLASSES = ["Healthy", "Stuck"]


def test_errors_are_means_over_what_was_measured() -> None:
    observed = np.zeros((6, 4, 2))
    observed[0, 2:] = np.nan
    before, after = np.full_like(observed, 0.002), np.full_like(observed, -0.001)
    before[..., 1] = 0.004
    found = error_change(before, after, observed, scale=[1000.0, 1000.0])
    assert found is not None
    assert (found.before, found.after) == pytest.approx((3.0, 1.0))
    assert found.ratio == pytest.approx(1 / 3)
    assert found.ratio_interval == pytest.approx((1 / 3, 1 / 3)), "no trajectory differs"
    np.testing.assert_allclose(found.outputs_before, [2.0, 4.0])
    assert found.trajectories == 6


def test_few_trajectories_have_no_interval_and_none_no_change() -> None:
    observed = np.zeros((4, 3, 1))
    found = error_change(observed + 2, observed + 1, observed)
    assert found is not None
    assert found.ratio_interval is None
    assert error_change(observed, observed, np.full_like(observed, np.nan)) is None


def test_the_trajectories_that_decide_a_ratio_decide_it() -> None:
    """With as many as were said, the interval excludes 1 where the ratio stays as it is."""
    rng = np.random.default_rng(3)

    def change(count: int) -> ErrorChange:
        after = np.exp(0.4 * rng.standard_normal((count, 1, 1))) * 0.85
        found = error_change(np.ones((count, 1, 1)), after, np.zeros((count, 1, 1)))
        assert found is not None
        return found

    few = replace(change(10), ratio=0.85, ratio_interval=(0.66, 1.1))
    needed = needed_to_decide(few)
    assert needed == 26, "10 (ln(1.1 / 0.85) / ln(1 / 0.85))² = 25.2"
    ends = change(4 * needed).ratio_interval
    assert ends is not None
    assert ends[1] < 1
    for ends, ratio in (((0.5, 0.9), 0.7), ((1.1, 1.5), 1.3), (None, 0.7), ((0.5, 2.0), 0.999)):
        assert needed_to_decide(replace(few, ratio=ratio, ratio_interval=ends)) is None


def probabilities(fault: np.ndarray) -> np.ndarray:
    return np.stack([1 - fault, fault], axis=1)


@pytest.mark.parametrize("rate", [0.05, 0.1, 0.3])
def test_healthy_needed_is_the_first_number_that_suffices(rate: float) -> None:
    n = healthy_needed(rate)
    assert (1 - rate) ** n <= 0.025 < (1 - rate) ** (n - 1)


def test_a_certain_decision_keeps_its_rate() -> None:
    """In 97.5 % of sets of healthy trajectories, the true rate of the threshold is not above."""
    rng = np.random.default_rng(0)
    truth = np.repeat([0, 1], [60, 20])
    kept = 0
    for _ in range(200):
        fault = np.concatenate([rng.random(60), 0.5 + 0.5 * rng.random(20)])
        found = certain_decision(probabilities(fault), truth, CLASSES, 0.1)
        assert found is not None
        kept += 1 - found.threshold <= 0.1  # healthy values are uniform
    assert kept >= binom.ppf(1e-6, 200, 0.975)


def test_too_few_for_certainty() -> None:
    truth = np.repeat([0, 1], [10, 5])
    fault = np.linspace(0, 1, 15)
    assert certain_decision(probabilities(fault), truth, CLASSES, 0.1) is None
