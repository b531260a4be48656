"""Thresholds that keep the rate of false alarms, and what they detect and cost."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binomtest

from retwin.scores.decisions import decide
from retwin.scores.intervals import share_interval

pytestmark = pytest.mark.numerical

CLASSES = ["Healthy", "stuck", "bias"]


def test_the_rate_of_false_alarms_is_kept_on_average() -> None:
    rng = np.random.default_rng(0)
    rates = []
    for _ in range(400):
        alarm = rng.beta(1, 4, size=20)
        probabilities = np.stack([1 - alarm, alarm, 0 * alarm], axis=1)
        probabilities = np.concatenate([probabilities, [[0.1, 0.9, 0.0]]])
        truth = np.array([0] * 20 + [1])
        found = decide(probabilities, truth, CLASSES, 0.1)
        rates.append((rng.beta(1, 4, size=1000) > found.threshold).mean())
    assert np.mean(rates) == pytest.approx(0.1, abs=0.01)


def test_what_is_detected_missed_and_confused() -> None:
    healthy = np.tile([0.9, 0.05, 0.05], (9, 1))
    stuck = np.array([[0.1, 0.8, 0.1]] * 3 + [[0.1, 0.2, 0.7]])
    bias = np.array([[0.1, 0.2, 0.7], [0.95, 0.0, 0.05]])
    truth = np.repeat([0, 1, 2], [9, 4, 2])
    found = decide(np.concatenate([healthy, stuck, bias]), truth, CLASSES, 0.1)
    assert found.threshold == pytest.approx(0.1)
    assert found.detected == pytest.approx(5 / 6)
    assert found.interval[0] < 5 / 6 < found.interval[1]
    assert found.identified == pytest.approx(4 / 5)
    assert (found.most_missed, found.most_confused) == ("bias", ("stuck", "bias"))


def test_few_healthy_trajectories_promise_nothing() -> None:
    probabilities = np.array([[0.9, 0.1, 0.0]] * 8 + [[0.0, 1.0, 0.0]])
    truth = np.array([0] * 8 + [1])
    assert np.isnan(decide(probabilities, truth, CLASSES, 0.1).threshold)
    assert np.isfinite(decide(probabilities, truth, CLASSES, 0.12).threshold)


def test_costs_follow_from_the_rates() -> None:
    probabilities = np.array([[0.9, 0.1, 0.0]] * 9 + [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    found = decide(probabilities, np.array([0] * 9 + [1, 1]), CLASSES, 0.1)
    cost = found.cost(trajectories=1000, faulty=0.1, missed=50)
    assert (found.guaranteed, found.detected) == (pytest.approx(0.1), 0.5)
    assert cost.false_alarms == pytest.approx(90)
    assert cost.missed_faults == pytest.approx(50)
    assert cost.total == pytest.approx(90 + 50 * 50)


@pytest.mark.parametrize(("count", "n"), [(0, 9), (3, 9), (9, 9), (1, 1)])
def test_intervals_of_shares_are_scipy_s(count: int, n: int) -> None:
    wanted = binomtest(count, n).proportion_ci()
    assert share_interval(count, n) == pytest.approx((wanted.low, wanted.high))
