"""Samplers of commands: within their limits, from the documented distribution."""

from __future__ import annotations

import numpy as np
import pytest

import retwin as rt
from retwin.twins.commands.ramps import ramps_and_holds
from retwin.twins.commands.samplers import (
    HoldSampler,
    MultisineSampler,
    RampSampler,
    RecordedSampler,
)

RATE = 50.0
SAMPLER = RampSampler((0.0, -2.0), (10.0, -1.0), RATE, 8.0, segments=4, ramp_durations=(0.2, 0.6))


def draw(count: int = 50, seed: int = 0, onsets: np.ndarray | None = None) -> np.ndarray:
    return SAMPLER.sample(count, rng=np.random.default_rng(seed), onsets=onsets)


def test_commands_ramp_and_hold_within_the_limits() -> None:
    commands = draw()
    assert commands.shape == (50, 400, 2)
    assert commands.dtype == np.float32
    assert (commands >= SAMPLER.low).all()
    assert (commands <= SAMPLER.high).all()
    np.testing.assert_allclose(commands[:, 0], [[5.0, -1.5]] * 50)
    for segment in range(4):
        held = commands[:, 100 * segment + 31 : 100 * segment + 100]
        assert np.ptp(held, axis=1).max() < 1e-5
    levels = commands[:, 99::100].reshape(-1, 2)
    # Uniform: mean and standard deviation of 200 draws within four of their standard errors.
    np.testing.assert_allclose(levels.mean(axis=0), [5.0, -1.5], atol=4 * 10 / np.sqrt(12 * 200))
    np.testing.assert_allclose(levels.std(axis=0), np.array([10, 1]) / np.sqrt(12), rtol=0.2)


def test_ramps_have_the_lengths_asked_for() -> None:
    moving = np.abs(np.diff(draw(), axis=1)) > 1e-6
    lengths = {int(n) for n in moving[:, :100].sum(axis=1).ravel()}
    assert lengths == {10, 30}


def test_ramps_are_those_of_a_loop_over_all_samples() -> None:
    """To the last digit, wherever ramps lie: overlapping, left out, beyond the end."""
    rng = np.random.default_rng(0)
    shape = (70, 5, 3)
    start, levels = rng.normal(size=(70, 3)), rng.normal(size=shape)
    spans, onsets = (
        rng.integers(1, 80, size=shape),
        60.0 * np.arange(5) + rng.uniform(0, 40, (70, 5)),
    )
    onsets[rng.random((70, 5)) < 0.2] = np.nan
    onsets[:, 3] = np.nan
    plain = np.repeat(start[:, None], 300, axis=1)
    before = start
    for segment in range(5):
        elapsed = np.arange(300) - onsets[:, segment, None]
        fraction = np.clip(elapsed[..., None] / spans[:, None, segment], 0, 1)
        plain += (levels[:, segment] - before)[:, None] * np.nan_to_num(fraction)
        before = levels[:, segment]
    np.testing.assert_array_equal(ramps_and_holds(start, levels, spans, onsets, 300), plain)


def test_the_segments_are_those_that_were_drawn() -> None:
    segments = rt.Segments.from_commands(draw())
    assert segments.max_count == 4
    np.testing.assert_allclose(segments.start, [[0, 100, 200, 300]] * 50, atol=1e-3)


def test_onsets_are_drawn_from_what_was_seen_and_continued() -> None:
    seen = np.array([[7.0, 120.0, np.nan]]) / RATE
    segments = rt.Segments.from_commands(draw(onsets=seen))
    np.testing.assert_allclose(segments.start, [[7, 120, 220, 320]] * 50, atol=1e-3)
    assert np.array_equal(draw(onsets=np.empty((0, 4))), draw())
    overlapping = draw(onsets=np.array([[0.0, 1.0, 2.0, 3.0]]) / RATE)
    assert (overlapping >= SAMPLER.low).all()
    assert (overlapping <= SAMPLER.high).all()


@pytest.mark.parametrize("rate", [2.5, 50.0, 4096.0])
def test_the_same_times_at_every_rate(rate: float) -> None:
    ramps = RampSampler((0.0,), (1.0,), rate, 16.0, segments=2, ramp_durations=(4.0,))
    made = ramps.sample(3, rng=np.random.default_rng(0), onsets=np.array([[2.0, 9.2]]))
    segments = rt.Segments.from_commands(made)
    np.testing.assert_allclose(segments.start / rate, [[2.0, 9.2]] * 3, atol=1e-3)
    np.testing.assert_allclose(segments.settle / rate, [[6.0, 13.2]] * 3, atol=1e-3)
    assert ramps.steps == 16 * rate


def test_defaults_are_shares_of_the_duration() -> None:
    """The same share of a trajectory that lasts a second or a day."""
    for rate, duration in ((1000.0, 1.0), (1 / 60, 86_400.0)):
        ramps = RampSampler((0.0,), (1.0,), rate, duration, segments=4)
        moving = np.diff(ramps.sample(99, rng=np.random.default_rng(0)), axis=1) != 0
        assert 0.25 < moving.mean() < 0.55
        holds = HoldSampler((0.0,), (1.0,), rate, duration)
        changes = np.diff(holds.sample(99, rng=np.random.default_rng(0)), axis=1) != 0
        assert 5 < changes.sum(axis=1).mean() < 15


def test_same_seed_same_commands() -> None:
    assert draw().tobytes() == draw().tobytes()
    assert draw().tobytes() != draw(seed=1).tobytes()


@pytest.mark.parametrize(
    ("match", "changes"),
    [
        ("limits", {"low": (0.0, float("-inf"))}),
        ("limits", {"low": (11.0, -2.0)}),
        ("limits", {"low": (0.0,)}),
        ("limits", {"low": (), "high": ()}),
        ("start", {"start": (5.0, 0.0)}),
        ("start", {"start": (5.0,)}),
        ("segments", {"segments": 0}),
        ("ramp_durations: expected from 0.02 s, a sample, to 2 s", {"ramp_durations": (0.2, 2.1)}),
        ("ramp_durations", {"ramp_durations": (0.0,)}),
        ("ramp_durations", {"ramp_durations": (np.nan,)}),
        ("rate", {"rate": 0.0}),
        ("duration: expected at least two samples, 0.04 s", {"duration": 0.02}),
        ("duration", {"duration": np.inf}),
    ],
)
def test_settings_that_cannot_be_are_refused(match: str, changes: dict) -> None:
    settings = {"low": (0.0, -2.0), "high": (10.0, -1.0), "rate": RATE, "duration": 8.0}
    with pytest.raises(rt.InputError, match=match) as caught:
        RampSampler(**{**settings, "segments": 4, "ramp_durations": (0.2, 0.6), **changes})
    assert "\n" not in str(caught.value)


LOW, HIGH = (0.0, -2.0), (10.0, -1.0)
HOLDS = HoldSampler(LOW, HIGH, RATE, 8.0, hold_durations=(0.2, 0.6))
SINES = MultisineSampler(LOW, HIGH, RATE, 10.0, band=(0.1, 2.0), corner=0.5, weak=0.2)
RECORD = np.arange(2 * 50 * 3, dtype=float).reshape(2, 50, 3)


@pytest.mark.parametrize(
    "sampler",
    [HOLDS, SINES, RecordedSampler(RECORD, RATE, 0.4)],
    ids=lambda each: type(each).__name__,
)
def test_every_sampler_draws_what_it_is_asked_for(sampler) -> None:
    made = sampler.sample(7, rng=np.random.default_rng(3))
    width = 3 if isinstance(sampler, RecordedSampler) else 2
    assert made.shape == (7, sampler.steps, width)
    assert made.dtype == np.float32
    again = sampler.sample(7, rng=np.random.default_rng(3), onsets=np.array([[1.0]]))
    assert made.tobytes() == again.tobytes()
    assert made.tobytes() != sampler.sample(7, rng=np.random.default_rng(4)).tobytes()


def test_levels_are_held_for_as_long_as_asked() -> None:
    made = HOLDS.sample(300, rng=np.random.default_rng(0))
    assert (made >= LOW).all()
    assert (made <= HIGH).all()
    lengths, levels = [], []
    for row in made[..., 0]:
        changes = np.flatnonzero(np.diff(row)) + 1
        lengths += np.diff([0, *changes]).tolist()
        levels += row[[0, *changes]].tolist()
    assert {*lengths} == set(range(10, 31))
    # Uniform, up to the hold that the end cuts off and that was therefore not counted.
    assert np.mean(lengths) == pytest.approx(20, abs=0.3)
    assert np.mean(levels) == pytest.approx(5, abs=4 * 10 / np.sqrt(12 * len(levels)))
    changes = (np.diff(made, axis=1) != 0).any(axis=0)
    assert not (changes[:, 0] & changes[:, 1]).all(), "channels change for themselves"


def test_a_multisine_has_the_spectrum_asked_for() -> None:
    """Over a whole period sines are orthogonal: mean, deviation and lines are exact."""
    made = SINES.sample(40, rng=np.random.default_rng(0)).astype(float)
    power = np.abs(np.fft.rfft(made, axis=1) / 500) ** 2
    free = ((made > LOW) & (made < HIGH)).all(axis=1)  # where nothing was cut off
    assert free.mean() > 0.8
    for channel, (mean, deviation) in enumerate([(5.0, 10 / 6), (-1.5, 1 / 6)]):
        lines = power[free[:, channel], :, channel]
        np.testing.assert_allclose(made[free[:, channel], :, channel].mean(axis=1), mean, rtol=1e-5)
        np.testing.assert_allclose(made[free[:, channel], :, channel].std(axis=1), deviation, 1e-4)
        np.testing.assert_allclose(lines[:, 2:6] / lines[:, 1:2], 1, rtol=1e-3)
        np.testing.assert_allclose(lines[:, 6:21] / lines[:, 1:2], 0.04, rtol=1e-2)
        assert lines[:, 21:].max() < 1e-6 * lines[:, 1:].sum(axis=1).max()


def test_pieces_of_records_come_from_everywhere() -> None:
    made = RecordedSampler(RECORD, RATE, 0.4).sample(2000, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(np.diff(made, axis=1), 3)
    begins, counts = np.unique(made[:, 0, 0] // 3, return_counts=True)
    assert set(begins) == {*range(31), *range(50, 81)}, "every piece that fits into a record"
    assert counts.min() > 10
    whole = RecordedSampler(RECORD, RATE).sample(10, rng=np.random.default_rng(0))
    assert {row.tobytes() for row in whole} == {row.tobytes() for row in RECORD.astype(np.float32)}


def sines(**changes: object) -> MultisineSampler:
    settings = {"low": (0.0,), "high": (1.0,), "rate": RATE, "duration": 8.0, "band": (0.1, 2.0)}
    return MultisineSampler(**{**settings, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: HoldSampler((0.0,), (0.0,), RATE, 8.0), "limits"),
        (lambda: HoldSampler((0.0,), (1.0,), RATE, 0.02), "duration"),
        (lambda: HoldSampler((0.0,), (1.0,), RATE, 8.0, (0.0, 0.1)), "hold_durations"),
        (lambda: HoldSampler((0.0,), (1.0,), RATE, 8.0, (0.6, 0.5)), "hold_durations"),
        (lambda: sines(high=(np.inf,)), "limits"),
        (lambda: sines(duration=0.0), "duration"),
        (lambda: sines(mean=(2.0,)), "mean"),
        (lambda: sines(deviation=(-1.0,)), "mean"),
        (lambda: sines(mean=(0.5, 0.5)), "mean"),
        (lambda: sines(band=(2.0, 0.1)), "band"),
        (lambda: sines(band=(0.0, 2.0)), "band"),
        (lambda: sines(band=(0.1, 25.1)), "band: .* to 25 Hz"),
        (lambda: sines(corner=2.1), "corner"),
        (lambda: RecordedSampler(RECORD[0], RATE), r"shape \(50, 3\)"),
        (lambda: RecordedSampler(RECORD[:0], RATE), "shape"),
        (lambda: RecordedSampler(RECORD * np.nan, RATE), "NaN"),
        (lambda: RecordedSampler(RECORD, RATE, 1.02), "duration: expected at most 1 s"),
    ],
)
def test_samplers_that_cannot_be_are_refused(make, match: str) -> None:
    with pytest.raises(rt.InputError, match=match) as caught:
        make()
    assert "\n" not in str(caught.value)
