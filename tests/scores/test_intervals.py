"""Intervals over trajectories: shares and positive figures with known truths."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, binomtest, t

from retwin.scores.intervals import grouped_share_interval, jackknife_interval, share_interval
from retwin.scores.uses import COVERAGE, Requirement, answer_of

pytestmark = pytest.mark.numerical
STUDIES = 1500


@pytest.mark.parametrize(("count", "n"), [(0, 9), (3, 9), (9, 9), (1, 1)])
def test_intervals_of_shares_are_scipy_s(count: int, n: int) -> None:
    wanted = binomtest(count, n).proportion_ci()
    assert share_interval(count, n) == pytest.approx((wanted.low, wanted.high))


@pytest.mark.parametrize(("n", "dependence"), [(5, 1.0), (6, 10.0), (10, 3.0)])
def test_coverage_of_few_trajectories_contains_the_truth(n: int, dependence: float) -> None:
    """Shares of dependent points in a perfect 90 % band; a bootstrap covers 0.70 to 0.86.

    The use of bands refuses such a generator where its interval misses 0.85 to 0.95.
    """
    rng = np.random.default_rng(0)
    hits = failed = 0
    for _ in range(STUDIES):
        shares = rng.beta(0.9 * dependence, 0.1 * dependence, size=n)
        ends = grouped_share_interval(shares, np.ones(n))
        hits += ends[0] <= 0.9 <= ends[1]
        failed += answer_of(Requirement(shares.mean(), ends, *COVERAGE)) == "no"
    assert hits >= binom.ppf(1e-6, STUDIES, 0.95)
    assert failed <= binom.isf(1e-6, STUDIES, 0.05)


@pytest.mark.parametrize("n", [5, 10])
def test_mean_scores_of_few_trajectories_contain_the_truth(n: int) -> None:
    rng = np.random.default_rng(0)
    spread = 0.3
    hits = 0
    for _ in range(STUDIES):
        values = np.exp(spread * rng.standard_normal(n))
        low, high = jackknife_interval(lambda w, v=values: w @ v, n, positive=True)
        hits += low <= np.exp(spread**2 / 2) <= high
    assert hits >= binom.ppf(1e-6, STUDIES, 0.94)


def test_the_jackknife_of_a_mean_is_student_s_interval() -> None:
    values = np.random.default_rng(0).normal(size=12)
    wanted = t.interval(0.95, 11, values.mean(), values.std(ddof=1) / np.sqrt(12))
    assert jackknife_interval(lambda w: w @ values, 12) == pytest.approx(wanted)


def test_few_trajectories_have_no_interval() -> None:
    assert grouped_share_interval(np.ones(4), np.ones(4)) is None
    assert jackknife_interval(lambda w: w @ np.ones(4), 4) is None
    assert jackknife_interval(lambda w: w @ np.zeros(6), 6, positive=True) is None
    assert grouped_share_interval(np.zeros(6), np.zeros(6)) is None


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_equal_shares_have_a_width(share: float) -> None:
    """As wide as six single trials, which is the widest."""
    found = grouped_share_interval(np.full(6, share), np.ones(6))
    assert found == pytest.approx(share_interval(6 * share, 6))
