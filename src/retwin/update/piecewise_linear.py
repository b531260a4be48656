"""Evaluation of a memoryless function along piecewise-linear commands, by interpolation.

Commands ramp and hold. On a ramp all of them are linear in time, so a function without memory is a
smooth function of one variable there: its polynomial through a few Chebyshev points equals it up to
rounding, at a fraction of the evaluations. A hold takes one evaluation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, reduce

import numpy as np
import torch
from numpy.polynomial import chebyshev
from torch import Tensor

TOLERANCE = 3e-6
"""Largest value of a polynomial's last two coefficients, in units of the outputs. Coefficients
decrease geometrically, so the truncation error is some thirty times smaller."""


def evaluate_piecewise_linear(
    function: Callable[[Tensor], Tensor], commands: Tensor, unit: Tensor | float = 1.0
) -> Tensor:
    """The values of `function` at all samples of `commands`, from as few evaluations as possible.

    Samples on no straight piece, or on one along which no polynomial follows the function, are
    evaluated one by one.

    Parameters
    ----------
    function : callable
        From commands (k, d_u) to outputs (k, d_y), without memory.
    commands : Tensor
        (n, T, d_u), of any shape over time.
    unit : Tensor or float
        (d_y,), the scale of the outputs, to which the tolerance is relative.

    Returns
    -------
    Tensor
        (n, T, d_y).

    """
    flat = commands.flatten(0, 1)
    begin, length, held = _pieces(commands)
    hold, duration = begin[held], length[held]
    ramps, uneven = _ramps(flat, begin[~held], length[~held])
    points = [flat[hold], flat[uneven], *(ramp.points.flatten(0, 1) for ramp in ramps)]
    values = function(torch.cat(points)).split([len(each) for each in points])
    of_holds, of_uneven, *of_ramps = values
    out = of_holds.new_empty(len(flat), of_holds.shape[1])
    out.index_copy_(0, _samples(hold, duration), of_holds.repeat_interleave(duration, dim=0))
    out.index_copy_(0, uneven, of_uneven)
    unresolved = [uneven[:0]]
    for ramp, at_points in zip(ramps, of_ramps, strict=True):
        interpolated, coefficients = ramp.interpolate(at_points)
        out.index_copy_(0, ramp.samples.flatten(), interpolated.flatten(0, 1))
        rough = (coefficients > TOLERANCE * unit).flatten(1).any(dim=1)
        unresolved.append(ramp.samples[rough].flatten())
    rest = torch.cat(unresolved)
    if len(rest):
        out.index_copy_(0, rest, function(flat[rest]))
    return out.view(*commands.shape[:2], -1)


def distinct(commands: Tensor) -> tuple[Tensor, Tensor]:
    """The commands that differ from the sample before, and where each sample's is among them.

    Parameters
    ----------
    commands : Tensor
        (n, T, d_u).

    Returns
    -------
    Tensor, Tensor
        (k, d_u), and the row of it that each sample equals, (n, T).

    """
    changed = torch.ones(commands.shape[:2], dtype=torch.bool, device=commands.device)
    changed[:, 1:] = (commands[:, 1:] != commands[:, :-1]).any(dim=-1)
    index = changed.flatten().nonzero()[:, 0]
    place = changed.flatten().cumsum(dim=0) - 1
    return commands.flatten(0, 1).index_select(0, index), place.view(changed.shape)


def _pieces(commands: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """First sample of each linear piece over all trajectories, its length, and whether it is held.

    A piece ends where the next one begins; a trajectory's last sample is a piece of its own.
    """
    step = commands.diff(dim=1)
    bend = step.diff(dim=1).abs()
    begins = torch.ones(commands.shape[:2], dtype=torch.bool)
    begins[:, 1:-1] = _any(bend > _rounding(commands[:, :-2], commands[:, 2:]))
    moves = torch.zeros_like(begins)
    moves[:, 1:] = _any(step != 0)
    begin = begins.flatten().nonzero()[:, 0]
    length = begin.diff(append=begin.new_tensor([begins.numel()]))
    moved = moves.flatten().cumsum(dim=0)
    return begin, length, moved[begin] == moved[begin + length - 1]


@dataclass(frozen=True, eq=False)
class _Ramps:
    """Pieces of n samples each."""

    samples: Tensor  # (m, n), indices over all samples
    points: Tensor  # (m, k, d_u), commands at the Chebyshev points
    matrix: Tensor  # (n + 2, k), from values at the points to those at samples and 2 coefficients

    def interpolate(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Values (m, n, d_y) from those at the points, and the last coefficients (m, 2, d_y)."""
        values = values.unflatten(0, self.points.shape[:2])
        both = torch.einsum("nk,mkd->mnd", self.matrix, values)
        return both[:, :-2], both[:, -2:].abs()


def _ramps(
    flat: Tensor, begin: Tensor, length: Tensor, *, stride: int = 4, max_points: int = 24
) -> tuple[list[_Ramps], Tensor]:
    """The pieces that are straight and longer than their points, and the other samples (k,).

    Parameters
    ----------
    stride : int, default 4
        Of this many samples of a piece one is compared with the chord.
    max_points : int, default 24
        Largest number of Chebyshev points on one piece.

    """
    ramps, others = [], []
    for n in length.unique().tolist():
        first = begin[length == n]
        samples = first[:, None] + torch.arange(n)
        count = min(7 + n // 7, max_points)
        if count >= n:
            others.append(samples.flatten())
            continue
        at, places, matrix = _interpolation(n, count, flat.dtype)
        start, stop = (flat[each][:, None] for each in (first, first + n))
        # No sample bends by more than rounding, so between two that are compared with the chord the
        # deviation is at most twice as large again.
        some = samples[:, ::stride]
        compared = flat.index_select(0, some.flatten()).view(*some.shape, -1)
        deviation = compared - torch.lerp(start, stop, at[::stride])
        straight = (deviation.abs() <= _rounding(start, stop)).flatten(1).all(dim=1)
        points = torch.lerp(start, stop, places)
        ramps.append(_Ramps(samples[straight], points[straight], matrix))
        others.append(samples[~straight].flatten())
    return ramps, torch.cat([begin[:0], *others])


@lru_cache(maxsize=1024)
def _interpolation(length: int, count: int, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Places from 0 to 1 of the samples (n, 1) and of the points (k, 1), and `_Ramps.matrix`."""
    at = np.linspace(0, 1, length, endpoint=False)
    points = chebyshev.chebpts1(count)
    coefficients = np.linalg.inv(chebyshev.chebvander(points, count - 1))
    values = chebyshev.chebvander(2 * at - 1, count - 1) @ coefficients
    matrix = np.concatenate([values, coefficients[-2:]])
    arrays = at[:, None], (1 + points)[:, None] / 2, matrix
    of_samples, of_points, of_values = (torch.from_numpy(each).to(dtype) for each in arrays)
    return of_samples, of_points, of_values


def _rounding(one: Tensor, other: Tensor, *, roundings: int = 4) -> Tensor:
    """Largest effect of rounding on commands between these.

    Parameters
    ----------
    roundings : int, default 4
        Deviation from a straight line that counts as rounding, in roundings of the larger end.

    """
    return roundings * torch.finfo(one.dtype).eps * torch.maximum(one.abs(), other.abs())


def _samples(begin: Tensor, length: Tensor) -> Tensor:
    """The samples of all pieces, in series."""
    before = length.cumsum(dim=0) - length
    return torch.arange(int(length.sum())) + (begin - before).repeat_interleave(length)


def _any(flags: Tensor) -> Tensor:
    """`flags.any(dim=-1)`, which torch computes slowly where the last dimension is short."""
    return reduce(torch.logical_or, flags.unbind(dim=-1))
