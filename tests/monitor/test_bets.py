"""Bets have an expectation of at most 1 for each member of the class, by integration."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr
from scipy.stats import laplace, t, uniform

from retwin.monitor import Detector, Scale, Slack
from retwin.monitor.detect.bets import CLIP, Alternative

# Gaussian quantiles between the edges of the grid, and their probabilities.
STEPS = np.arange(-8 * 1280, 8 * 1280 + 1) / 1280
GAUSSIAN = (STEPS[1:] + STEPS[:-1]) / 2
PROBABILITIES = ndtr(GAUSSIAN)
MASS = np.diff(ndtr(STEPS))

# Quantile functions of members of the class.
MEMBERS: list[tuple[Slack, Callable[[NDArray], NDArray]]] = [
    (Slack(), lambda e: e),
    (Slack(1.25, 0.1), lambda e: e),
    (Slack(1.25, 0.1), lambda e: 1.25 * e + 0.1),
    (Slack(1.25, 0.1), lambda e: 1.25 * e - 0.1),
    (Slack(1.25, 0.1), lambda e: e / 1.25 + 0.1),
    (Slack(1.25, 0.1), lambda e: 1.25 * e + 0.1 * np.sign(e)),
    (Slack(1.25, 0.1), lambda e: np.sign(e) * np.maximum(np.abs(e) / 1.25 - 0.1, 0)),
    (Slack(1.25, 0.1), lambda e: np.where(e > 0, 1.25 * e + 0.1, e / 1.25)),
    (Slack(1.5, 0.15), lambda e: 0.69 * t(3).ppf(PROBABILITIES)),
    (Slack(1.5, 0.15), lambda e: 0.8 * laplace.ppf(PROBABILITIES)),
    (Slack(1.35, 0.15), lambda e: uniform(-2.05, 4.1).ppf(PROBABILITIES)),
    (Slack(1.2, 0.2), lambda e: np.where(e > 3.17, 1e300, e)),
]


def expectations(detector: Detector, scores: NDArray, previous: float) -> NDArray:
    """Expectation of each bet, by a sum over the scores at Gaussian quantiles."""
    streams = np.full(len(scores), previous)
    (factor, _, _), *_ = detector.factors(streams, scores[:, None], scores[:, None])
    made: NDArray = factor @ MASS
    return made


@pytest.mark.parametrize("member", range(len(MEMBERS)))
def test_no_bet_is_favourable_within_the_class(member: int) -> None:
    slack, quantile = MEMBERS[member]
    scores = quantile(GAUSSIAN)
    lower, upper = (np.clip(f(GAUSSIAN), -CLIP, CLIP) for f in (slack.lower, slack.upper))
    clipped = np.clip(scores, -CLIP, CLIP)
    assert np.all((lower - 1e-9 <= clipped) & (clipped <= upper + 1e-9)), "no member"
    detector = Detector(slack)
    for previous in (-3.0, 0.0, 1.0, 50.0):
        assert expectations(detector, scores, previous).max() <= 1 + 1e-9


def test_bets_are_fair_without_slack_and_favourable_outside_the_class() -> None:
    exact = Detector()
    assert expectations(exact, GAUSSIAN, 2.0) == pytest.approx(1.0, abs=1e-9)
    for slack, wrong in ((Slack(1.25, 0.1), 2.0), (Slack(1.25, 0.1), 0.4)):
        assert expectations(Detector(slack), wrong * GAUSSIAN, 0.0).max() > 1.2
    shifted = expectations(Detector(Slack(1.25, 0.1)), GAUSSIAN + 1.0, 0.0)
    assert shifted.max() > 1.5


def test_the_mean_over_an_interval_is_that_of_scores_inside_it() -> None:
    detector = Detector(Slack(1.1, 0.1))
    low, high = np.array([0.5, -np.inf]), np.array([1.5, -2.0])
    (mean, _, _), *_ = detector.factors(np.ones(2), low[:, None], high[:, None])
    for i in range(2):
        inside = (low[i] < GAUSSIAN) & (high[i] > GAUSSIAN)
        streams, scores = np.ones(inside.sum()), GAUSSIAN[inside, None]
        (factor, _, _), *_ = detector.factors(streams, scores, scores)
        assert mean[:, i] == pytest.approx(factor @ MASS[inside] / MASS[inside].sum(), rel=1e-6)


def test_narrow_bets_are_on_scores_times_kappa_and_wide_ones_on_scores_over_kappa() -> None:
    for ratio, factor in ((2.0, 1 / 1.5), (0.5, 1.5)):
        of: tuple[tuple[Alternative, ...], ...] = ((Scale(ratio),),)
        plain, wide = (Detector(slack, alternatives=of) for slack in (Slack(), Slack(1.5)))
        scores = np.array([0.25, 1.0, 1.75])
        z, scaled = (
            next(iter(d.factors(np.zeros(3), x[:, None], x[:, None])))[0]
            for d, x in ((wide, scores), (plain, scores * factor))
        )
        assert z == pytest.approx(scaled, rel=0.12)  # but for a cell of the grid
