"""Thresholds that keep the rate of false alarms, and what they detect and cost."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, norm

from retwin.scores.decisions import decide

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


@pytest.mark.parametrize(("healthy", "rate"), [(20, 0.1), (40, 0.3)])
def test_ranges_contain_the_rates_of_a_known_detector(healthy: int, rate: float) -> None:
    """Healthy values are standard normal, faulty ones 1.5 higher.

    For the detection at exactly the rate, the interval at the threshold covers 0.4 to 0.7.
    """
    rng, shift, studies = np.random.default_rng(0), 1.5, 200
    truth = np.repeat([0, 1], [healthy, 80])
    hits = np.zeros(3)
    for _ in range(studies):
        fault = norm.cdf(rng.standard_normal(healthy + 80) + shift * truth - 1)
        probabilities = np.stack([1 - fault, fault, 0 * fault], axis=1)
        found = decide(probabilities, truth, CLASSES, rate)
        threshold = norm.ppf(found.threshold) + 1
        for i, (ends, true) in enumerate(
            (
                (found.interval, norm.sf(threshold - shift)),
                (found.false_alarms, norm.sf(threshold)),
                (found.at_rate, norm.sf(norm.isf(rate) - shift)),
            )
        ):
            hits[i] += ends[0] <= true <= ends[1]
    assert (hits >= binom.ppf(1e-6, studies, 0.95)).all()


def test_many_healthy_trajectories_leave_the_interval_of_the_share() -> None:
    rng = np.random.default_rng(1)
    fault = rng.beta(1, 4, size=20_000)
    probabilities = np.stack([1 - fault, fault, 0 * fault], axis=1)
    probabilities = np.concatenate([probabilities, [[0.1, 0.9, 0.0]] * 30 + [[0.9, 0.1, 0.0]] * 5])
    truth = np.repeat([0, 1], [20_000, 35])
    found = decide(probabilities, truth, CLASSES, 0.1)
    assert found.at_rate == pytest.approx(found.interval, abs=1e-6)
    assert found.false_alarms == pytest.approx((0.1, 0.1), abs=0.006)


def test_everything_or_nothing_detected_has_an_open_end() -> None:
    healthy = np.linspace(0.1, 0.5, 99)
    for fault, end, value in ((0.9, 1, 1.0), (0.01, 0, 0.0)):
        values = np.append(healthy, [fault] * 9)
        probabilities = np.stack([1 - values, values, 0 * values], axis=1)
        found = decide(probabilities, np.repeat([0, 1], [99, 9]), CLASSES, 0.2)
        assert found.at_rate[end] == value
        assert found.at_rate == pytest.approx(found.interval, abs=1e-6)
