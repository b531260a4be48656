"""`DelayOffset`: the paper's correction operator (section 4.2.4) and its inverse.

A segment is delayed by TDe samples, and the position that it reaches is offset by TPE. Both are
piecewise linear in time: segment m begins at `start + TDe` with the previous segment's TPE, and its
motion ends at `settle + TDe` with its own. So the path is continuous whatever z is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from retwin.checks import positive
from retwin.data.trajectories import Channels
from retwin.inference.noise import Noise, StudentT
from retwin.inference.problem import GaussianPrior
from retwin.inference.solver import Solution, blocks, solve
from retwin.update.corrections.commands.path_problem import PathProblem, path_at
from retwin.update.corrections.correction import Context, Discrepancy, Head
from retwin.update.corrections.delay_range import checked_range, range_in_samples, range_in_seconds
from retwin.update.corrections.delays import at_bound, first_delays, within
from retwin.update.kernels.generation import delayed_path

WIDE = 100.0
"""Standard deviation of the prior, in the largest plausible value: it decides only what was not
measured at all."""
KNOWN_DELAY = 1 / 8
"""Standard deviation above which a delay is not identified by default, in widths of its range: less
than half of that of a delay of which nothing is known."""


@dataclass(frozen=True)
class DelayOffset:
    """z = (TDe, TPE) per segment: delay, offset of the steady part in output units.

    Settings are in seconds, delays in z in samples.

    Parameters
    ----------
    delay_range : tuple of float, optional
        Smallest and largest delay that `infer` considers, in seconds; by default chosen from the
        measured outputs, see `plausible_delays`.
    known_delay : float, optional
        Standard deviation in seconds above which a delay counts as not identified; by default an
        eighth of the range of delays.

    Raises
    ------
    InputError
        The range does not rise, or the standard deviation is not positive.

    """

    resolution: ClassVar[str] = "segment"
    """One z per segment."""
    delay_range: tuple[float, float] | None = None
    known_delay: float | None = None

    def __post_init__(self) -> None:
        checked_range(self.delay_range)
        if self.known_delay is not None:
            positive("known_delay", self.known_delay)

    @property
    def pools(self) -> bool:
        """`infer` learns the range of delays from all trajectories together, unless it is given."""
        return self.delay_range is None

    def latent(self, inputs: Channels, outputs: Channels) -> Channels:
        """`delay` in samples, then one offset per output in its unit."""
        names = ("delay", *(f"offset_{name}" for name in outputs.names))
        return Channels(names, ("samples", *outputs.units))

    def heads(self, inputs: Channels, outputs: Channels) -> tuple[Head, ...]:
        """A mixture for the delay, another for the offset (section 4.2.3)."""
        return Head("delay", 1), Head("offset", len(outputs))

    def apply(self, context: Context, z: Tensor) -> Tensor:
        """The corrected path (n, T, d_y), continuous, for z (n, M, 1 + d_y)."""
        if context.segments.max_count == 0:
            return context.path
        z = z.to(context.path)
        made = delayed_path(context.segments, context.path, z)
        return path_at(context.segments, context.path, z) if made is None else made

    def completed(self, context: Context, observed: Tensor, mask: Tensor) -> DelayOffset:
        """The operator with the range of delays that measured outputs show, where none is given."""
        found = range_in_seconds(self.delay_range, context, observed, mask)
        return replace(self, delay_range=found)

    @torch.no_grad()
    def infer(self, context: Context, observed: Tensor, mask: Tensor) -> Discrepancy:
        """The most probable z under heavy-tailed noise.

        Offsets start from the median of the steady part, delays from a grid; both are then refined
        together, because a delay and an offset trade off during motion. Outliers lose their weight
        (Student's t at first, then Tukey), so glitches do not change z. Outputs are compared in
        `Context.unit`, and of a sample the outputs that were measured count.
        """
        limits = range_in_samples(self.delay_range, context, observed, mask)
        # Trajectories inferred together, which bounds memory.
        parts = [
            self._infer(context[some], observed[some], mask[some], limits)
            for some in torch.arange(len(context)).split(128)
        ]
        names = ("z", "covariance", "identified", "noise", "at_bound")
        columns: dict[str, Any] = {
            name: torch.cat([getattr(part, name) for part in parts]) for name in names
        }
        return Discrepancy(**columns)

    def _infer(
        self, context: Context, observed: Tensor, mask: Tensor, limits: tuple[float, float]
    ) -> Discrepancy:
        unit, segments = context.unit.double(), context.segments
        problem = PathProblem.of(segments, context.path / unit, observed / unit, mask, limits)
        z = torch.zeros(len(context), segments.max_count, 1 + len(unit), dtype=torch.float64)
        if segments.max_count == 0:
            matrix = z[..., None] * z[..., None, :]
            noise = problem.noise(problem.factor * (problem.observed - problem.path))
            steady = noise.scale[::2, 0] * unit.mean()
            return Discrepancy(z, matrix, z > 0, steady, at_bound=z[..., 0] > 0)
        z[..., 1:] = problem.first_offset(limits[1])
        z[..., 0] = first_delays(problem, z.flatten(1), limits)
        problem = problem.with_motion(z[..., 0])
        x = z.flatten(1)
        noise, prior = _learned(problem, problem.residual(x))
        # A fast motion half a sample beside the grid is beyond the cutoff of Tukey's loss, and the
        # rounding of the few samples that count would decide where its delay goes from there.
        noise = replace(noise, loss=StudentT())
        # Times that the noise is estimated anew, and z with it.
        for _ in range(5):
            solution = solve(problem, prior, noise, x, bounds=problem.bounds, reweightings=1)
            x = solution.x
            noise, prior = _learned(problem, problem.residual(x))
        known = KNOWN_DELAY * problem.width
        if self.known_delay is not None:
            known = self.known_delay * context.rate
        found = _discrepancy(problem, solution, noise, prior, unit, known)
        if context.surrogate_variance is None:
            return found
        # At rest the surrogate's error is an offset.
        found.covariance.diagonal(dim1=-2, dim2=-1)[..., 1:] += context.surrogate_variance
        return found


def _learned(problem: PathProblem, residual: Tensor) -> tuple[Noise, GaussianPrior]:
    """The noise, and a prior much wider than anything plausible: what is not seen stays 0."""
    # Residuals may be as good as exact, offsets are not: they are as large as they are without z.
    plain = problem.factor * (problem.observed - problem.path)
    largest = plain.norm(dim=-1).amax(dim=1).maximum(residual.norm(dim=-1).amax(dim=1))
    wide = (WIDE * largest + 1e-9)[:, None].repeat(1, 1 + residual.shape[-1])
    wide[:, 0] = WIDE * problem.width
    wide = wide.repeat(1, problem.segments.max_count)
    prior = GaussianPrior.independent(torch.zeros_like(wide), wide.square())
    return problem.noise(residual), prior


def _discrepancy(
    problem: PathProblem,
    solution: Solution,
    noise: Noise,
    prior: GaussianPrior,
    unit: Tensor,
    known_delay: float,
    *,
    unseen: float = 0.1,
    measured_motion: float = 0.5,
) -> Discrepancy:
    """z, each segment's covariance, and which components the outputs identify.

    Parameters
    ----------
    unseen : float, default 0.1
        Share of the prior's standard deviation above which an offset was not measured.
    measured_motion : float, default 0.5
        Share of a motion that must be measured for its delay to be identified.

    """
    z = problem.per_segment(solution.x)
    covariance = blocks(solution.covariance, z.shape[1])
    deviation = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    wide = problem.per_segment(prior.deviation)
    valid = torch.as_tensor(problem.segments.valid)
    bounded = at_bound(z[..., 0], problem.delay_range) & valid
    delay = (deviation[..., 0] <= known_delay) & _moves(problem, z, deviation) & ~bounded
    delay &= problem.motion_measured >= measured_motion
    offset = deviation[..., 1:] <= unseen * wide[..., 1:]
    identified = torch.cat([delay[..., None], offset], dim=-1)
    identified = identified & valid[..., None]
    scale = torch.cat([unit.new_ones(1), unit])
    steady = torch.where(problem.measured > 0, noise.scale[problem.group][..., 0], torch.inf)
    covariance = covariance * scale[:, None] * scale
    left = steady.amin(dim=1) * unit.mean()
    return Discrepancy(z * scale, covariance, identified, left, at_bound=bounded)


def _moves(problem: PathProblem, z: Tensor, deviation: Tensor) -> Tensor:
    """Whether an output moves in a segment by more than its offsets are uncertain, (n, M).

    A step between two offsets has a place, and so a delay, also where noise alone made it.
    """
    start, settle = map(torch.as_tensor, (problem.segments.start, problem.segments.settle))
    way = path_at(problem.segments, problem.path, z).diff(dim=1, prepend=problem.path[:, :1]).abs()
    inside = within(problem.sample, start + z[..., 0], settle + z[..., 0] + 1)
    variance = deviation[..., 1:].square()
    before = torch.cat([torch.zeros_like(variance[:, :1]), variance[:, :-1]], dim=1)
    # Way of a motion, in standard deviations of the step between its offsets, below which noise
    # could have made it: its delay is then not identified.
    return (inside.to(way) @ way > 3.0 * (variance + before).sqrt()).any(dim=-1)
