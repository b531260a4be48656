"""`ForecastErrors`: the size of bands, and where they are given."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import norm

import retwin as rt
from retwin.update.forecast_errors import (
    USUAL,
    ForecastErrors,
    predictive_deviation,
    range_excess,
    value_range,
)
from retwin.update.forecasts import Forecasts, LeftOut, calibrate_forecasts, errors_drift

OUTPUT = rt.Channels(("y",), ("m",))


@pytest.mark.parametrize("independent", [6, 12, 200])
def test_bands_of_few_independent_errors_hold_further_ones(independent: int) -> None:
    rng = np.random.default_rng(0)
    held = []
    for _ in range(4000):
        errors = rng.normal(size=independent)
        size = predictive_deviation(np.repeat(errors, 10), independent)
        held.append(abs(rng.normal()) <= USUAL * size)
    # Quantiles of a handful of errors are rough.
    assert np.mean(held) == pytest.approx(0.9, abs=0.03)


def errors_with(memory: float, beyond: tuple[float, float] = (0.1, 0.1)) -> ForecastErrors:
    one, low, high = np.ones((1, 1)), np.array([0.0, -1.0]), np.array([2.0, 1.0])
    return ForecastErrors(np.array([np.inf]), one, one, one, memory, low, high, np.array(beyond))


def test_bands_end_where_a_value_leaves_its_range_until_that_is_forgotten() -> None:
    values = np.zeros((3, 50, 2))
    values[0, 10, 0] = 2.1  # within a tenth of the width
    values[1, 10, 0] = 2.3
    values[2, 10, 1] = np.nan
    values[2, 20:, 1] = -1.5
    outside = errors_with(0.5).outside(values, rate=10.0)
    assert not outside[0].any()
    np.testing.assert_array_equal(np.flatnonzero(outside[1]), np.arange(10, 16))
    np.testing.assert_array_equal(np.flatnonzero(outside[2]), np.arange(20, 50))
    # Each value as far as it was shown that it may.
    outside = errors_with(0.5, (0.1, 1.0)).outside(values, rate=10.0)
    np.testing.assert_array_equal(np.flatnonzero(outside[1]), np.arange(10, 16))
    assert not outside[2].any()


def test_excess_is_in_widths_of_the_range_and_of_a_constant_in_its_size() -> None:
    calibration = np.array([[[0.0, 4.0, np.nan], [2.0, 4.0, np.nan]]])
    low, high = value_range(calibration)
    np.testing.assert_array_equal([low, high], [[0.0, 4.0, 0.0], [2.0, 4.0, 0.0]])
    further = np.array([[[3.0, 4.0, np.nan], [1.0, 5.0, np.nan], [1.0, 4.0, np.nan]]])
    np.testing.assert_allclose(range_excess(further, low, high), [[0.5, 0.25, 0.0]])


def test_saved_values_that_do_not_fit_are_refused() -> None:
    values = errors_with(1.0).values
    again = ForecastErrors.of(values)
    assert again is not None
    assert again.values == values
    assert (again.longest, again.drifts) == (np.inf, False)
    limited = ForecastErrors.of(values | {"longest": 3.0, "drifts": True})
    assert limited is not None
    assert (limited.values["longest"], limited.values["drifts"]) == (3.0, True)
    np.testing.assert_array_equal(np.flatnonzero(limited.late(35, 10.0)), np.arange(30, 35))
    before = {name: each for name, each in values.items() if name not in ("longest", "drifts")}
    before["beyond"] = 0.1
    assert ForecastErrors.of(before).values == values  # type: ignore[union-attr]
    with pytest.raises(rt.InputError, match="ranges from low to high"):
        ForecastErrors.of(values | {"low": [5.0, 5.0]})


@pytest.mark.parametrize("trend", [0.0, 0.5])
def test_errors_drift_where_their_mean_has_a_trend(trend: float) -> None:
    """Independent and correlated ones; by chance, they seem to do so once in a hundred times."""
    rng, time = np.random.default_rng(0), np.linspace(-1, 1, 500)
    found = []
    for memory in (0.0, 0.9) * 50:
        noise = lfilter([1 - memory], [1, -memory], rng.normal(size=(4, 600)))[:, 100:]
        made = trend * time + noise
        made[:, 200:220] = np.nan
        found.append(errors_drift(made[..., None]))
    assert np.mean(found) == pytest.approx(float(trend > 0), abs=0.05)
    assert not errors_drift(np.full((1, 9, 2), np.nan))


@pytest.mark.parametrize("whole", [True, False])
def test_bands_allow_for_records_that_differ_where_whole_ones_are_left_out(*, whole: bool) -> None:
    rng, held, shape = np.random.default_rng(0), [], (5, 200, 1)
    nothing, one = np.zeros(shape), rt.Channels(("u",), ("1",))
    left_out = np.ones((1, 200), dtype=bool)
    left_out[:, 0] = whole  # else the first sample of a record was fitted
    for _ in range(100):
        observed = np.exp(0.6 * rng.normal(size=(5, 1, 1))) * rng.normal(size=shape)
        data = rt.Trajectories(nothing, nothing, observed, 1.0, inputs=one, outputs=OUTPUT)
        ahead = Forecasts(nothing[None, :1], nothing[None, :1])
        parts = [
            LeftOut(ahead, nothing[:1], data[[i]], left_out, np.zeros(2), edge=False)
            for i in range(5)
        ]
        deviation = calibrate_forecasts(data, parts, [1]).deviation[-1, 0]
        further = np.exp(0.6 * rng.normal(size=400))
        held.append(np.mean(2 * norm.cdf(USUAL * deviation / further) - 1))
    assert np.mean(held) == pytest.approx(0.9 if whole else 0.875, abs=0.01)
