"""Scores of predictive distributions against closed forms and other implementations."""

from __future__ import annotations

import numpy as np
import pytest
import scoringrules
from scipy.stats import ks_2samp, kstest, norm

from retwin.errors import InputError
from retwin.scores.distributions import (
    LEVELS,
    central_band,
    crps,
    crps_normal,
    cumulative_counts,
    further_group_quantile,
    grouped_quantile,
    inside,
    ks_distance,
    log_score,
    pit_histograms,
    quantiles,
    share_as_far,
)

pytestmark = pytest.mark.numerical

RNG = np.random.default_rng(0)


def test_one_more_draw_is_below_a_quantile_with_its_probability() -> None:
    draws = RNG.normal(size=(20, 40_000))
    below = (draws[-1] < quantiles(draws[:19])).mean(axis=1)
    np.testing.assert_allclose(below, LEVELS, atol=0.01)


def test_the_central_bands_have_their_levels() -> None:
    bands = np.array(LEVELS)[None, :, None]
    for level in (50, 90):
        low, high = central_band(bands, level)
        assert high - low == pytest.approx(level / 100)
    with pytest.raises(InputError, match="level: expected one of 50, 90, got 80"):
        central_band(bands, 80)


def test_missing_values_are_neither_inside_nor_outside() -> None:
    found = inside(np.array([0.0, 1.0, 2.0, np.nan]), np.array(0.0), np.array(1.0))
    np.testing.assert_array_equal(found, [1, 1, 0, np.nan])


def test_crps_is_that_of_the_gaussian_for_small_ensembles_too() -> None:
    observed = np.linspace(-2, 2, 5)
    draws = RNG.normal(size=(4, 60_000, 1)) * np.ones(5)
    wanted = scoringrules.crps_normal(observed, 0.0, 1.0)
    got = crps(np.broadcast_to(observed, draws.shape[1:]), draws).mean(axis=0)
    np.testing.assert_allclose(got, wanted, atol=0.01)
    assert np.isnan(crps(np.array([np.nan]), draws[:, 0, :1])).all()


def test_crps_is_that_of_scoringrules() -> None:
    observed, draws = RNG.normal(size=(7, 3)), RNG.normal(size=(40, 7, 3))
    wanted = scoringrules.crps_ensemble(observed, draws, m_axis=0, estimator="pwm")
    np.testing.assert_allclose(crps(observed, draws), wanted, rtol=1e-12)


def test_crps_of_a_normal_is_that_of_scoringrules() -> None:
    observed, mean, deviation = RNG.normal(size=(3, 7, 3)) * np.array([3, 1, 0]).reshape(3, 1, 1)
    deviation = deviation + np.geomspace(1e-3, 1e3, 21).reshape(7, 3)
    wanted = scoringrules.crps_normal(observed, mean, deviation)
    np.testing.assert_allclose(crps_normal(observed, mean, deviation), wanted, rtol=1e-12)


def test_the_pit_of_exchangeable_members_is_uniform_with_ties_too() -> None:
    """Rounded values tie often; the histogram stays flat."""
    ensemble = RNG.normal(size=(40, 2000, 2)).round(1)
    found = pit_histograms(ensemble, members=3, bins=10, rng=RNG)
    assert found.shape == (3, 2, 10)
    np.testing.assert_allclose(found.sum(axis=2), 1, rtol=1e-5)
    np.testing.assert_allclose(found, 0.1, atol=0.035)
    shifted = ensemble.copy()
    shifted[0] += 5
    assert pit_histograms(shifted, members=1, bins=10, rng=RNG)[0, :, -1].min() > 0.95


def test_every_group_has_the_same_weight_in_a_quantile() -> None:
    groups = [np.zeros(1000), np.ones(10)]
    assert grouped_quantile(groups, 0.5) == 0
    assert grouped_quantile(groups, 0.51) == 1
    assert grouped_quantile([np.arange(1, 11)], 0.9) == 9


def test_a_further_group_is_as_large_as_the_largest() -> None:
    """Of 0.1 to 1.0 and 1.1 to 2.0: 18 of 20 values, then 9 of 10 with two thirds above 1."""
    groups = [np.arange(1, 11) / 10, 1 + np.arange(1, 11) / 10]
    assert grouped_quantile(groups, 0.9) == pytest.approx(1.8)
    assert further_group_quantile(groups, 0.9) == pytest.approx(1.9)
    assert further_group_quantile(groups[:1], 0.9) == grouped_quantile(groups[:1], 0.9)


def test_ks_distances_are_scipys() -> None:
    values = RNG.normal(size=(1, 2, 100))
    values[0, 1] += 0.5
    values[0, 0, ::7] = np.nan
    below, count = cumulative_counts(values, 1000)
    first, second = (each[np.isfinite(each)] for each in values[0])
    wanted = ks_2samp(first, second).statistic
    assert ks_distance(below, count, np.ones((1, 1)), 0)[0] == pytest.approx(wanted)
    # A weight of 2 is the same as giving a set twice.
    more = np.concatenate([values, RNG.normal(size=(1, 2, 100))])
    twice = np.concatenate([more, more[1:]])
    weighted, repeated = (
        ks_distance(*cumulative_counts(each, 10_000), weights, 0)
        for each, weights in ((more, np.array([[1.0, 2.0]])), (twice, np.ones((1, 3))))
    )
    np.testing.assert_allclose(weighted, repeated)


def test_the_p_value_of_exchangeable_distances_is_uniform() -> None:
    p = [share_as_far(RNG.normal(size=100)) for _ in range(500)]
    assert kstest(p, "uniform").pvalue > 0.01
    assert share_as_far(np.array([5.0, 1.0, np.nan, 2.0])) == pytest.approx(1 / 3)


def test_the_log_score_is_that_of_a_normal_and_infinite_without_spread() -> None:
    draws = RNG.normal(2.0, 3.0, size=(20_000, 2))
    draws[:, 1] = 0.1  # its variance is not exactly 0
    found = log_score(np.array([4.0, 0.1]), draws)
    assert found[0] == pytest.approx(-norm.logpdf(4.0, 2.0, 3.0), abs=0.02)
    assert found[1] == np.inf
    assert np.isnan(log_score(np.array([np.nan, np.nan]), draws)).all()


def test_the_log_score_is_least_for_the_true_distribution() -> None:
    observed = RNG.normal(size=4000)
    scores = {
        spread: log_score(observed, spread * RNG.normal(size=(500, 4000))).mean()
        for spread in (0.5, 0.8, 1.0, 1.3, 2.0)
    }
    assert min(scores, key=scores.__getitem__) == 1.0
