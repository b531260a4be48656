"""Scores by ranks, and the slack that they need."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.special import ndtr, ndtri
from scipy.stats import t

from retwin.errors import InputError
from retwin.monitor import Detector, Slack, effective_samples, fit_scores, resolution


def test_an_interval_is_that_of_the_conformal_p_value() -> None:
    scores = fit_scores(np.array([[1.0, 2, 2, 3, 4, 5, 6, 7, np.nan], np.arange(9.0)]))
    low, high = scores.score(np.array([[2.0, 2.5, -np.inf, 1e300, np.nan], [0.5, 0, 9, 4, 4]]))
    assert ndtr(low[0, :4]) == pytest.approx([1 / 9, 3 / 9, 0, 8 / 9])
    assert ndtr(high[0, :4]) == pytest.approx([4 / 9, 4 / 9, 1 / 9, 1])
    assert np.isnan([low[0, 4], high[0, 4]]).all()
    assert ndtr(low[1]) == pytest.approx([0.1, 0, 0.9, 0.4, 0.4])
    one, _ = scores.score(np.array([2.0, 0.5]))
    assert one.tobytes() == low[:, 0].tobytes()


@pytest.mark.parametrize("noise", ["gaussian", "t3", "rounded"])
def test_evidence_of_one_sample_is_fair_on_average_over_calibrations(noise: str) -> None:
    # Exchangeability: the expectation of a bet over calibration and sample is exactly 1.
    rng = np.random.default_rng(0)
    drawn = rng.standard_t(3, (3000, 60)) if noise == "t3" else rng.normal(size=(3000, 60))
    drawn = np.round(drawn) if noise == "rounded" else drawn
    low, high = fit_scores(drawn[:, :-1]).score(drawn[:, -1])
    detector = Detector()
    (factor, _, _), *_ = detector.factors(np.zeros(3000), low[:, None], high[:, None])
    deviation = factor.std(axis=1) / np.sqrt(3000) + 1e-3
    assert np.all(np.abs(factor.mean(axis=1) - 1) < 4 * deviation)


@pytest.mark.parametrize("count", [30, 500])
def test_default_slack_makes_bets_unfavourable_given_the_calibration(count: int) -> None:
    rng = np.random.default_rng(1)
    errors = 1 + 5 * rng.standard_t(3, (200, count))
    scores = fit_scores(errors)
    detector = Detector(Slack.of_calibration(count))
    # The true quantiles of the errors, of which each calibration has other ranks.
    quantiles = 1 + 5 * t(3).ppf((np.arange(1000) + 0.5) / 1000)
    low, high = scores.score(np.tile(quantiles, (200, 1)))
    many = (low.reshape(-1, 1), high.reshape(-1, 1))
    (factor, _, _), *_ = detector.factors(np.zeros(low.size), *many)
    expectation = factor.reshape(len(factor), 200, -1).mean(axis=2)
    assert np.mean(expectation.max(axis=0) <= 1.001) >= 0.95


def test_slack_shrinks_with_the_calibration_and_grows_with_parameters() -> None:
    found = [Slack.of_calibration(count) for count in (20, 100, 1000, 100_000)]
    assert all(a.shift > b.shift and a.kappa >= b.kappa for a, b in pairwise(found))
    assert found[-1].shift <= 0.01
    assert Slack.of_calibration(100, parameters=3).shift > found[1].shift
    with pytest.raises(InputError, match="samples: expected"):
        Slack.of_calibration(3)


def test_effective_samples_of_an_autoregression() -> None:
    rng = np.random.default_rng(2)
    white = rng.normal(size=(50, 2000))
    red = lfilter([np.sqrt(1 - 0.64)], [1, -0.8], white, axis=1)[:, 500:]
    # The mean of an autoregression is worth n (1 - 0.8) / (1 + 0.8) independent samples.
    assert np.median(effective_samples(red)) == pytest.approx(1500 / 9, rel=0.2)
    assert np.median(effective_samples(white)) > 1900
    white[:, ::2] = np.nan
    assert 900 < np.median(effective_samples(white)) <= 1000


def test_an_uncertain_calibration_has_its_own_class() -> None:
    rng = np.random.default_rng(3)
    errors = np.full((2, 400), np.nan)
    errors[0], errors[1, :50] = rng.normal(size=400), rng.normal(size=50)
    first, second = fit_scores(errors).slack()
    assert second.shift > 2 * first.shift
    assert ndtri(0.975) / np.sqrt(400) < first.shift < 0.2


def test_too_few_errors_are_refused() -> None:
    for wrong in (np.zeros((2, 7)), np.full((1, 50), np.nan), np.zeros(50), np.zeros((0, 9))):
        with pytest.raises(InputError, match="at least 8 finite errors"):
            fit_scores(wrong)
    with pytest.raises(InputError, match="errors of 1 streams"):
        fit_scores(np.arange(9.0)[None]).score(np.zeros((2, 3)))


def test_the_resolution_of_a_sensor_is_found_in_its_values() -> None:
    rng = np.random.default_rng(4)
    values = rng.normal(20, 1, (5, 400))
    for row, step in enumerate((1 / 16, 0.25, 0.1, 3.0)):
        values[row] = np.round(values[row] / step) * step
    values[0, 3] = np.nan
    assert resolution(values) == pytest.approx([1 / 16, 0.25, 0.1, 3.0, 0.0])
    assert resolution(np.ones((1, 9))) == 0


@pytest.mark.parametrize("step", [0.5, 2.0, 4.0])
def test_scores_of_rounded_samples_are_uniform_given_the_prediction(step: float) -> None:
    rng = np.random.default_rng(5)

    def rounded(prediction: float, count: int) -> np.ndarray:
        drawn = prediction + rng.normal(size=count)
        return np.round(drawn / step) * step - prediction

    calibration = np.concatenate([rounded(m, 20) for m in rng.uniform(-9, 9, 300)])
    scores = fit_scores(calibration[None], step)
    for prediction in (0.0, 0.3 * step, 0.5 * step):
        low, high = scores.score(rounded(prediction, 3000)[None], step)
        grid = ndtri(np.arange(1, 20) / 20)
        # The mean over samples of the uniform distribution between the ends of the intervals.
        ends = ndtr(low.T), ndtr(high.T)
        share = np.clip((ndtr(grid) - ends[0]) / (ends[1] - ends[0]), 0, 1).mean(axis=0)
        assert share == pytest.approx(ndtr(grid), abs=0.04)


def test_a_huge_rounded_error_is_the_last_rank() -> None:
    scores = fit_scores(np.round(np.random.default_rng(6).normal(size=(1, 200))), 1.0)
    low, high = scores.score(np.array([[1e300, -1e300, np.inf, np.nan]]), 1.0)
    assert ndtr(low[0, 0]) == pytest.approx(200 / 201)
    assert ndtr(high[0, 1]) == pytest.approx(1 / 201)
    assert high[0, 0] == high[0, 2] == np.inf
    assert np.isnan(low[0, 3])
