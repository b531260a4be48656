"""Delays of segments, common to all problems that have one per segment: first values and limits."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from retwin.data.segments import Segments
from retwin.inference.problem import Problem
from retwin.inference.solver import Bounds
from retwin.update.corrections.warp import within

__all__ = ["DelayProblem", "delay_bounds", "first_delays"]


class DelayProblem(Problem, Protocol):
    """A problem whose latent variables are, of every segment, a delay in samples and others.

    Attributes
    ----------
    segments : Segments
        M at most.
    sample : Tensor
        (K,) or (R, K), the sample of each row of the residual.

    """

    @property
    def segments(self) -> Segments:
        """M at most."""
        ...

    @property
    def sample(self) -> Tensor:
        """(K,) or (R, K)."""
        ...

    def per_segment(self, x: Tensor) -> Tensor:
        """A view of x (R, P) by segment, (R, M, P / M), the delay first."""
        ...


def first_delays(problem: DelayProblem, x: Tensor, delay_range: tuple[float, float]) -> Tensor:
    """The delay (R, M) in whole samples that fits each segment best, by absolute error.

    Everything else is as in x (R, P). Where all fit equally well, the smallest.
    """
    low, high = delay_range
    grid = torch.arange(low, high + 1.0, dtype=torch.float64)
    grid = grid[grid.abs().argsort(stable=True)]
    segments, measured = problem.segments, problem.measured > 0
    near = within(problem.sample, segments.start + low, segments.settle + high)
    x, costs = x.clone(), []
    for delay in grid:
        problem.per_segment(x)[..., 0] = delay
        error = problem.residual(x).norm(dim=-1) * measured
        costs.append((near * error[:, None]).sum(dim=-1))
    return grid[torch.stack(costs).argmin(dim=0)] * torch.as_tensor(segments.valid)


def delay_bounds(
    segments: Segments, size: int, delay_range: tuple[float, float], max_step: float = torch.inf
) -> Bounds:
    """Limits of the delays among `size` latent variables per segment, and of one step of them."""
    step = torch.full((segments.max_count, size), torch.inf, dtype=torch.float64)
    low, high = -step, step.clone()
    low[:, 0], high[:, 0] = delay_range
    step[:, 0] = max_step
    return Bounds(low.flatten(), high.flatten(), step.flatten())
