"""Delays of segments, common to all problems that have one per segment: first values and limits."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from retwin.data.segments import Segments
from retwin.inference.problem import Rows
from retwin.inference.solver import Bounds
from retwin.update.corrections.warp import within


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
