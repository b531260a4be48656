"""Autoregressive disturbances with noise: estimates, the filter, and hostile residuals."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from retwin.errors import InputError
from retwin.monitor import Disturbance, DisturbanceState, fit_disturbance


def simulated(coefficients: list[float], noise: float, shape: tuple[int, int]) -> NDArray:
    rng = np.random.default_rng(0)
    drawn = rng.normal(size=(shape[0], shape[1] + 500))
    state = lfilter([1], [1, *(-c for c in coefficients)], drawn, axis=1)[:, 500:]
    return 20 + state + noise * rng.normal(size=shape)


@pytest.fixture(scope="module")
def slow() -> tuple[NDArray, Disturbance]:
    values = simulated([0.95], 1.0, (40, 500))
    values[np.random.default_rng(1).random(values.shape) < 0.1] = np.nan
    return values, fit_disturbance(values, max_order=2, folds=2)


def test_the_parameters_of_a_noisy_autoregression_are_found(
    slow: tuple[NDArray, Disturbance],
) -> None:
    _, model = slow
    first_order = model.coefficients[:, 1:].any(axis=1) == 0
    assert first_order.mean() > 0.7
    chosen = model.coefficients[first_order, 0]
    assert np.median(chosen) == pytest.approx(0.95, abs=0.03)
    assert np.median(model.process[first_order]) == pytest.approx(1.0, rel=0.25)
    assert np.median(model.measurement[first_order]) == pytest.approx(1.0, rel=0.25)


def test_held_out_errors_are_white_and_of_unit_variance(slow: tuple[NDArray, Disturbance]) -> None:
    values, model = slow
    errors = model.held_out
    assert np.array_equal(np.isnan(errors), np.isnan(values))
    assert np.nanstd(errors) == pytest.approx(1.0, abs=0.05)
    assert abs(np.nanmean(errors[:, 1:] * errors[:, :-1])) < 0.03


def test_the_filter_is_that_of_a_general_state_space_model() -> None:
    from statsmodels.tsa.statespace.sarimax import SARIMAX

    values = simulated([1.2, -0.5], 0.7, (1, 60))
    values[0, [5, 6, 30]] = np.nan
    nothing = np.empty((1, 0))
    model = Disturbance(
        np.array([[1.2, -0.5]]), np.full(1, 20.0), np.ones(1), np.full(1, 0.49), nothing, nothing
    )
    _, errors, deviation = model.run(model.start(), values)
    reference = SARIMAX(values[0] - 20, order=(2, 0, 0), measurement_error=True)
    found = reference.filter([1.2, -0.5, 0.49, 1.0])
    expected = found.forecasts_error[0] / np.sqrt(found.forecasts_error_cov[0, 0])
    assert deviation[0] ** 2 == pytest.approx(found.forecasts_error_cov[0, 0], rel=1e-6)
    seen = ~np.isnan(values[0])
    assert errors[0, seen] == pytest.approx(expected[seen], rel=1e-6)
    assert np.isnan(errors[0, ~seen]).all()


@pytest.mark.slow
def test_an_oscillation_needs_the_second_order() -> None:
    values = simulated([1.6, -0.9], 0.3, (8, 300))
    for order, white in ((1, False), (2, True)):
        errors = fit_disturbance(values, max_order=order, folds=2).held_out
        assert (abs(np.mean(errors[:, 1:] * errors[:, :-1])) < 0.1) == white


@pytest.mark.slow
def test_residuals_that_alternate_and_persist_are_made_white() -> None:
    """As where a filter follows too fast: a slow autoregression with white noise does not fit."""
    fast, slow = np.random.default_rng(2).normal(size=(2, 4, 2000))
    values = 20 + lfilter([1, -0.5], [1], fast) + 0.1 * lfilter([1], [1, -0.98], slow)
    errors = fit_disturbance(values, folds=2).held_out
    assert abs(np.mean(errors[:, 1:] * errors[:, :-1])) < 0.05


def test_bytes_do_not_depend_on_grouping(slow: tuple[NDArray, Disturbance]) -> None:
    values, model = slow
    whole, errors, _ = model.run(model.start(), values[:, :50])
    state: DisturbanceState = model.start()
    steps = []
    for t in range(50):
        state, found, _ = model.step(state, values[:, t])
        steps.append(found)
    assert np.array(steps).T.tobytes() == errors.tobytes()
    assert state.mean.tobytes() == whole.mean.tobytes()
    assert state.covariance.tobytes() == whole.covariance.tobytes()


def test_a_glitch_is_scored_and_forgotten_and_a_new_level_is_followed(
    slow: tuple[NDArray, Disturbance],
) -> None:
    values, model = slow
    for glitch in (1e300, -1e9, np.inf):
        hostile = values[:, :200].copy()
        hostile[:, 50] = glitch
        state, errors, _ = model.run(model.start(), hostile)
        assert np.all(np.abs(errors[:, 50]) > 100)
        assert np.nanmax(np.abs(errors[:, 51:])) < 6
        assert np.isfinite(state.mean).all()
    jumped = values[:, :200].copy()
    jumped[:, 50:] += 1000 * np.sqrt(model.process + model.measurement)[:, None]
    _, errors, _ = model.run(model.start(), jumped)
    assert np.all(
        np.abs(errors[:, 50:]).max(axis=1, where=~np.isnan(errors[:, 50:]), initial=0) > 100
    )


def test_what_cannot_be_estimated_is_refused() -> None:
    for wrong in (np.zeros((2, 20)), np.full((1, 90), np.nan), np.zeros(90)):
        with pytest.raises(InputError, match="at least 50 residuals per stream"):
            fit_disturbance(wrong)
    gap = np.full((1, 400), np.nan)
    gap[0, :60] = np.arange(60) % 7
    with pytest.raises(InputError, match="at least 25 residuals outside"):
        fit_disturbance(gap)
    with pytest.raises(InputError, match="residuals that vary"):
        fit_disturbance(np.ones((2, 90)))
