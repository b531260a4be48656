"""Seconds and Hz as samples, and values between samples."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import retwin as rt
from retwin.arrays import interpolated
from retwin.cli.options import seconds_of
from retwin.times import sample_rate, stride_of, to_samples
from retwin.twins.time_step import steps_per_sample


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


def test_a_stride_leaves_two_samples() -> None:
    assert stride_of(100.0, 10.0, steps=11) == 10
    for lower in (10.0, 1e-9, 1e-320):
        with pytest.raises(rt.InputError, match=r"at least two of the 10|whole part"):
            stride_of(100.0, lower, steps=10)


@pytest.mark.parametrize("rate", [1e308, 1e13, 1e-10, 1e-300, 0.0, -1.0, np.nan, np.inf, True])
def test_rates_without_sense_are_refused(rate: float, tmp_path: Path) -> None:
    """Wherever they come from; the durations of some would be infinite, of others 0."""
    assert sample_rate("rate", 1e-9) == 1e-9
    assert sample_rate("rate", 1e12) == 1e12
    channels = rt.Channels.numbered("x", 1)
    values = np.zeros((3, 5, 1))
    file = tmp_path / "a.npz"
    rt.save(rt.Trajectories(values, values, values, rate=10.0), file)
    with pytest.raises(rt.InputError, match=r"^sensor_rate: expected a"):
        sample_rate("sensor_rate", rate)
    for make in (
        lambda: rt.Trajectories(values, values, values, rate=rate),
        lambda: rt.FunctionTwin(np.copy, channels, channels, rate),
        lambda: rt.twins.HoldSampler((0.0,), (1.0,), rate, 10.0),
        lambda: rt.Segments.given([[1.0]], [[2.0]], steps=100, rate=rate),
        lambda: rt.load(file, rate=rate),
        lambda: rt.StudyPlan(rate=rate),
    ):
        with pytest.raises(rt.InputError, match=r"^rate: expected a"):
            make()


@pytest.mark.parametrize("step", [5e-324, 1e-320, 1.0])
def test_a_step_without_sense_is_refused(step: float) -> None:
    with pytest.raises(rt.InputError, match=r"step: expected a step that divides"):
        steps_per_sample(1e3, step)


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


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("free", None),
        ("0.5", 0.5),
        ("90 s", 90.0),
        ("15min", 900.0),
        ("2h", 7200.0),
        ("1e-1s", 0.1),
    ],
)
def test_a_time_of_an_option_has_a_unit(text: str, seconds: float | None) -> None:
    assert seconds_of("--warm-up", text) == seconds


@pytest.mark.parametrize("text", ["", "0", "-1s", "2 weeks", "inf", "nan", "1e999h"])
def test_what_is_no_time_is_shown_as_it_was_written(text: str) -> None:
    with pytest.raises(rt.InputError, match="90s, 15min, 2h or 1d") as raised:
        seconds_of("--warm-up", text)
    assert raised.value.got == text
