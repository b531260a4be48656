"""Samplers of commands: within their limits, from the documented distribution."""

from __future__ import annotations

import numpy as np
import pytest

import retwin as rt
from retwin.twins.ramps import ramps_and_holds
from retwin.twins.samplers import (
    HoldSampler,
    MultisineSampler,
    RampSampler,
    RecordedSampler,
)

SAMPLER = RampSampler(low=(0.0, -2.0), high=(10.0, -1.0), segments=4, steps=400, ramps=(10, 30))


def draw(count: int = 50, seed: int = 0, timing: np.ndarray | None = None) -> np.ndarray:
    return SAMPLER.sample(count, rng=np.random.default_rng(seed), timing=timing)


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


def test_timing_is_drawn_from_what_was_seen_and_continued() -> None:
    seen = np.array([[7.0, 120.0, np.nan]])
    segments = rt.Segments.from_commands(draw(timing=seen))
    np.testing.assert_allclose(segments.start, [[7, 120, 220, 320]] * 50, atol=1e-3)
    assert np.array_equal(draw(timing=np.empty((0, 4))), draw())
    overlapping = draw(timing=np.array([[0.0, 1.0, 2.0, 3.0]]))
    assert (overlapping >= SAMPLER.low).all()
    assert (overlapping <= SAMPLER.high).all()


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
        ("ramps: expected durations from 1 to 100", {"ramps": (10, 101)}),
        ("ramps", {"ramps": ()}),
        ("ramps", {"ramps": (0,)}),
    ],
)
def test_settings_that_cannot_be_are_refused(match: str, changes: dict) -> None:
    settings = {"low": (0.0, -2.0), "high": (10.0, -1.0), "segments": 4, "steps": 400}
    with pytest.raises(rt.InputError, match=match) as caught:
        RampSampler(**{**settings, "ramps": (10, 30), **changes})
    assert "\n" not in str(caught.value)


LOW, HIGH = (0.0, -2.0), (10.0, -1.0)
HOLDS = HoldSampler(LOW, HIGH, steps=400, hold=(10, 30))
SINES = MultisineSampler(LOW, HIGH, steps=500, period=500, slow=5, fast=20, weak=0.2)
RECORD = np.arange(2 * 50 * 3, dtype=float).reshape(2, 50, 3)


@pytest.mark.parametrize(
    "sampler", [HOLDS, SINES, RecordedSampler(RECORD, 20)], ids=lambda each: type(each).__name__
)
def test_every_sampler_draws_what_it_is_asked_for(sampler) -> None:
    made = sampler.sample(7, rng=np.random.default_rng(3))
    width = 3 if isinstance(sampler, RecordedSampler) else 2
    assert made.shape == (7, sampler.steps, width)
    assert made.dtype == np.float32
    again = sampler.sample(7, rng=np.random.default_rng(3), timing=np.array([[1.0]]))
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
    made = RecordedSampler(RECORD, 20).sample(2000, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(np.diff(made, axis=1), 3)
    begins, counts = np.unique(made[:, 0, 0] // 3, return_counts=True)
    assert set(begins) == {*range(31), *range(50, 81)}, "every piece that fits into a record"
    assert counts.min() > 10
    whole = RecordedSampler(RECORD).sample(10, rng=np.random.default_rng(0))
    assert {row.tobytes() for row in whole} == {row.tobytes() for row in RECORD.astype(np.float32)}


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: HoldSampler((0.0,), (0.0,)), "limits"),
        (lambda: HoldSampler((0.0,), (1.0,), steps=1), "steps"),
        (lambda: HoldSampler((0.0,), (1.0,), hold=(0, 5)), "hold"),
        (lambda: HoldSampler((0.0,), (1.0,), hold=(6, 5)), "hold"),
        (lambda: MultisineSampler((0.0,), (np.inf,)), "limits"),
        (lambda: MultisineSampler((0.0,), (1.0,), steps=0), "steps"),
        (lambda: MultisineSampler((0.0,), (1.0,), mean=(2.0,)), "mean"),
        (lambda: MultisineSampler((0.0,), (1.0,), deviation=(-1.0,)), "mean"),
        (lambda: MultisineSampler((0.0,), (1.0,), mean=(0.5, 0.5)), "mean"),
        (lambda: MultisineSampler((0.0,), (1.0,), slow=9, fast=5), "slow"),
        (lambda: MultisineSampler((0.0,), (1.0,), period=0), "period"),
        (lambda: RecordedSampler(RECORD[0]), r"shape \(50, 3\)"),
        (lambda: RecordedSampler(RECORD[:0]), "shape"),
        (lambda: RecordedSampler(RECORD * np.nan), "NaN"),
        (lambda: RecordedSampler(RECORD, 51), "length: expected from 1 to 50"),
    ],
)
def test_samplers_that_cannot_be_are_refused(make, match: str) -> None:
    with pytest.raises(rt.InputError, match=match) as caught:
        make()
    assert "\n" not in str(caught.value)
