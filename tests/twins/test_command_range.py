"""What of commands is outside the range of others, in value, speed and spectrum."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

import retwin as rt
from retwin.twins.commands.range import CommandRange, extremes, part_of
from retwin.twins.compiled import commands as compiled_commands

RATE, STEPS = 610.0, 610
INPUTS = rt.Channels(("a", "b"), ("V", "1"))
TIME = np.arange(STEPS)[:, None] / RATE


def sines(count: int, frequency: float, seed: int) -> np.ndarray:
    """Sines (count, T, 2) of random phases and of amplitudes up to 1."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi, (count, 1, 2))
    return rng.uniform(0.5, 1, (count, 1, 2)) * np.sin(2 * np.pi * frequency * TIME + phase)


@pytest.fixture(scope="module")
def trained() -> CommandRange:
    return CommandRange.of(sines(40, 3.0, 0), RATE)


def test_the_range_is_that_of_the_commands(trained: CommandRange) -> None:
    assert max(trained.high) == pytest.approx(1.0, abs=0.05)
    assert max(trained.speed) == pytest.approx(2 * np.pi * 3, rel=0.05)
    assert trained.band == pytest.approx((5, 5), abs=1.1), "3 Hz and the width of the window"
    assert CommandRange.from_json(asdict(trained)) == trained


def test_other_draws_of_the_same_commands_are_inside(trained: CommandRange) -> None:
    other = sines(40, 3.0, 1)
    assert trained.outside(other, RATE, INPUTS) == ""
    assert trained.outside(other[:, : STEPS // 2], RATE, INPUTS) == "", "shorter ones too"


def test_each_way_to_be_outside_is_named_with_its_channel(trained: CommandRange) -> None:
    wide, fast, high = (sines(20, 3.0, seed) for seed in (2, 3, 4))
    wide[7, :, 1] *= 2
    fast[3, 300:, 0] = fast[3, 299, 0] * -1
    high[:, :, 0] += 0.2 * np.sin(2 * np.pi * 68 * TIME[:, 0])
    found = trained.outside(wide, RATE, INPUTS)
    assert "b is" in found
    assert "a " not in found
    assert found.endswith("in 1 of 20 trajectories")
    assert "a changes by" in trained.outside(fast, RATE, INPUTS)
    found = trained.outside(high, RATE, INPUTS)
    assert "of its power above 4 Hz" in found
    assert found.endswith("in 20 of 20 trajectories")


def test_a_weak_signal_of_other_frequencies_is_outside(trained: CommandRange) -> None:
    """Its amplitude and its speed are within the range: the spectrum alone shows it."""
    weak = 0.03 * sines(5, 68.0, 0)
    scores = trained.scores(weak, RATE)
    assert (scores[:, :2] <= 1).all()
    assert (scores[:, 2] > 1).all()


def test_of_a_part_as_many_spectra_are_compared_as_of_the_whole(trained: CommandRange) -> None:
    weak = 0.03 * sines(40, 68.0, 0)
    assert ((trained.scores(weak, RATE) > 1).any(axis=(1, 2))).sum() == 40
    for whole, compared in ((400, 40), (4000, 10), (1_000_000, 1)):
        with part_of(whole):
            scores = trained.scores(weak, RATE)
        assert ((scores > 1).any(axis=(1, 2))).sum() == compared


def test_rounding_and_constants_are_no_frequencies(trained: CommandRange) -> None:
    rounded = 1e-4 * np.random.default_rng(0).normal(size=(3, STEPS, 2))
    assert trained.outside(rounded, RATE, INPUTS) == ""
    still = CommandRange.of(np.ones((3, 50, 2)), RATE)
    assert still.outside(np.ones((2, 50, 2)), RATE, INPUTS) == ""
    assert "a is 1.1" in still.outside(np.full((2, 50, 2), 1.1), RATE, INPUTS)


def test_a_constant_channel_has_no_tolerance_in_its_unit() -> None:
    """Of 10 mV, in V, 19 mV is nearly twice as much."""
    still = CommandRange.of(np.full((3, 50, 2), 0.01), RATE)
    assert "a is 0.019" in still.outside(np.full((2, 50, 2), 0.019), RATE, INPUTS)
    assert still.outside(np.full((2, 50, 2), np.float32(0.01)), RATE, INPUTS) == "", "rounding"
    zero = CommandRange.of(np.zeros((3, 50, 2)), RATE)
    assert "b is -1e-06" in zero.outside(np.full((2, 50, 2), -1e-6), RATE, INPUTS)
    assert zero.outside(np.zeros((2, 50, 2)), RATE, INPUTS) == ""


@pytest.mark.parametrize("shape", [(5, 1, 3), (3, 2, 1), (7, 1000, 4), (2, 77, 256), (3, 9, 300)])
def test_compiled_extremes_are_those_of_numpy(
    shape: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    values = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    unknown = values.copy()
    unknown[-1, -1, -1] = np.nan
    found = [extremes(values), extremes(unknown)]
    monkeypatch.setattr(compiled_commands, "library", lambda: None)
    for made, given in zip(found, (values, unknown), strict=True):
        np.testing.assert_array_equal(made, extremes(given))
    assert np.isnan(found[1][0]).any()


def test_a_single_sample_has_a_range() -> None:
    points = CommandRange.of(np.linspace(0, 1, 40).reshape(20, 1, 2), RATE)
    assert points.outside(np.full((1, 1, 2), 0.5), RATE, INPUTS) == ""
    assert "a is 2" in points.outside(np.full((1, 1, 2), 2.0), RATE, INPUTS)


def test_a_single_sample_is_compared_with_trajectories(trained: CommandRange) -> None:
    assert trained.outside(np.full((1, 1, 2), 0.5), RATE, INPUTS) == ""
    assert "a is 2" in trained.outside(np.full((1, 1, 2), 2.0), RATE, INPUTS)
