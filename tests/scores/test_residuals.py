"""Residual analysis of series whose correlations, spectra and errors are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter, welch
from scipy.stats import kstest

from retwin.scores import (
    autocorrelation,
    cross_correlation,
    decorrelated_after,
    error_by_amplitude,
    ljung_box,
    rms_over_time,
    spectra,
)


def coloured(rng: np.random.Generator, shape: tuple[int, ...], pole: float) -> NDArray:
    """A stationary autoregression of first order."""
    return lfilter([1], [1, -pole], rng.normal(size=(*shape[:-1], shape[-1] + 200)))[..., 200:]


def punctured(rng: np.random.Generator, values: NDArray) -> NDArray:
    """Values of which a block and every fourth sample or so are missing."""
    missing = rng.random(values.shape) < 0.25
    missing[..., 40:70] = True
    return np.where(missing, np.nan, values)


@pytest.mark.parametrize("gaps", [False, True])
def test_limits_hold_95_percent_of_white_noise_and_its_p_value_is_uniform(gaps: bool) -> None:
    rng = np.random.default_rng(0)
    outside, p = [], []
    for _ in range(600):
        noise = rng.normal(size=(2, 200))
        found = autocorrelation(punctured(rng, noise) if gaps else noise, 20)
        outside.append(found.outside.mean())
        p.append(ljung_box(found)[1])
    assert np.mean(outside) == pytest.approx(0.05, abs=0.01)
    assert np.mean(np.array(p) < 0.05) == pytest.approx(0.05, abs=0.03)
    assert kstest(p, "uniform").pvalue > 0.001


def test_the_statistic_is_that_of_ljung_and_box() -> None:
    noise = np.random.default_rng(1).normal(size=300)
    r = np.array([np.sum(noise[k:] * noise[: len(noise) - k]) for k in range(11)])
    r /= r[0]
    wanted = 300 * 302 * np.sum(r[1:] ** 2 / (300 - np.arange(1, 11)))
    found = autocorrelation(noise[None], 10)
    assert ljung_box(found)[0] == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize("gaps", [False, True])
def test_an_autoregression_has_its_correlations(gaps: bool) -> None:
    rng = np.random.default_rng(2)
    series = coloured(rng, (4, 5000), 0.8)
    found = autocorrelation(punctured(rng, series) if gaps else series)
    np.testing.assert_allclose(found.values[:5], 0.8 ** found.lags[:5], atol=0.04)
    assert ljung_box(found)[1] < 1e-12
    assert found.largest == 0


def test_slow_residuals_are_shown_at_more_lags() -> None:
    rng = np.random.default_rng(2)
    white, slow = (decorrelated_after(coloured(rng, (2, 4000), pole)) for pole in (0.0, 0.99))
    assert white == round(10 * np.log10(8000))
    assert 150 < slow <= 1000
    assert decorrelated_after(np.ones((1, 100))) == 25


def test_pairs_are_of_one_record_only() -> None:
    step = np.concatenate([np.ones((1, 50)), -np.ones((1, 50))])
    assert (autocorrelation(step, 5).values > 0.999).all()
    assert autocorrelation(step.reshape(1, -1), 5).values[-1] < 0.95


@pytest.mark.parametrize(("error", "command"), [(0.0, 0.95), (0.9, 0.8), (0.8, 0.97)])
def test_the_rate_of_false_positives_is_nominal(error: float, command: float) -> None:
    """Of independent series, white or coloured, 5 % of correlations are beyond their limits."""
    rng = np.random.default_rng(3)
    outside = []
    for _ in range(400):
        pair = coloured(rng, (2, 500), error), coloured(rng, (2, 500), command)
        outside.append(cross_correlation(*pair, 20).outside.mean())
    assert np.mean(outside) == pytest.approx(0.05, abs=0.02)


def test_the_rate_of_false_positives_is_nominal_with_gaps() -> None:
    rng = np.random.default_rng(4)
    outside = []
    for _ in range(400):
        error = punctured(rng, coloured(rng, (2, 500), 0.8))
        outside.append(cross_correlation(error, coloured(rng, (2, 500), 0.9), 20).outside.mean())
    assert np.mean(outside) == pytest.approx(0.05, abs=0.02)


def test_the_lag_of_a_command_is_found_with_its_sign() -> None:
    rng = np.random.default_rng(5)
    command = rng.normal(size=(2, 1000))
    error = 3 + 0.5 * rng.normal(size=command.shape)
    error[:, 7:] -= command[:, :-7]
    found = cross_correlation(error, command)
    assert found.lags[found.largest] == 7
    assert found.values[found.largest] == pytest.approx(-1 / np.sqrt(1.25), abs=0.05)
    np.testing.assert_array_equal(found.lags, -found.lags[::-1])


def test_series_that_do_not_vary_have_no_correlation() -> None:
    flat = np.zeros((1, 100))
    assert np.isnan(ljung_box(autocorrelation(flat))).all()
    assert not cross_correlation(flat, flat).outside.any()
    assert not autocorrelation(np.full((1, 100), np.nan)).outside.any()


def test_spectra_are_those_of_welch() -> None:
    series = coloured(np.random.default_rng(6), (1, 4096), 0.9)
    frequencies, found = spectra([series, 2 * series], 10.0, 256)
    wanted, density = welch(series[0], 10.0, nperseg=256)
    np.testing.assert_allclose(frequencies, wanted[1:])
    np.testing.assert_allclose(found, [density[1:], 4 * density[1:]])


def test_segments_with_gaps_are_left_out_of_spectra() -> None:
    rng = np.random.default_rng(7)
    time = np.arange(4000) / 50
    tone = np.sin(2 * np.pi * 5 * time)[None] + 0.01 * rng.normal(size=(1, 4000))
    broken = tone.copy()
    broken[:, 300::700] = np.nan
    frequencies, (density, _) = spectra([broken, tone], 50.0)
    assert frequencies[np.argmax(density)] == pytest.approx(5, abs=0.2)
    assert np.trapezoid(density, frequencies) == pytest.approx(0.5, rel=0.05)
    broken[:, ::10] = np.nan
    assert spectra([broken, tone], 50.0)[1].shape == (2, 0)


def test_errors_are_binned_by_amplitude_and_extrapolation_is_marked() -> None:
    rng = np.random.default_rng(8)
    value = rng.uniform(-3, 3, size=(3, 2000))
    error = np.where(np.abs(value) > 2, 5.0, 1.0) * rng.choice([-1, 1], size=value.shape)
    error[0, :100] = np.nan
    found = error_by_amplitude(error, value, (-2.0, 2.0))
    assert found.counts.sum() == 5900
    assert np.all(np.diff(found.centre) > 0)
    np.testing.assert_array_equal(found.extrapolated, np.abs(found.centre) > 2)
    np.testing.assert_allclose(found.rms, np.where(found.extrapolated, 5.0, 1.0))
    inside = ~found.extrapolated
    assert found.counts[inside].max() - found.counts[inside].min() <= 1


def test_an_amplitude_of_few_values_has_a_bin_for_each() -> None:
    value = np.tile([0.0, 1.0, 4.0], 30)[None]
    found = error_by_amplitude(value + 1, value, (0.0, 1.0))
    assert found.centre.tolist() == found.low.tolist() == found.high.tolist() == [0, 1, 4]
    assert found.rms.tolist() == [1, 2, 5]
    assert found.extrapolated.tolist() == [False, False, True]
    empty = error_by_amplitude(np.full((1, 5), np.nan), np.ones((1, 5)))
    assert len(empty.rms) == 0


def test_errors_over_time() -> None:
    error = np.repeat([[1.0, 2.0, np.nan]], 10, axis=1) * np.ones((2, 1))
    edges, rms = rms_over_time(error, 3)
    assert edges.tolist() == [0, 10, 20, 30]
    np.testing.assert_allclose(rms, [1, 2, np.nan])
    assert len(rms_over_time(error, 500)[1]) == 30
