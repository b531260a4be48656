"""The range of delays: a setting in seconds, or chosen from measured outputs.

A range that ends below the true delays biases every one of them; a much wider one invites wrong
local optima. So all segments are delayed together by a wide grid first, which is robust since all
outputs count, and then one by one around the best.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from retwin.checks import require
from retwin.update.corrections.commands.path_problem import PathProblem
from retwin.update.corrections.correction import Context
from retwin.update.corrections.delays import common_delay, first_delays, within

ROUNDING = 1e-6
"""Difference in samples that is only the rounding of numbers."""
MAX_TRAJECTORIES = 20
"""Trajectories that are used at most."""
EARLIEST, LATEST = -0.5, 1.0
"""Limits of the wide grid, in median lengths of a segment."""
QUANTILES = (0.05, 0.95)
"""Quantiles of the delays of single segments: a few missed segments do not count."""


def checked_range(delay_range: tuple[float, float] | None) -> None:
    """InputError for a range in seconds that does not rise; None is to be chosen."""
    require(
        delay_range is None or (np.isfinite(delay_range).all() and delay_range[0] < delay_range[1]),
        "delay_range",
        expected="smallest and largest delay in seconds, the first below the second",
        got=delay_range,
        remedy="leave it out to choose it from the measured outputs",
    )


def range_in_samples(
    delay_range: tuple[float, float] | None, context: Context, observed: Tensor, mask: Tensor
) -> tuple[float, float]:
    """A range in seconds in whole samples, rounded outwards; if None, `plausible_delays`.

    Raises InputError for delays that no trajectory lasts.
    """
    if delay_range is None:
        return plausible_delays(context, observed, mask)
    duration = context.segments.steps / context.rate
    shorter = np.abs(delay_range).max() <= duration
    expected = f"delays in seconds, shorter than the trajectories of {duration:.3g} s"
    remedy = "divide samples by the sample rate, or leave it out to choose it from the outputs"
    require(shorter, "delay_range", expected=expected, got=delay_range, remedy=remedy)
    # 0.3 s times 100 Hz is a little more than 30 samples.
    low, high = (each * context.rate for each in delay_range)
    return float(math.floor(low + ROUNDING)), float(math.ceil(high - ROUNDING))


def range_in_seconds(
    delay_range: tuple[float, float] | None, context: Context, observed: Tensor, mask: Tensor
) -> tuple[float, float]:
    """`range_in_samples` in seconds, as operators hold it."""
    low, high = range_in_samples(delay_range, context, observed, mask)
    return low / context.rate, high / context.rate


def bound_note(share: float, *, few: float = 0.05) -> str:
    """What is wrong with a range that this share of the delays ends at; "" where nothing is.

    Parameters
    ----------
    few : float, default 0.05
        Share of delays at a bound that needs no mention: a few segments are always missed.

    """
    if share <= few:
        return ""
    return f"{share:.0%} of the delays are at a bound of delay_range, give a wider one"


def plausible_delays(context: Context, observed: Tensor, mask: Tensor) -> tuple[float, float]:
    """Smallest and largest plausible delay of a segment, in samples.

    The range of the delays that single segments show in the motion of the outputs, with a margin on
    either side that is as large as the largest of them, up to the length of the trajectories.

    Parameters
    ----------
    context : Context
        Of n trajectories; where none has a segment, any range will do.
    observed, mask : Tensor
        Measured outputs (n, T, d_y), and where they were measured.

    """
    if len(context) > MAX_TRAJECTORIES:
        some = np.linspace(0, len(context) - 1, MAX_TRAJECTORIES).round().astype(int)
        context, observed, mask = context[some], observed[some], mask[some]
    unit, segments = context.unit.double(), context.segments
    if not segments.valid.any():
        return -1.0, 1.0
    length = float(np.median((segments.stop - segments.start)[segments.valid]))
    motion = float(np.median((segments.settle - segments.start)[segments.valid]))
    limits = float(round(EARLIEST * length)), float(round(LATEST * length))
    problem = PathProblem.of(segments, context.path / unit, observed / unit, mask, limits)
    x = torch.zeros(len(context), segments.max_count, 1 + len(unit), dtype=torch.float64)
    x[..., 1:] = problem.first_offset(length)
    x = x.flatten(1)
    common = common_delay(problem, x, limits)
    moves = _moves(problem, x)
    # Smallest margin beyond the delays that are found, in median durations of a motion.
    least = max(math.ceil(0.1 * motion), 2)
    half = max(abs(common), least)
    while True:
        near = common - half, common + half
        low, high = np.quantile(first_delays(problem, x, near)[moves], QUANTILES)
        if (near[0] < low and high < near[1]) or half > length:
            break
        half *= 2
    margin = max(abs(low), abs(high), high - low, least)
    longest = segments.steps
    low, high = max(math.floor(low - margin), -longest), min(math.ceil(high + margin), longest)
    return float(low), float(high)


def _moves(problem: PathProblem, x: Tensor, *, still: float = 0.25) -> Tensor:
    """Whether the outputs move enough in a segment, and are measured, to show its delay (n, M).

    An offset in x (n, P) undoes a part of the way: all of it where actuators missed a segment.

    Parameters
    ----------
    still : float, default 0.25
        Share of the median way of a segment's motion below which its delay hardly shows.

    """
    way = problem.path.diff(dim=1, prepend=problem.path[:, :1]).norm(dim=-1)
    inside = within(problem.sample, problem.segments.start, problem.segments.settle + 1)
    ways = (inside * way[:, None]).sum(dim=-1)
    valid = torch.as_tensor(problem.segments.valid) & (problem.motion_measured > 0)
    offset = problem.per_segment(x)[..., 1:]
    undone = offset.diff(dim=1, prepend=torch.zeros_like(offset[:, :1])).norm(dim=-1)
    enough = still * ways[valid].median()
    for moves in (valid & (ways - undone > enough), valid & (ways > enough)):
        if moves.any():
            return moves
    return torch.as_tensor(problem.segments.valid)
