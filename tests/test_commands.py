"""Random ramps: within their limits, as many and as timed as asked for."""

from __future__ import annotations

import numpy as np
import pytest

import retwin as rt
from retwin.commands import RampSampler

SAMPLER = RampSampler(low=(0.0, -2.0), high=(10.0, -1.0), movements=4, steps=400, ramps=(10, 30))


def draw(count: int = 50, seed: int = 0, timing: np.ndarray | None = None) -> np.ndarray:
    return SAMPLER.sample(count, rng=np.random.default_rng(seed), timing=timing)


def test_commands_ramp_and_hold_within_the_limits() -> None:
    commands = draw()
    assert commands.shape == (50, 400, 2)
    assert commands.dtype == np.float32
    assert (commands >= SAMPLER.low).all()
    assert (commands <= SAMPLER.high).all()
    np.testing.assert_allclose(commands[:, 0], [[5.0, -1.5]] * 50)
    for movement in range(4):
        held = commands[:, 100 * movement + 31 : 100 * movement + 100]
        assert np.ptp(held, axis=1).max() < 1e-5
    levels = commands[:, 99::100].reshape(-1, 2)
    # Uniform: mean and standard deviation of 200 draws within four of their standard errors.
    np.testing.assert_allclose(levels.mean(axis=0), [5.0, -1.5], atol=4 * 10 / np.sqrt(12 * 200))
    np.testing.assert_allclose(levels.std(axis=0), np.array([10, 1]) / np.sqrt(12), rtol=0.2)


def test_ramps_have_the_lengths_asked_for() -> None:
    moving = np.abs(np.diff(draw(), axis=1)) > 1e-6
    lengths = {int(n) for n in moving[:, :100].sum(axis=1).ravel()}
    assert lengths == {10, 30}


def test_the_segments_are_those_that_were_drawn() -> None:
    segments = rt.Segments.from_commands(draw())
    assert segments.most == 4
    np.testing.assert_allclose(segments.start, [[0, 100, 200, 300]] * 50, atol=1e-3)


def test_timing_is_drawn_from_what_was_seen_and_continued() -> None:
    seen = np.array([[7.0, 120.0, np.nan]])
    segments = rt.Segments.from_commands(draw(timing=seen))
    np.testing.assert_allclose(segments.start, [[7, 120, 220, 320]] * 50, atol=1e-3)
    assert np.array_equal(draw(timing=np.empty((0, 4))), draw())
    crowded = draw(timing=np.array([[0.0, 1.0, 2.0, 3.0]]))
    assert (crowded >= SAMPLER.low).all()
    assert (crowded <= SAMPLER.high).all()


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
        ("movements", {"movements": 0}),
        ("ramps: expected lengths from 1 to 100", {"ramps": (10, 101)}),
        ("ramps", {"ramps": ()}),
        ("ramps", {"ramps": (0,)}),
    ],
)
def test_settings_that_cannot_be_are_refused(match: str, changes: dict) -> None:
    settings = {"low": (0.0, -2.0), "high": (10.0, -1.0), "movements": 4, "steps": 400}
    with pytest.raises(rt.InputError, match=match) as caught:
        RampSampler(**{**settings, "ramps": (10, 30), **changes})
    assert "\n" not in str(caught.value)
