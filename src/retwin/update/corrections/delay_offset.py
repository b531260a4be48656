"""`DelayOffset`: the paper's correction operator (section 4.2.4) and its inverse.

A segment is delayed by TDe samples, and the position that it reaches is offset by TPE. Both are
piecewise linear in time: segment m begins at `start + TDe` with the previous segment's TPE, and its
motion ends at `settle + TDe` with its own. So the path is continuous whatever z is.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from retwin.data.trajectories import Channels
from retwin.inference.em import expectation_maximisation
from retwin.inference.noise import Noise
from retwin.inference.priors import GaussianPrior
from retwin.inference.solver import Solution, blocks, solve
from retwin.update.corrections.correction import Context, Discrepancy, Head
from retwin.update.corrections.delays import delay_bounds, first_delays
from retwin.update.corrections.path_problem import MAX_STEP, PathProblem, path_at

__all__ = ["DelayOffset"]

ROUNDS = 5
"""Times that the noise is estimated anew, and z with it."""
TRAJECTORIES_PER_BATCH = 128
"""Trajectories inferred together, which bounds memory."""
WIDE = 100.0
"""Standard deviation of the prior, in the largest plausible value: it decides only what was not
measured at all."""
UNSEEN = 0.1
"""Share of the prior's standard deviation above which an offset was not measured."""
MEASURED_MOTION = 0.5
"""Share of a motion that must be measured for its delay to be identified."""


@dataclass(frozen=True)
class DelayOffset:
    """z = (TDe, TPE) per segment: delay in samples, offset of the steady part in output units.

    Parameters
    ----------
    delay_range : tuple of float
        Smallest and largest delay that `infer` considers, in samples.
    known_delay : float
        Standard deviation in samples above which a delay counts as not identified.

    """

    delay_range: tuple[float, float] = (-5.0, 30.0)
    known_delay: float = 3.0

    @property
    def resolution(self) -> str:
        """One z per segment."""
        return "segment"

    def latent(self, inputs: Channels, outputs: Channels) -> Channels:
        """`delay` in samples, then one offset per output in its unit."""
        return Channels(
            ("delay", *(f"offset_{name}" for name in outputs.names)), ("samples", *outputs.units)
        )

    def heads(self, inputs: Channels, outputs: Channels) -> tuple[Head, ...]:
        """A mixture for the delay, another for the offset (section 4.2.3)."""
        return Head("delay", 1), Head("offset", len(outputs))

    def apply(self, context: Context, z: Tensor) -> Tensor:
        """The corrected path (n, T, d_y), continuous, for z (n, M, 1 + d_y)."""
        if context.segments.max_count == 0:
            return context.path
        return path_at(context.segments, context.path, z.to(context.path))

    @torch.no_grad()
    def infer(self, context: Context, observed: Tensor, mask: Tensor) -> Discrepancy:
        """The most probable z under heavy-tailed noise.

        Offsets start from the median of the steady part, delays from a grid; both are then refined
        together, because a delay and an offset trade off during motion. Outliers lose their weight
        (Tukey), so glitches do not change z. Outputs are compared in `Context.unit`, and of a
        sample the outputs that were measured count.
        """
        size = TRAJECTORIES_PER_BATCH
        parts = [
            self._infer(context[slice(i, i + size)], observed[i : i + size], mask[i : i + size])
            for i in range(0, len(context), size)
        ]
        return Discrepancy(
            torch.cat([part.z for part in parts]),
            torch.cat([part.covariance for part in parts]),
            torch.cat([part.identified for part in parts]),
            torch.cat([part.noise for part in parts]),
        )

    def _infer(self, context: Context, observed: Tensor, mask: Tensor) -> Discrepancy:
        unit, segments = context.unit.double(), context.segments
        problem = PathProblem.of(segments, context.path / unit, observed / unit, mask)
        z = torch.zeros(len(context), segments.max_count, 1 + len(unit), dtype=torch.float64)
        if segments.max_count == 0:
            matrix = z[..., None] * z[..., None, :]
            noise = problem.noise(problem.factor * (problem.observed - problem.path))
            return Discrepancy(z, matrix, z > 0, noise.scale[::2, 0] * unit.mean())
        z[..., 1:] = problem.first_offset(self.delay_range[1])
        z[..., 0] = first_delays(problem, z.flatten(1), self.delay_range)
        problem = problem.with_motion(z[..., 0])
        bounds = delay_bounds(segments, 1 + len(unit), self.delay_range, MAX_STEP)
        belief = self._learned(problem, problem.residual(z.flatten(1)))
        solution, belief = expectation_maximisation(
            Solution.of_prior(belief[1], z.flatten(1)),
            belief,
            infer=lambda found, belief: solve(
                problem, belief[1], belief[0], found.x, bounds=bounds, reweightings=1
            ),
            learn=lambda found, _: self._learned(problem, problem.residual(found.x)),
            rounds=ROUNDS,
        )
        return self._discrepancy(problem, solution, belief[0], belief[1], unit)

    def _learned(self, problem: PathProblem, residual: Tensor) -> tuple[Noise, GaussianPrior]:
        """The noise, and a prior much wider than anything plausible: what is not seen stays 0."""
        largest = residual.norm(dim=-1).amax(dim=1)
        wide = (WIDE * largest + 1e-9)[:, None].repeat(1, 1 + residual.shape[-1])
        wide[:, 0] = WIDE * (self.delay_range[1] - self.delay_range[0])
        wide = wide.repeat(1, problem.segments.max_count)
        prior = GaussianPrior.independent(torch.zeros_like(wide), wide.square())
        return problem.noise(residual), prior

    def _discrepancy(
        self,
        problem: PathProblem,
        solution: Solution,
        noise: Noise,
        prior: GaussianPrior,
        unit: Tensor,
    ) -> Discrepancy:
        """z, each segment's covariance, and which components the outputs identify."""
        z = problem.per_segment(solution.x)
        covariance = blocks(solution.covariance, z.shape[1])
        deviation = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
        wide = problem.per_segment(prior.deviation)
        low, high = self.delay_range
        delay = (deviation[..., 0] <= self.known_delay) & (z[..., 0] > low) & (z[..., 0] < high)
        delay = delay & (problem.motion_measured >= MEASURED_MOTION)
        offset = deviation[..., 1:] <= UNSEEN * wide[..., 1:]
        identified = torch.cat([delay[..., None], offset], dim=-1)
        identified = identified & torch.as_tensor(problem.segments.valid)[..., None]
        scale = torch.cat([unit.new_ones(1), unit])
        steady = torch.where(problem.measured > 0, noise.scale[problem.group][..., 0], torch.inf)
        return Discrepancy(
            z * scale,
            covariance * scale[:, None] * scale,
            identified,
            steady.amin(dim=1) * unit.mean(),
        )
