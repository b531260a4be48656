"""Integrals by a grid that refines itself, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from retwin.diagnosis.inversion.adaptive_grid import integrate


def gaussian(points: np.ndarray, mean: float, deviation: float) -> np.ndarray:
    return -0.5 * ((points - mean) / deviation) ** 2


@pytest.mark.parametrize("deviation", [1e-1, 1e-2, 1e-4])
def test_a_gaussian_over_a_box_of_numbers_and_whole_numbers(deviation: float) -> None:
    def log_likelihood(points: np.ndarray) -> np.ndarray:
        return gaussian(points[:, 0], 0.42, deviation) + gaussian(points[:, 1], 4321, 20.0)

    limits, whole = np.array([[0.0, 1.0], [0, 9999]]), np.array([False, True])
    found = integrate(log_likelihood, limits, whole, 0.9)
    wanted = np.log(deviation * np.sqrt(2 * np.pi)) + np.log(20 * np.sqrt(2 * np.pi) / 1e4)
    assert found.evidence == pytest.approx(wanted, abs=0.1)
    np.testing.assert_allclose(found.mean, [0.42, 4321], atol=5 * deviation * 0.1 + 1)
    np.testing.assert_allclose(found.best, [0.42, 4321], atol=deviation + 10)
    half = 1.645 * np.array([deviation, 20.0])
    # Cells that are no finer than needed make intervals a little wider.
    np.testing.assert_allclose(found.high - found.low, 2.1 * half, rtol=0.2)


def test_two_modes_are_both_found() -> None:
    def log_likelihood(points: np.ndarray) -> np.ndarray:
        return np.logaddexp(gaussian(points[:, 0], 0.11, 0.01), gaussian(points[:, 0], 0.87, 0.01))

    found = integrate(log_likelihood, np.array([[0.0, 1.0]]), np.array([False]), 0.9)
    assert found.evidence == pytest.approx(np.log(2 * 0.01 * np.sqrt(2 * np.pi)), abs=0.05)
    assert (found.low[0], found.high[0]) == pytest.approx((0.11, 0.87), abs=0.02)


def test_an_effect_that_is_small_beside_its_limits_is_found() -> None:
    """An offset of 2.5 deviations: on an even grid no centre is closer to it than to none."""
    measured = 0.4 * np.random.default_rng(0).normal(size=100) + (np.arange(100) >= 60)

    def log_likelihood(points: np.ndarray) -> np.ndarray:
        size, onset = points.T[..., None]
        return gaussian(measured - size * (np.arange(100) >= onset), 0.0, 0.4).sum(axis=1)

    limits, whole = np.array([[-280.0, 280.0], [0, 99]]), np.array([False, True])
    found = integrate(log_likelihood, limits, whole, 0.9, effect=0)
    assert found.low[0] < 1 < found.high[0]
    assert found.low[1] - 1 < 60 < found.high[1] + 1
    even = integrate(log_likelihood, limits, whole, 0.9)
    assert even.evidence < found.evidence - 10


def test_what_is_known_stays_and_what_is_impossible_counts_as_0() -> None:
    def log_likelihood(points: np.ndarray) -> np.ndarray:
        return np.where(points[:, 1] > 3, -np.inf, 0.0)

    limits, whole = np.array([[2.0, 2.0], [0, 9]]), np.array([False, True])
    found = integrate(log_likelihood, limits, whole, 0.9)
    assert found.evidence == pytest.approx(np.log(0.4))
    assert found.mean.tolist() == [2.0, 1.5]
    nothing = integrate(lambda points: np.full(len(points), -np.inf), limits, whole, 0.9)
    assert nothing.evidence == -np.inf
    assert np.isnan(nothing.mean).all()


def test_a_maximum_at_a_cliff_is_found() -> None:
    def log_likelihood(points: np.ndarray) -> np.ndarray:
        beyond = points[:, 0] - 357
        return np.where(beyond < 0, -1e5, -9.0 * beyond)

    found = integrate(log_likelihood, np.array([[0, 999]]), np.array([True]), 0.9)
    assert found.best.tolist() == [357]
    assert found.evidence == pytest.approx(-np.log(1000), abs=0.01)
