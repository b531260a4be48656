"""`DelayOffset`: the paper's correction operator (section 4.2.4) and its inverse.

Movements come late by TDe samples, and the position that is reached is off by TPE. Both are told by
knots: movement m begins at `start + TDe`, still off by the last movement's TPE, and ends at
`settle + TDe`, off by its own. Between knots time and offset are linear, so the path is continuous
whatever z is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from retwin.data.segments import Segments
from retwin.data.trajectories import Channels
from retwin.update.corrections.correction import Context, Discrepancy, Head
from retwin.update.corrections.warp import Knots, read

__all__ = ["DelayOffset"]

ITERATIONS = 25
CHUNK = 128


@dataclass(frozen=True)
class DelayOffset:
    """z = (TDe, TPE) per movement: delay in samples, offset of the steady part in output units.

    Parameters
    ----------
    delay_range: least and greatest delay that `infer` looks for, in samples.
    known_delay: standard deviation in samples above which a delay counts as not identified.

    """

    delay_range: tuple[float, float] = (-5.0, 30.0)
    known_delay: float = 3.0

    @property
    def resolution(self) -> str:
        """One z per movement."""
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
        knots = Knots.of(context.segments, z[..., 0].to(context.path))
        offset = knots.between(knots.spread(z[..., 1:].to(context.path)))
        return read(context.path, knots.source_time()) + offset

    @torch.no_grad()
    def infer(self, context: Context, observed: Tensor, mask: Tensor) -> Discrepancy:
        """The most plausible z under heavy-tailed noise (robust Gauss–Newton, batched).

        Offsets start from the median of the settled part, delays from a grid; both are then refined
        together, because a late movement and a wrong position trade off where they meet. Samples
        that fit badly lose their weight (Tukey), so glitches do not move z. Outputs are compared in
        `Context.unit`, and of a sample those count that were measured.
        """
        parts = [
            self._infer(context[slice(i, i + CHUNK)], observed[i : i + CHUNK], mask[i : i + CHUNK])
            for i in range(0, len(context), CHUNK)
        ]
        return Discrepancy(
            torch.cat([part.z for part in parts]),
            torch.cat([part.covariance for part in parts]),
            torch.cat([part.identified for part in parts]),
            torch.cat([part.noise for part in parts]),
        )

    def _infer(self, context: Context, observed: Tensor, mask: Tensor) -> Discrepancy:
        unit = context.unit.double()
        model = _Model(context.segments, context.path / unit, observed / unit, mask)
        n, most, width = len(context), context.segments.max_count, len(unit)
        valid = torch.as_tensor(context.segments.valid)
        z = torch.zeros(n, most, 1 + width, dtype=torch.float64)
        if most == 0:
            empty = torch.zeros(n, 0, 1 + width, 1 + width, dtype=torch.float64)
            nothing = torch.zeros(n, 0, 1 + width, dtype=torch.bool)
            noise = model.scale(model.off(model.path), torch.zeros_like(model.seen))
            return Discrepancy(z, empty, nothing, noise[:, 0] * unit.mean())
        z[..., 1:] = model.settled_offset(self.delay_range[1])
        z[..., 0] = self._best_delay(model, z)
        moving = _moving(context.segments, z[..., 0])
        low, high = self.delay_range
        damping = torch.full((n,), 1e-3, dtype=torch.float64)
        for _ in range(ITERATIONS):
            residual, jacobian = model.linearised(z)
            noise = model.scale(residual, moving)
            step = _solve(jacobian, residual, model.weight(residual, noise), damping)
            step = step.reshape(z.shape)
            # A few samples per step at most: the path is only piecewise smooth in the delay.
            step[..., 0] = step[..., 0].clamp(-5.0, 5.0)
            trial = z + step * valid[..., None]
            trial[..., 0] = trial[..., 0].clamp(low, high)
            better = model.cost(trial, noise) <= model.cost(z, noise)
            z = torch.where(better[:, None, None], trial, z)
            damping = torch.where(better, damping / 3, damping * 5).clamp(1e-9, 1e6)
        found = self._certainty(model, z, moving)
        size = torch.cat([unit.new_ones(1), unit])
        return replace(
            found,
            z=found.z * size,
            covariance=found.covariance * size[:, None] * size,
            noise=found.noise * unit.mean(),
        )

    def _best_delay(self, model: _Model, z: Tensor) -> Tensor:
        """The delay (n, M) on a grid of one sample that fits the motion best, by absolute error."""
        low, high = self.delay_range
        segments = model.segments
        grid = torch.arange(low, high + 1.0, 1.0, dtype=torch.float64)
        # Smallest first: where nothing was seen all fit alike, and the first one is taken.
        grid = grid[grid.abs().argsort(stable=True)]
        start, settle = torch.as_tensor(segments.start), torch.as_tensor(segments.settle)
        time = torch.arange(segments.steps, dtype=torch.float64)
        near = (time >= (start + low)[..., None]) & (time <= (settle + high)[..., None])
        costs = []
        for delay in grid:
            trial = z.clone()
            trial[..., 0] = delay
            error = model.length(model.residual(trial))
            costs.append((near * error[:, None]).sum(dim=-1))
        best = torch.stack(costs).argmin(dim=0)
        return grid[best] * torch.as_tensor(segments.valid)

    def _certainty(self, model: _Model, z: Tensor, moving: Tensor) -> Discrepancy:
        n, most, size = z.shape
        valid = torch.as_tensor(model.segments.valid)
        residual, jacobian = model.linearised(z)
        noise = model.scale(residual, moving)
        weight = model.weight(residual, noise)
        # Neighbouring errors are alike (polling, drift): each sample tells only a part.
        weight = weight / _correlation_time(residual, weight)[:, None, None]
        normal = torch.einsum("ntci,ntc,ntcj->nij", jacobian, weight, jacobian)
        # A prior a hundred times wider than anything plausible: what is not seen stays at it.
        largest = model.length(residual).amax(dim=1)
        wide = (100 * largest + 1e-9)[:, None].repeat(1, size)
        wide[:, 0] = 100.0 * (self.delay_range[1] - self.delay_range[0])
        prior = torch.diag_embed(wide.square().reciprocal().repeat(1, most))
        whole = _inverse(normal + prior).reshape(n, most, size, most, size)
        index = torch.arange(most)
        covariance = whole[:, index, :, index].transpose(0, 1)
        deviation = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
        at_edge = (z[..., 0] <= self.delay_range[0]) | (z[..., 0] >= self.delay_range[1])
        watched = _watched(model.segments, model.seen) >= 0.5
        late = (deviation[..., 0] <= self.known_delay) & ~at_edge & watched
        off = deviation[..., 1:] <= 0.1 * wide[:, None, 1:]
        identified = torch.cat([late[..., None], off], dim=-1)
        steady = torch.where(model.seen, noise, torch.inf).amin(dim=1)
        return Discrepancy(z, covariance, identified & valid[..., None], steady)


class _Model:
    """The corrected path as a function of z, its residual and its derivative."""

    def __init__(self, segments: Segments, path: Tensor, observed: Tensor, told: Tensor) -> None:
        self.segments = segments
        self.path = path
        self.observed = observed
        self.told = told  # (n, T, d_y), what was measured
        self.seen = told.any(dim=-1)
        # Where some outputs are missing the others stand for them.
        self.standing = (told.shape[-1] / told.sum(dim=-1).clamp_min(1)).sqrt()
        # Exactly the derivative of what `_read` gives between two samples.
        self.slope = path.diff(dim=1, append=path[:, -1:])

    def off(self, said: Tensor) -> Tensor:
        """Observed minus said (n, T, d_y), 0 where nothing was measured."""
        return torch.where(self.told, self.observed - said, 0.0)

    def residual(self, z: Tensor) -> Tensor:
        """Observed minus corrected (n, T, d_y)."""
        knots = Knots.of(self.segments, z[..., 0])
        offset = knots.between(knots.spread(z[..., 1:]))
        return self.off(read(self.path, knots.source_time()) + offset)

    def length(self, residual: Tensor) -> Tensor:
        """How far off each sample is, (n, T)."""
        return residual.norm(dim=-1) * self.standing

    def scale(self, residual: Tensor, moving: Tensor) -> Tensor:
        """A robust scale (n, T) of the residual's length: its median in motion, and at rest.

        A model of movements is always worse than one of rest; one scale would throw motion away.
        """
        length = self.length(residual)
        extent = length.amax(dim=1, keepdim=True).clamp_min(1e-9)
        scales = []
        for part in (moving, ~moving):
            within = torch.where(self.seen & part, length, torch.nan)
            middle = 1.4826 * torch.nanmedian(within, dim=1, keepdim=True).values
            scales.append(torch.nan_to_num(middle).maximum(1e-4 * extent))
        steady = scales[1].maximum(0.01 * scales[0])
        return torch.where(moving, scales[0].maximum(steady), steady)

    def weight(self, residual: Tensor, noise: Tensor) -> Tensor:
        """Tukey's biweight (n, T, d_y) on the residual's length, over the noise's variance."""
        size = self.length(residual) / noise / TUKEY
        kept = (1 - size.clamp_max(1).square()).square() / noise.square()
        return self.told * kept[..., None]

    def cost(self, z: Tensor, noise: Tensor) -> Tensor:
        """Tukey's loss (n,) at a given noise scale (n, T)."""
        size = self.length(self.residual(z)) / noise / TUKEY
        return (1 - (1 - size.clamp_max(1).square()) ** 3).sum(dim=1)

    def settled_offset(self, margin: float) -> Tensor:
        """Median residual (n, M, d_y) of each steady part, without late movements if any remain."""
        settle, stop = torch.as_tensor(self.segments.settle), torch.as_tensor(self.segments.stop)
        begin = settle + torch.minimum(torch.full_like(settle, margin), (stop - settle) / 2)
        time = torch.arange(self.segments.steps, dtype=torch.float64)
        inside = (time >= begin[..., None]) & (time < stop[..., None])
        there = inside[..., None] & self.told[:, None]
        values = torch.where(there, self.off(self.path)[:, None], torch.nan)
        return torch.nan_to_num(torch.nanmedian(values, dim=2).values)

    def linearised(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Residual (n, T, d_y) and the corrected path's derivative (n, T, d_y, M (1 + d_y))."""
        knots = Knots.of(self.segments, z[..., 0])
        n, most, size = z.shape
        values = knots.spread(z[..., 1:])
        when = knots.source_time()
        residual = self.off(read(self.path, when) + knots.between(values))
        unit = torch.eye(most, dtype=z.dtype).expand(n, -1, -1)
        reach = knots.between(knots.spread(unit))  # (n, T, M): share of each movement's offset
        late = knots.between(unit.repeat_interleave(2, dim=1))  # share of each movement's delay
        below = when.floor().long().clamp(0, self.path.shape[1] - 1)
        index = below[..., None].expand(-1, -1, self.path.shape[2])
        velocity = self.slope.gather(1, index) + knots.slope(values)
        jacobian = torch.zeros(*residual.shape, most, size, dtype=z.dtype)
        jacobian[..., 0] = -velocity[..., None] * late[:, :, None]
        for channel in range(size - 1):
            jacobian[:, :, channel, :, 1 + channel] = reach
        return residual, jacobian.flatten(3)


TUKEY = 4.685  # 95 % efficiency under Gaussian noise


def _moving(segments: Segments, delay: Tensor) -> Tensor:
    """(n, T) True where a movement is under way, with some samples around it."""
    time = torch.arange(segments.steps, dtype=torch.float64)
    begin = (torch.as_tensor(segments.start) + delay - 5)[..., None]
    end = (torch.as_tensor(segments.settle) + delay + 10)[..., None]
    valid = torch.as_tensor(segments.valid)[..., None]
    return ((time >= begin) & (time <= end) & valid).any(dim=1)


def _watched(segments: Segments, seen: Tensor) -> Tensor:
    """(n, M) share of each motion part that was measured."""
    time = torch.arange(seen.shape[1], dtype=torch.float64)
    start, settle = torch.as_tensor(segments.start), torch.as_tensor(segments.settle)
    inside = (time >= start[..., None]) & (time <= settle[..., None])
    return (inside * seen[:, None]).sum(dim=-1) / inside.sum(dim=-1).clamp_min(1)


def _solve(jacobian: Tensor, residual: Tensor, weight: Tensor, damping: Tensor) -> Tensor:
    """A damped weighted least-squares step (n, parameters)."""
    weighted = jacobian * weight[..., None]
    normal = torch.einsum("ntci,ntcj->nij", weighted, jacobian)
    right = torch.einsum("ntci,ntc->ni", weighted, residual)
    unit, scaled = _in_own_units(normal)
    ridge = torch.diag_embed((damping[:, None] + 1e-9).expand_as(unit))
    return torch.linalg.solve(scaled + ridge, right / unit) / unit


def _inverse(normal: Tensor) -> Tensor:
    unit, scaled = _in_own_units(normal)
    return torch.linalg.inv(scaled) / unit[:, :, None] / unit[:, None, :]


def _in_own_units(normal: Tensor) -> tuple[Tensor, Tensor]:
    """The matrix scaled to a unit diagonal: delays and offsets differ by orders of magnitude."""
    unit = normal.diagonal(dim1=-2, dim2=-1).sqrt()
    unit = torch.where(unit > 0, unit, torch.ones_like(unit))
    return unit, normal / unit[:, :, None] / unit[:, None, :]


def _correlation_time(residual: Tensor, weight: Tensor) -> Tensor:
    """Samples (n,) per independent one, from the lag-one correlation of the residual."""
    kept = residual * weight.sqrt()
    power = kept.square().sum(dim=(1, 2)).clamp_min(1e-30)
    alike = ((kept[:, 1:] * kept[:, :-1]).sum(dim=(1, 2)) / power).clamp(0, 0.999)
    return (1 + alike) / (1 - alike)
