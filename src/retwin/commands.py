"""Commands for any twin whose limits are known: ramps and holds at random levels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.errors import InputError

__all__ = ["RampSampler", "draw_onsets"]


@dataclass(frozen=True)
class RampSampler:
    """Commands that ramp to a random level, hold it, and ramp to the next; a command sampler.

    Parameters
    ----------
    low, high: the levels' limits, one per input channel, in its unit.
    movements: per trajectory, evenly spaced from sample 0 on.
    steps: samples per trajectory.
    ramps: lengths of a ramp in samples; each channel draws one for each movement.
    start: level before the first movement, per channel; empty takes the middle of the limits.

    Raises
    ------
    InputError: limits that are not finite or not in order, a start outside them, fewer than one
        movement or two samples, ramps that are not whole or that a movement has no time for.

    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    movements: int = 5
    steps: int = 1000
    ramps: tuple[int, ...] = (60, 80, 100)
    start: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        low, high = np.array(self.low, float), np.array(self.high, float)
        finite = low.ndim == 1 and low.shape == high.shape and np.isfinite([low, high]).all()
        if not (finite and len(low) and (low < high).all()):
            raise InputError(
                "limits",
                expected="a finite low and a greater finite high per input channel",
                got=f"low {self.low}, high {self.high}",
                remedy="say between which levels commands may be drawn",
            )
        rest = np.array(self.rest)
        if rest.shape != low.shape or not ((low <= rest) & (rest <= high)).all():
            raise InputError(
                "start",
                expected=f"one level within the limits per input channel, {len(low)}",
                got=str(self.start),
                remedy="leave start out to begin in the middle of the limits",
            )
        if self.movements < 1 or self.steps < 2:
            raise InputError(
                "movements",
                expected="at least one movement and two samples",
                got=f"{self.movements} movements in {self.steps} samples",
                remedy="give more",
            )
        longest = self.steps // self.movements
        if not self.ramps or not all(1 <= ramp <= longest for ramp in self.ramps):
            raise InputError(
                "ramps",
                expected=f"lengths from 1 to {longest} samples, the time of a movement",
                got=str(self.ramps),
                remedy="give shorter ramps, fewer movements or more samples",
            )

    @property
    def rest(self) -> tuple[float, ...]:
        """The level per channel before the first movement."""
        middle = (0.5 * (a + b) for a, b in zip(self.low, self.high, strict=True))
        return self.start or tuple(middle)

    def sample(
        self, count: int, *, rng: np.random.Generator, timing: NDArray | None = None
    ) -> NDArray:
        """Commands (count, steps, d_u), float32.

        `timing` (k, M): onsets in samples to draw from, a row per trajectory; where a row has no
        onset (NaN, or fewer than `movements`), the movement comes a period after the one before.
        """
        shape = (count, self.movements, len(self.low))
        levels = rng.uniform(self.low, self.high, size=shape)
        ramps = rng.choice(self.ramps, size=shape)
        period = self.steps / self.movements
        onsets = draw_onsets(count, self.movements, period, rng=rng, timing=timing)
        time = np.arange(self.steps, dtype=float)
        commands = np.tile(np.array(self.rest), (count, self.steps, 1))
        before = np.broadcast_to(np.array(self.rest), (count, len(self.low)))
        for movement in range(self.movements):
            since = time[None, :, None] - onsets[:, movement, None, None]
            share = np.clip(since / ramps[:, movement, None, :], 0.0, 1.0)
            commands += (levels[:, movement] - before)[:, None, :] * share
            before = levels[:, movement]
        # Sums round; and movements that are timed more closely than their ramps overshoot.
        return np.clip(commands, self.low, self.high).astype(np.float32)


def draw_onsets(
    count: int,
    movements: int,
    period: float,
    *,
    rng: np.random.Generator,
    timing: NDArray | None = None,
) -> NDArray:
    """Onsets (count, movements) in samples, one every `period` samples from sample 0 on.

    With `timing` (k, M), in samples, every row of onsets is one of its rows, drawn at random; where
    that has none (NaN, or fewer than `movements`), the movement comes a period after the one
    before.
    """
    if timing is None or len(timing) == 0:
        return np.tile(period * np.arange(movements, dtype=float), (count, 1))
    drawn = timing[rng.integers(len(timing), size=count), :movements]
    onsets = np.full((count, movements), np.nan)
    onsets[:, : drawn.shape[1]] = drawn
    for movement in range(movements):
        before = onsets[:, movement - 1] + period if movement else np.zeros(count)
        gap = np.isnan(onsets[:, movement])
        onsets[gap, movement] = before[gap]
    return onsets
