"""The problem of `DelayOffset`: measured outputs, and the corrected path for any z."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from retwin.data.segments import Segments
from retwin.inference.noise import Noise, Tukey, common_rounding, correlation_time
from retwin.inference.solver import Bounds
from retwin.update.corrections.delays import DelayProblem, Knots, delay_bounds, interpolate, within
from retwin.update.corrections.sampled_sensor import lattice_step

MAX_STEP = 1 / 7
"""Largest change of a delay in one step, in widths of its range: the path is only piecewise smooth
in it."""
AROUND = (1 / 7, 2 / 7)
"""Time before and after a motion that counts as motion, in widths of the range of delays: its
timing is not exactly known."""
SINGLE = torch.finfo(torch.float32).eps
"""Relative distance of neighbouring numbers in single precision."""


def path_at(segments: Segments, path: Tensor, z: Tensor) -> Tensor:
    """The path (n, T, d_y), delayed and offset by z (n, M, 1 + d_y); continuous whatever z is."""
    knots = Knots.of(segments, z[..., 0])
    return interpolate(path, knots.source_time()) + knots.between(knots.spread(z[..., 1:]))


@dataclass(frozen=True, eq=False)
class PathProblem(DelayProblem):
    """Residual and Jacobian for x = (delay, offsets) of every segment.

    The engine's rows are trajectories, its latent variables x (n, P), P = M (1 + d_y). Samples at
    rest and in motion form groups of each trajectory's own: 2 i and 2 i + 1 of trajectory i. Where
    some outputs of a sample are missing, the others stand for them: residuals are scaled so that
    their length is comparable.

    Attributes
    ----------
    common : None
        The surrogate's error, which the path contains, is added to the covariance of z.
    path : Tensor
        (n, T, d_y), uncorrected; `observed` is in the same unit, and every `sample` (T,) is used.
    available : Tensor
        (n, T, d_y) bool, which outputs were measured; `measured` (n, T) is the share of a sample's
        outputs that was.
    factor : Tensor
        (n, T, d_y), what residuals are multiplied by; 0 where nothing was measured.
    rounding : float
        Standard deviation of the error of a sample by rounding, of all outputs together.

    """

    path: Tensor
    available: Tensor
    factor: Tensor
    rounding: float
    common: ClassVar[None] = None
    shared = ("sample", "delay_range", "rounding")

    @classmethod
    def of(
        cls,
        segments: Segments,
        path: Tensor,
        observed: Tensor,
        available: Tensor,
        delay_range: tuple[float, float],
    ) -> PathProblem:
        """The problem with all samples at rest."""
        measured = available.double().mean(dim=-1)
        factor = available * measured.clamp_min(1e-9).rsqrt()[..., None]
        group = (2 * torch.arange(len(path)))[:, None].expand(path.shape[:2])
        # What was not measured may be any number, NaN included.
        observed = torch.where(available, observed, 0.0)
        # Paths are computed in single precision, whose rounding is the same at rest too.
        single = SINGLE * path.abs().amax(dim=(0, 1))
        columns = observed.flatten(0, 1).T, available.flatten(0, 1).T, single
        steps = [
            max(lattice_step(each[seen].numpy()), float(least))
            for each, seen, least in zip(*columns, strict=True)
        ]
        rounding = math.hypot(*steps) / math.sqrt(12)
        sample, given = torch.arange(segments.steps, dtype=torch.float64), (path, available)
        common = segments, sample, measured, group, observed, delay_range
        return cls(*common, *given, factor, rounding)

    def with_motion(self, delay: Tensor) -> PathProblem:
        """The same with motion where segments delayed by (n, M) samples are under way."""
        start, settle = map(torch.as_tensor, (self.segments.start, self.segments.settle))
        valid = torch.as_tensor(self.segments.valid)
        before, after = (self.width * each for each in AROUND)
        inside = within(self.sample, start + delay - before, settle + delay + after)
        moving = (inside & valid[..., None]).any(dim=1)
        return replace(self, group=2 * (self.group // 2) + moving)

    @property
    def bounds(self) -> Bounds:
        """The range of delays, and the largest step, as limits of x."""
        step = MAX_STEP * self.width
        return delay_bounds(self.segments, 1 + self.path.shape[2], self.delay_range, step)

    @property
    def motion_measured(self) -> Tensor:
        """Share (n, M) of the samples of each motion at which any output was measured.

        Relative to that of the trajectory's best measured segment: a sensor may be slow throughout.
        """
        start, settle, stop = self.segments.start, self.segments.settle, self.segments.stop
        seen = self.available.any(dim=-1)[:, None]
        parts = [within(self.sample, start, end) for end in (settle, stop)]
        motion, whole = ((e * seen).sum(dim=-1) / e.sum(dim=-1).clamp_min(1) for e in parts)
        return motion / whole.amax(dim=1, keepdim=True).clamp_min(1e-9)

    def residual(self, x: Tensor) -> Tensor:
        """Measured minus corrected path (n, T, d_y), 0 where nothing was measured."""
        corrected = path_at(self.segments, self.path, self.per_segment(x))
        return self.factor * (self.observed - corrected)

    def linearised(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The residual, and the Jacobian (n, T, d_y, P) of the corrected path."""
        z = self.per_segment(x)
        n, segments, size = z.shape
        knots = Knots.of(self.segments, z[..., 0])
        values, times = knots.spread(z[..., 1:]), knots.source_time()
        path = interpolate(self.path, times)
        # The derivative between two samples is exactly their difference.
        slope = self.path.diff(dim=1, append=self.path[:, -1:])
        below = times.floor().long().clamp(0, self.path.shape[1] - 1)
        # Before its first sample the path is held; after the last one the difference is 0.
        slope = slope.gather(1, below[..., None].expand_as(path)) * (times >= 0)[..., None]
        slope = slope + knots.slope(values)
        unit = torch.eye(segments, dtype=z.dtype).expand(n, -1, -1)
        of_offset = knots.between(knots.spread(unit))  # (n, T, M)
        of_delay = knots.between(unit.repeat_interleave(2, dim=1))
        jacobian = torch.zeros(*path.shape, segments, size, dtype=z.dtype)
        jacobian[..., 0] = -(self.factor * slope)[..., None] * of_delay[:, :, None]
        for output in range(size - 1):
            jacobian[:, :, output, :, 1 + output] = self.factor[:, :, output, None] * of_offset
        residual = self.factor * (self.observed - path - knots.between(values))
        return residual, jacobian.flatten(3)

    def first_offset(self, margin: float) -> Tensor:
        """Median (n, M, d_y) of observed minus path at rest, `margin` samples after the motion.

        Of a short rest its second half is used.
        """
        there = self.at_rest(margin)[..., None] & self.available[:, None]
        values = torch.where(there, (self.observed - self.path)[:, None], torch.nan)
        return torch.nan_to_num(torch.nanmedian(values, dim=2).values)

    def noise(self, residual: Tensor, *, max_correlation: float = 0.999) -> Noise:
        """Tukey's noise of every trajectory: its median residual in motion and at rest.

        The model is always worse in motion than at rest; one scale would give motion no weight.

        Parameters
        ----------
        max_correlation : float, default 0.999
            Largest lag-one autocorrelation of residuals: slow drift makes nearly all samples one.

        """
        length = residual.norm(dim=-1)
        extent = length.amax(dim=1).clamp_min(1e-9)
        moving = self.group % 2 == 1
        scales = []
        for part in (moving, ~moving):
            within = torch.where((self.measured > 0) & part, length, torch.nan)
            median = 1.4826 * torch.nanmedian(within, dim=1).values
            scales.append(torch.nan_to_num(median).maximum(1e-4 * extent))
        rest = scales[1].maximum(0.01 * scales[0]).clamp_min(self.rounding)
        scale = torch.stack([rest, scales[0].maximum(rest)], dim=1).flatten()[:, None]
        noise = Noise(scale, torch.ones_like(scale[:, 0]), Tukey())
        kept = residual * noise.precision(self, residual).sqrt()
        time = correlation_time(kept, self.measured, rows=True, limit=max_correlation)
        # Samples at rest are all rounded the same way, unless their noise is as large.
        common = common_rounding(scales[1].square(), self.rounding**2) / rest.square()
        same = common * (self.measured * ~moving).sum(dim=1)
        segments = torch.as_tensor(self.segments.valid).sum(dim=1).clamp_min(1)
        thinning = torch.stack([time.maximum(same / segments), time], dim=1).flatten()
        return replace(noise, thinning=thinning)
