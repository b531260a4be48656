"""Seconds and Hz as samples, and values between samples."""

from __future__ import annotations

import numpy as np
import pytest

import retwin as rt
from retwin.arrays import interpolated
from retwin.times import stride_of, to_samples


@pytest.mark.parametrize("rate", [1 / 86_400, 0.25, 29.97, 100.0, 8192.0])
def test_samples_come_back_from_their_times(rate: float) -> None:
    samples = range(0, 3000, 7)
    assert [to_samples(each / rate, rate) for each in samples] == list(samples)


def test_a_stride_is_a_whole_number_of_samples() -> None:
    assert stride_of(100.0, 10.0) == 10
    assert stride_of(29.97, 29.97 / 3) == 3
    assert stride_of(100.0, None) == stride_of(100.0, 100.0) == 1
    for lower in (30.0, 101.0, 200.0, 0.0, -10.0, np.nan):
        with pytest.raises(rt.InputError, match=r"sensor_rate: expected 100 Hz, .* whole part"):
            stride_of(100.0, lower, argument="sensor_rate")


@pytest.mark.parametrize("stride", [1, 10])
def test_values_between_samples_are_those_of_numpy(stride: int) -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(3, 9, 2))
    at = rng.uniform(-5.0, 9.5 * stride, size=(3, 50))
    known = stride * np.arange(9)
    wanted = [
        [np.interp(at[row], known, values[row, :, column]) for column in range(2)]
        for row in range(3)
    ]
    np.testing.assert_allclose(interpolated(values, at, stride), np.moveaxis(wanted, 1, 2))
    alone = interpolated(values, at[1], stride)
    np.testing.assert_allclose(alone[1], np.moveaxis(wanted, 1, 2)[1])
    np.testing.assert_array_equal(interpolated(values[:, :1], at, stride)[:, 0], values[:, 0])
