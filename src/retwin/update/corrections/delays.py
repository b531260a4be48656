"""Delays of segments: first values and limits, and the time that they warp.

Every segment is shifted by its own delay, and what lies between is stretched to fit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.data.segments import Segments
from retwin.inference.problem import Rows
from retwin.inference.solver import Bounds


@dataclass(frozen=True, eq=False)
class Knots:
    """Knots of the piecewise-linear time warp, and the place of each sample between two of them.

    Attributes
    ----------
    source : Tensor
        (n, 2 M), time of each knot in the uncorrected path, in samples.
    target : Tensor
        (n, 2 M), time of each knot in the corrected path, in samples.
    last : Tensor
        (n, 1), index of the last knot: those after it belong to no segment.
    right : Tensor
        (n, S), index of the knot after each sample, one more than the last's beyond all knots.
    share : Tensor
        (n, S), place between the knot before (0) and after (1).
    time : Tensor
        (n, S), the samples themselves.

    """

    source: Tensor
    target: Tensor
    last: Tensor
    right: Tensor
    share: Tensor
    time: Tensor

    @classmethod
    def of(cls, segments: Segments, delay: Tensor, times: Tensor | None = None) -> Knots:
        """The knots for delays (n, M) in samples, at every sample or at `times` (n, S)."""
        ends = (segments.start, segments.settle)
        source = torch.stack([torch.as_tensor(each, dtype=delay.dtype) for each in ends], dim=-1)
        source = source.flatten(1)
        valid = torch.as_tensor(segments.valid)
        shift = (delay * valid).repeat_interleave(2, dim=1)
        # A segment cannot begin before the previous motion has ended, however the delays differ.
        target = (source + shift).cummax(dim=1).values
        last = (2 * valid.sum(dim=1, keepdim=True) - 1).clamp_min(0)
        every = torch.arange(segments.steps, dtype=delay.dtype, device=delay.device)
        time = every if times is None else times
        time = time.expand(len(target), -1).contiguous()
        right = torch.searchsorted(target.detach(), time.detach(), right=True).minimum(last + 1)
        begin = target.gather(1, (right - 1).clamp_min(0))
        end = target.gather(1, right.minimum(last))
        share = (time - begin) / (end - begin).clamp_min(1e-9)
        return cls(source, target, last, right, share.clamp(0, 1), time)

    def between(self, values: Tensor) -> Tensor:
        """Values (n, 2 M, k) of the knots, linear between them and constant outside: (n, S, k)."""
        before, after = (gather_samples(values, place) for place in self._around)
        return before + self.share[..., None] * (after - before)

    def slope(self, values: Tensor) -> Tensor:
        """Change per sample of `between` (n, S, k)."""
        before, after = self._around
        length = self.target.gather(1, after) - self.target.gather(1, before)
        rise = gather_samples(values, after) - gather_samples(values, before)
        return rise / length.clamp_min(1e-9)[..., None]

    @property
    def _around(self) -> tuple[Tensor, Tensor]:
        """Index (n, S) of the knot before each sample, and after it; the same one outside."""
        return (self.right - 1).clamp_min(0), self.right.minimum(self.last)

    def source_time(self) -> Tensor:
        """The time (n, S) in the uncorrected path that each sample is taken from."""
        inner = self.between(self.source[..., None])[..., 0]
        before = (self.time - self.target[:, :1]).clamp_max(0)
        after = (self.time - self.target.gather(1, self.last)).clamp_min(0)
        return inner + before + after

    @staticmethod
    def spread(offset: Tensor) -> Tensor:
        """Offsets (n, M, k) at the knots (n, 2 M, k): the previous one at the start."""
        before = torch.cat([torch.zeros_like(offset[:, :1]), offset[:, :-1]], dim=1)
        return torch.stack([before, offset], dim=2).flatten(1, 2)


def gather_samples(values: Tensor, samples: Tensor) -> Tensor:
    """The values (n, T, d) at samples (n, S): (n, S, d)."""
    return values.gather(1, samples[..., None].expand(-1, -1, values.shape[2]))


def interpolate(path: Tensor, times: Tensor) -> Tensor:
    """The path (n, T, d) at fractional samples `times` (n, S), held beyond its ends."""
    times = times.clamp(0, path.shape[1] - 1)
    below = times.detach().floor().long().clamp_max(max(path.shape[1] - 2, 0))
    before, after = gather_samples(path, below), gather_samples(path, below + 1)
    return before + (times - below)[..., None] * (after - before)


def within(samples: Tensor, begin: Tensor | NDArray, end: Tensor | NDArray) -> Tensor:
    """Whether samples (S,) or (n, S) are from `begin` to `end` (n, M), ends included: (n, M, S)."""
    begin, end = (torch.as_tensor(each)[..., None] for each in (begin, end))
    here = samples[..., None, :]
    return (here >= begin) & (here <= end)


def thinned(measured: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """At most `count` evenly chosen samples of each row of `measured` (n, T) bool.

    Each trajectory is thinned by itself: trajectories may be polled at different phases.

    Returns the samples (n, S), where shorter rows repeat their last one, and which of them are no
    such repetition (n, S) bool. A row without any measurement has only False.
    """
    rank = measured.cumsum(dim=1)
    every = (-(-rank[:, -1:] // count)).clamp_min(1)
    used = measured & ((rank - 1) % every == 0)
    kept = used.sum(dim=1, keepdim=True)
    column = torch.arange(int(kept.amax()) if len(kept) else 0)
    order = used.byte().argsort(dim=1, descending=True, stable=True)
    return order.gather(1, column.minimum((kept - 1).clamp_min(0))), column < kept


@dataclass(frozen=True, eq=False)
class DelayProblem(Rows, ABC):
    """A problem whose latent variables x are, of every segment, a delay in samples and others.

    Attributes
    ----------
    segments : Segments
        M at most.
    sample : Tensor
        (K,) or (R, K), the sample of each row of the residual.
    measured, group, observed : Tensor
        (R, K), (R, K) and (R, K, d), see `Problem`; and the measured outputs.
    delay_range : tuple of float
        Smallest and largest delay, in samples.

    """

    segments: Segments
    sample: Tensor
    measured: Tensor
    group: Tensor
    observed: Tensor
    delay_range: tuple[float, float]

    @property
    def width(self) -> float:
        """Of the range of delays, in samples."""
        return self.delay_range[1] - self.delay_range[0]

    def per_segment(self, x: Tensor) -> Tensor:
        """Values (R, P) or (R, P, …) by segment, (R, M, P / M, …), the delay first."""
        return x.unflatten(1, (self.segments.max_count, -1))

    def at_rest(self, margin: float) -> Tensor:
        """(R, M, K) bool, the samples at rest, `margin` samples after the motion.

        Of a short rest its second half counts.
        """
        settle, stop = map(torch.as_tensor, (self.segments.settle, self.segments.stop))
        begin = settle + torch.full_like(settle, margin).minimum((stop - settle) / 2)
        return within(self.sample, begin, stop.ceil() - 1)

    @abstractmethod
    def residual(self, x: Tensor) -> Tensor:
        """See `Problem`."""


def first_delays(problem: DelayProblem, x: Tensor, delay_range: tuple[float, float]) -> Tensor:
    """The delay (R, M) on a grid of whole samples that fits each segment best, by absolute error.

    Everything else is as in x (R, P). Where all fit equally well, the smallest.
    """
    low, high = delay_range
    grid = _grid(low, high)
    segments = problem.segments
    near = within(problem.sample, segments.start + low, segments.settle + high)
    costs = [(near * each[:, None]).sum(dim=-1) for each in _errors(problem, x, grid)]
    return grid[torch.stack(costs).argmin(dim=0)] * torch.as_tensor(segments.valid)


def common_delay(problem: DelayProblem, x: Tensor, delay_range: tuple[float, float]) -> float:
    """The delay in whole samples of all segments together that fits best, by absolute error."""
    grid = _grid(*delay_range)
    while True:
        best = float(grid[torch.stack([each.sum() for each in _errors(problem, x, grid)]).argmin()])
        step = float(grid.sort().values.diff().amax()) if len(grid) > 1 else 1.0
        if step <= 1:
            return best
        grid = _grid(best - step, best + step)


def _grid(low: float, high: float, *, intervals: int = 64) -> Tensor:
    """Delays in whole samples between limits, the smallest first.

    Parameters
    ----------
    intervals : int, default 64
        Intervals of a grid of delays at most, where those are not below one sample.

    """
    step = max(1, round((high - low) / intervals))
    grid = torch.arange(low, high + 1.0, step, dtype=torch.float64)
    return grid[grid.abs().argsort(stable=True)]


def _errors(problem: DelayProblem, x: Tensor, grid: Tensor) -> Iterator[Tensor]:
    """Absolute errors (R, K) of the outputs for each delay of the grid, of all segments."""
    x, measured = x.clone(), problem.measured > 0
    for delay in grid:
        problem.per_segment(x)[..., 0] = delay
        yield problem.residual(x).norm(dim=-1) * measured


def delay_bounds(
    segments: Segments, size: int, delay_range: tuple[float, float], max_step: float = torch.inf
) -> Bounds:
    """Limits of the delays among `size` latent variables per segment, and of one step of them."""
    step = torch.full((segments.max_count, size), torch.inf, dtype=torch.float64)
    low, high = -step, step.clone()
    low[:, 0], high[:, 0] = delay_range
    step[:, 0] = max_step
    return Bounds(low.flatten(), high.flatten(), step.flatten())


def at_bound(delay: Tensor, delay_range: tuple[float, float], *, at_bound: float = 1e-3) -> Tensor:
    """Whether delays are at a bound of their range, where the best one may lie beyond.

    Parameters
    ----------
    at_bound : float, default 1e-3
        Distance from a bound, in widths of the range, within which a delay is at that bound.

    """
    low, high = delay_range
    near = at_bound * (high - low)
    return (delay <= low + near) | (delay >= high - near)
