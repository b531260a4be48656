"""Straight lines of commands: along them, a smooth answer is told by a few points.

Commands ramp and hold. On a ramp all of them are linear in time, so that an answer without memory
is a smooth function of one variable: asked at Chebyshev's points and joined by a polynomial it is
the same up to rounding, for a fraction of the questions. A hold takes one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, reduce

import numpy as np
import torch
from numpy.polynomial import chebyshev
from torch import Tensor

__all__ = ["distinct", "evaluate_piecewise_linear"]

ROUND = 4
"""A line is straight where it is off by so many roundings of its larger end at most."""
STRIDE = 4
"""Of so many samples on a line one is held against its chord."""
MOST = 24
"""Points on one line, at most."""
RESOLVED = 3e-6
"""Of the answer's unit: what the last two coefficients of a polynomial may be. They fall off
geometrically, so that what it leaves out is some thirty times less."""


def evaluate_piecewise_linear(
    ask: Callable[[Tensor], Tensor], commands: Tensor, unit: Tensor | float = 1.0
) -> Tensor:
    """Answers (n, T, d_y) to commands (n, T, d_u), asked for as few of them as it takes.

    What is on no straight line, or on one along which no polynomial follows the answer, is asked
    for sample by sample.

    Parameters
    ----------
    ask: says answers (k, d_y) to commands (k, d_u); without memory.
    commands: (n, T, d_u), any numbers.
    unit: (d_y,), what an error of the answers is small against.

    """
    flat = commands.flatten(0, 1)
    begin, length, held = _lines(commands)
    hold, span = begin[held], length[held]
    ramps, crooked = _ramps(flat, begin[~held], length[~held])
    asked = [flat[hold], flat[crooked], *(each.points.flatten(0, 1) for each in ramps)]
    of_holds, of_crooked, *of_ramps = ask(torch.cat(asked)).split([len(each) for each in asked])
    out = of_holds.new_empty(len(flat), of_holds.shape[1])
    out.index_copy_(0, _samples(hold, span), of_holds.repeat_interleave(span, dim=0))
    out.index_copy_(0, crooked, of_crooked)
    rough = [crooked[:0]]
    for each, said in zip(ramps, of_ramps, strict=True):
        values, left_out = each.joined(said)
        out.index_copy_(0, each.samples.flatten(), values.flatten(0, 1))
        rough.append(each.samples[(left_out > RESOLVED * unit).flatten(1).any(dim=1)].flatten())
    rest = torch.cat(rough)
    if len(rest):
        out.index_copy_(0, rest, ask(flat[rest]))
    return out.view(*commands.shape[:2], -1)


def distinct(commands: Tensor) -> tuple[Tensor, Tensor]:
    """Those of the commands (n, T, d_u) that differ from the sample before, (k, d_u), and for each
    sample which of them it is, (n, T): what is held says the same all over.
    """
    fresh = torch.ones(commands.shape[:2], dtype=torch.bool)
    fresh[:, 1:] = (commands[:, 1:] != commands[:, :-1]).any(dim=-1)
    index = fresh.flatten().nonzero()[:, 0]
    place = fresh.flatten().cumsum(dim=0) - 1
    return commands.flatten(0, 1).index_select(0, index), place.view(fresh.shape)


def _lines(commands: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Which sample of all each line begins at, how many it has, and whether they are all the same.

    A line goes up to where the next one begins; a trajectory's last sample is one of its own.
    """
    step = commands.diff(dim=1)
    turn = step.diff(dim=1).abs()
    bends = torch.ones(commands.shape[:2], dtype=torch.bool)
    bends[:, 1:-1] = _any(turn > _slack(commands[:, :-2], commands[:, 2:]))
    moves = torch.zeros_like(bends)
    moves[:, 1:] = _any(step != 0)
    begin = bends.flatten().nonzero()[:, 0]
    length = begin.diff(append=begin.new_tensor([bends.numel()]))
    moved = moves.flatten().cumsum(dim=0)
    return begin, length, moved[begin] == moved[begin + length - 1]


@dataclass(frozen=True, eq=False)
class _Ramps:
    """Lines of n samples each."""

    samples: Tensor  # (m, n), which of all
    points: Tensor  # (m, k, d_u), the commands that are asked for
    join: Tensor  # (n + 2, k), gives the answers at the samples, then two coefficients

    def joined(self, said: Tensor) -> tuple[Tensor, Tensor]:
        """Answers (m, n, d_y) by those at the points, and the last coefficients (m, 2, d_y)."""
        said = said.unflatten(0, self.points.shape[:2])
        values = torch.einsum("nk,mkd->mnd", self.join, said)
        return values[:, :-2], values[:, -2:].abs()


def _ramps(flat: Tensor, begin: Tensor, length: Tensor) -> tuple[list[_Ramps], Tensor]:
    """Those lines that are straight and worth it, and the samples (k,) of the others."""
    ramps, others = [], []
    for n in length.unique().tolist():
        first = begin[length == n]
        samples = first[:, None] + torch.arange(n)
        count = min(7 + n // 7, MOST)
        if count >= n:
            others.append(samples.flatten())
            continue
        at, places, join = _rule(n, count, flat.dtype)
        start, stop = (flat[each][:, None] for each in (first, first + n))
        # No sample turns by more than the slack, so between two of these it is off by twice as much
        # again at most.
        some = samples[:, ::STRIDE]
        told = flat.index_select(0, some.flatten()).view(*some.shape, -1)
        off = told - torch.lerp(start, stop, at[::STRIDE])
        straight = (off.abs() <= _slack(start, stop)).flatten(1).all(dim=1)
        points = torch.lerp(start, stop, places)
        ramps.append(_Ramps(samples[straight], points[straight], join))
        others.append(samples[~straight].flatten())
    return ramps, torch.cat([begin[:0], *others])


@lru_cache(maxsize=1024)
def _rule(length: int, count: int, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Places on a line from 0 to 1, of its samples (n, 1) and of the points (k, 1), and `join`."""
    at = np.linspace(0, 1, length, endpoint=False)
    points = chebyshev.chebpts1(count)
    coefficients = np.linalg.inv(chebyshev.chebvander(points, count - 1))
    values = chebyshev.chebvander(2 * at - 1, count - 1) @ coefficients
    rule = at[:, None], (1 + points)[:, None] / 2, np.concatenate([values, coefficients[-2:]])
    of_samples, of_points, join = (torch.from_numpy(each).to(dtype) for each in rule)
    return of_samples, of_points, join


def _slack(one: Tensor, other: Tensor) -> Tensor:
    """What rounding may do to commands between these."""
    return ROUND * torch.finfo(one.dtype).eps * torch.maximum(one.abs(), other.abs())


def _samples(begin: Tensor, length: Tensor) -> Tensor:
    """All samples of lines, one line after the other."""
    before = length.cumsum(dim=0) - length
    return torch.arange(int(length.sum())) + (begin - before).repeat_interleave(length)


def _any(flags: Tensor) -> Tensor:
    """Whether one in the last dimension is; by hand, since torch is slow where it is short."""
    return reduce(torch.logical_or, flags.unbind(dim=-1))
