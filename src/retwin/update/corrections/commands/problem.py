"""The problem of `CommandSpace`: measured outputs, and the surrogate's outputs for any z."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from retwin.inference.noise import Noise
from retwin.inference.problem import CommonError
from retwin.inference.solver import Bounds
from retwin.update.corrections.commands.effective_commands import (
    command_jacobians,
    effective_commands,
)
from retwin.update.corrections.correction import Context, DifferentiableTwin
from retwin.update.corrections.delays import (
    DelayProblem,
    delay_bounds,
    gather_samples,
    interpolate,
    thinned,
    within,
)
from retwin.update.corrections.sampled_sensor import lattice_step
from retwin.update.corrections.surrogate_slopes import differences, outputs_at, slopes_at
from retwin.update.kernels.generation import linearised_outputs

COMMAND_STEP = 1e-4
"""Step of finite differences through the effective commands, which are piecewise linear in x."""
COMMON_ERROR = 0.25
"""Variance of the error that all samples of a segment have in common, relative to that of one
sample: what rounding leaves, on average over sensors whose noise is a tenth to a quarter of their
resolution. Outputs cannot tell it from an offset, so it is no estimate."""
GAIN_STEP = 5e-3
"""Step of the finite differences of the gain, in standard deviations of a command."""
TRAJECTORIES_PER_BATCH = 64
"""Trajectories linearised together, which bounds memory."""


@dataclass(frozen=True, eq=False)
class CommandProblem(DelayProblem):
    """Residual and Jacobian for x = (delay, offsets) of every segment, given what was missed.

    The engine's rows are trajectories, its latent variables x (n, P), P = M (1 + d_u). With
    `own_delays` they end in one more delay for every actuator, P = M (1 + 2 d_u).

    Attributes
    ----------
    sample : Tensor
        (n, S), the samples used of each trajectory, in order. A trajectory that has fewer than S
        repeats its last one.
    measured : Tensor
        (n, S), 1 where `sample` was measured, less where replicates err alike, 0 where it only
        fills the row.
    group : Tensor
        (n, S) long, 1 where a segment may be in motion, where the surrogate is less accurate; 0 at
        rest.
    observed : Tensor
        (n, S, d_y), in `unit`.
    surrogate : DifferentiableTwin
        Commands to outputs.
    reference : Tensor
        (n, T, d_u), the commands that were sent, faults on them included.
    frozen : Tensor
        (n, d_u), the sample from which a fault holds an actuator, T for never.
    unit : Tensor
        (d_y,), the unit of the residual in that of the outputs.
    rounding : Tensor
        (d_y,), variance of the error of a sample by rounding, in `unit` squared.
    valid : Tensor
        (n, M) bool, segments that exist.
    healthy : Tensor
        (n, M, d_u) bool, where z is a discrepancy: no fault bends or holds the actuator.
    faulty : Tensor
        (n, M, d_u) bool, where a fault bends the reference: the error of the actuator is the
        fault's severity, about which the prior is nearly flat.
    missed : Tensor
        (n, M, d_u), 1 where an actuator missed a segment.
    whitening : Tensor, optional
        (n, S, d_y, d_y), the factor by which residuals and Jacobians are multiplied, so that the
        errors of a sample's outputs are independent and of one size.
    own_delays : bool
        Whether every actuator has a delay of its own besides the common one.
    common : CommonError, optional
        The surrogate's error, which all samples of a segment have in common; None for a surrogate
        without any.

    """

    surrogate: DifferentiableTwin
    reference: Tensor
    frozen: Tensor
    unit: Tensor
    rounding: Tensor
    valid: Tensor
    healthy: Tensor
    faulty: Tensor
    missed: Tensor
    whitening: Tensor | None = None
    own_delays: bool = False
    common: CommonError | None = None
    shared = ("surrogate", "unit", "rounding", "delay_range", "own_delays")

    @classmethod
    def of(
        cls,
        context: Context,
        observed: Tensor,
        mask: Tensor,
        *,
        delay_range: tuple[float, float],
        max_samples: int,
        unit: Tensor | None = None,
        settling_delays: float = 0.5,
    ) -> CommandProblem:
        """The problem of outputs (n, T, d_y) that were measured where `mask` is True.

        Only samples at which all outputs were measured are used, `max_samples` of each trajectory
        at most. By default the unit is that in which the outputs' standard deviation is 1.

        Parameters
        ----------
        settling_delays : float, default 0.5
            Time after the end of a command's ramp in which an output may still be in motion, in
            largest delays.

        """
        segments = context.segments
        start = torch.as_tensor(segments.start)[..., None]
        valid = torch.as_tensor(segments.valid)
        bent = (context.faulty_commands != context.commands).any(dim=1)[:, None]
        whole = mask.all(dim=-1)
        sample, used = thinned(whole, max_samples)
        unit = _unit(context, observed.double()[whole]) if unit is None else unit
        steps = [lattice_step(each) for each in observed.double()[whole].numpy().T]
        values = torch.where(whole[..., None], observed.double(), 0.0)
        settling = settling_delays * max(delay_range[1], 0.0)
        near = within(sample, segments.start + delay_range[0], segments.settle + settling)
        healthy = valid[..., None] & ~bent & (start < context.frozen[:, None])
        problem = cls(
            surrogate=context.surrogate,
            segments=segments,
            reference=context.faulty_commands.double(),
            frozen=context.frozen.double(),
            sample=sample,
            measured=used.double(),
            group=(near & valid[..., None]).any(dim=1).long(),
            observed=gather_samples(values, sample) / unit,
            unit=unit,
            rounding=(unit.new_tensor(steps) / unit).square() / 12,
            valid=valid,
            healthy=healthy,
            faulty=bent & valid[..., None],
            missed=torch.zeros(healthy.shape, dtype=torch.float64),
            delay_range=delay_range,
        )
        if context.surrogate_variance is None:
            return problem
        inside = problem.inside
        variance = inside.mT @ (context.surrogate_variance / unit.square())
        block = (inside.mT @ inside.sum(dim=-1, keepdim=True))[..., 0]
        return replace(problem, common=CommonError(variance, block))

    def __len__(self) -> int:
        return len(self.reference)

    def counted_once(self, replicates: Tensor) -> CommandProblem:
        """The same where all replicates of a segment, (n, M) in number, err alike.

        In motion they do, because paths between two levels are the same: all of them count as one.
        The surrogate's error is the same, too.
        """
        own = self.inside
        times = (own.mT @ replicates[..., None])[..., 0] + 1 - own.sum(dim=1)
        moving, common = self.group == 1, self.common
        if common is not None:
            block = torch.where(moving, common.block, common.block * times)
            common = CommonError(common.variance, block)
        measured = torch.where(moving, self.measured / times, self.measured)
        return replace(self, measured=measured, common=common)

    def with_missed(self, missed: Tensor) -> CommandProblem:
        """The same if the actuators missed other segments, (n, M, d_u)."""
        return replace(self, missed=missed)

    def held_from(self, frozen: Tensor) -> CommandProblem:
        """The same if faults hold the actuators from other samples (n, d_u) on."""
        start = torch.as_tensor(self.segments.start)[..., None]
        healthy = self.valid[..., None] & (start < frozen[:, None])
        return replace(self, frozen=frozen.double(), healthy=healthy)

    @property
    def where_certain(self) -> CommandProblem:
        """The problem from which hyperparameters are learned, as if the surrogate were exact.

        Segments in which it errs much more than in others count as not measured. An upper bound
        of its error, taken for noise, would leave too little for the variance of the offsets.
        """
        if self.common is None:
            return self
        variance = self.common.variance.mean(dim=-1)
        known = (self.measured > 0) & (self.common.block > 0)
        # Error of the surrogate, in that of half of the samples, beyond which nothing is learned
        # from a segment but its own z.
        limit = 2.0**2 * variance[known].median() if known.any() else torch.inf
        return replace(self, common=None, measured=self.measured * (variance <= limit))

    @property
    def memory(self) -> bool:
        """Whether the surrogate's outputs depend on earlier commands."""
        return not getattr(self.surrogate, "memoryless", False)

    @property
    def zero(self) -> Tensor:
        """The x (n, P) of trajectories without any discrepancy."""
        n, segments, _ = self.missed.shape
        return self.observed.new_zeros(n, segments * self.size)

    @property
    def size(self) -> int:
        """Latent variables per segment."""
        return 1 + (1 + self.own_delays) * self.missed.shape[2]

    @property
    def bounds(self) -> Bounds:
        """The range of delays as limits of x."""
        return delay_bounds(self.segments, self.size, self.delay_range)

    def learned_noise(
        self, noise: Noise, residual: Tensor, variance: Tensor | float = 0.0, floor: float = 1e-18
    ) -> Noise:
        """The noise at rest and in motion, see `Noise.learned`: a block of samples is a segment.

        In motion the errors by rounding are as good as independent.
        """
        rounding = self.rounding
        if self.whitening is not None:
            rounding = self.whitening.square()[self.measured > 0].mean(dim=0) @ rounding
        return noise.learned(
            self,
            residual,
            common=COMMON_ERROR,
            blocks=max(1.0, float(self.valid.sum())),
            rounding=(float(rounding.mean()), 0.0),
            variance=variance,
            floor=floor,
        )

    def creep(self, noise: Noise, residual: Tensor, *, samples_of_halves: int = 4) -> float:
        """Samples of a rest per independent one if actuators creep.

        A random walk ends as far from its mean as the means of its halves are apart: by a variance
        that all samples have in common. The residual is (n, S, d_y); what independent errors
        explain of the distance of these means is no creep.

        Parameters
        ----------
        samples_of_halves : int, default 4
            Samples at least of a rest whose halves are compared.

        """
        rest = self.inside * (self.group == 0)[:, None]
        count = rest.sum(dim=-1)
        first = rest * (2 * rest.cumsum(dim=-1) <= count[..., None])
        weights = noise.weights(self, residual)[:, None]
        means, weight = [], []
        for half in (first * weights, (rest - first) * weights):
            weight.append(half.sum(dim=-1).clamp_min(1e-12))
            means.append(half @ residual / weight[-1][..., None])
        apart = ((means[0] - means[1]).square() / noise.scale[0].square()).mean(dim=-1)
        excess = (apart - 1 / weight[0] - 1 / weight[1])[count >= samples_of_halves]
        # Rests without any creep that are assumed besides those measured.
        common = COMMON_ERROR + max(0.0, float(excess.sum()) / (len(excess) + 2.0))
        return 1 + common * float(count.sum()) / max(1.0, float(self.valid.sum()))

    @property
    def inside(self) -> Tensor:
        """(n, M, S), 1 where a measured sample belongs to a segment."""
        segment = within(self.sample, self.segments.start, np.ceil(self.segments.stop) - 1)
        return segment.double() * (self.measured > 0)[:, None]

    @property
    def levels(self) -> tuple[Tensor, Tensor]:
        """Commands (n, M, d_u) before and after each segment."""
        times = map(torch.as_tensor, (self.segments.start, self.segments.settle))
        first, last = (interpolate(self.reference, each) for each in times)
        return first, last

    @property
    def distance(self) -> Tensor:
        """How far each actuator was to move in each segment, (n, M, d_u)."""
        first, last = self.levels
        return (last - first).abs()

    @property
    def way(self) -> Tensor:
        """How far each actuator is from its target when a segment begins, (n, M, d_u).

        An actuator that missed segments is still where it was before them.
        """
        first, last = self.levels
        ways, place = torch.zeros_like(last), first[:, 0]
        for m in range(last.shape[1]):
            ways[:, m] = (last[:, m] - place).abs()
            place = torch.where(self.missed[:, m] > 0.5, place, last[:, m])
        return ways

    def commands(self, x: Tensor) -> Tensor:
        """Effective commands, single precision, at `sample`; with memory, at every sample."""
        return self._effective(self.per_segment(x), torch.arange(len(self))).float()

    def predicted(self, commands: Tensor) -> Tensor:
        """The surrogate's outputs (n, S, d_y) at `sample` for such commands."""
        outputs = self.surrogate(commands)
        return gather_samples(outputs, self.sample) if self.memory else outputs

    @torch.no_grad()
    def residual(self, x: Tensor) -> Tensor:
        """Measured minus predicted outputs (n, S, d_y) for x (n, P), in `unit`."""
        return torch.cat([part._white(part._residual(some)) for part, some in self._batches(x)])

    @torch.no_grad()
    def linearised(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The residual, and the Jacobian (n, S, d_y, P) of the predicted outputs."""
        made = None if self.memory else linearised_outputs(self, x, COMMAND_STEP)
        if made is not None:
            return self._white(self.observed - made[0]), self._white(made[1])
        parts = [map(part._white, part._linearised(some)) for part, some in self._batches(x)]
        residual, jacobian = zip(*parts, strict=True)
        return torch.cat(residual), torch.cat(jacobian)

    @torch.no_grad()
    def gain(self) -> Tensor:
        """Change (n, S, d_y, d_u) of the outputs, in `unit`, by a constant change of a command."""
        made = []
        for part, zero in self._batches(self.zero):
            steps = (GAIN_STEP * part.spread).tolist()
            made.append(differences(part.predicted, part.commands(zero), steps))
        return torch.cat(made) / self.unit[:, None]

    @property
    def _times(self) -> Tensor:
        """Samples (n, ·) at which the surrogate needs commands: with memory, all of them."""
        if self.memory:
            return torch.arange(self.reference.shape[1]).expand(len(self), -1)
        return self.sample

    def _batches(self, x: Tensor) -> Iterator[tuple[CommandProblem, Tensor]]:
        if len(self) <= TRAJECTORIES_PER_BATCH:
            yield self, x
            return
        for rows in torch.arange(len(self)).split(TRAJECTORIES_PER_BATCH):
            yield self[rows], x[rows]

    def _white(self, values: Tensor) -> Tensor:
        """Values (n, S, d_y) or (n, S, d_y, P) times `whitening`."""
        if self.whitening is None:
            return values
        columns = values[..., None] if values.ndim == 3 else values
        return (self.whitening @ columns).view_as(values)

    @property
    def spread(self) -> Tensor:
        """Standard deviation (d_u,) of the commands' levels; of constant ones, their size."""
        ends = torch.cat([each[self.valid] for each in self.levels])
        spread, size = ends.std(dim=0, correction=0).nan_to_num(0.0), ends.abs().mean(dim=0)
        size = torch.where(size > 0, size, 1.0)
        return torch.where(spread > 1e-9 * size, spread, size)

    def _residual(self, x: Tensor) -> Tensor:
        commands = self.commands(x)
        outputs = self.predicted(commands) if self.memory else outputs_at(self.surrogate, commands)
        return self.observed - outputs.double() / self.unit

    def _linearised(self, x: Tensor) -> tuple[Tensor, Tensor]:
        if self.memory:
            residual = self._residual(x)
            # Step of finite differences of delays through a surrogate with memory, in samples:
            # larger than the rounding of single precision.
            delay = torch.full((self.size - len(self.spread),), 0.05)
            step = torch.cat([delay[:1], GAIN_STEP * self.spread, delay[1:]])
            moves = torch.diag(step.to(x).repeat(self.missed.shape[1]))
            columns = [(residual - self._residual(x + each)) / each.sum() for each in moves]
            return residual, torch.stack(columns, dim=-1)
        # Without memory the chain rule is local: the surrogate's Jacobian, sample by sample.
        commands, delay, offset = command_jacobians(
            self._effective, self.per_segment(x), self.missed.shape[2], COMMAND_STEP
        )
        outputs, slopes = slopes_at(self.surrogate, commands.float())
        residual = self.observed - outputs.double() / self.unit
        by_command = slopes.double() / self.unit[..., None]
        by_delay = torch.einsum("nsyu,nmsu->nsym", by_command, delay)[..., None]
        by_offset = torch.einsum("nsyu,nmsu->nsymu", by_command, offset)
        parts = [by_delay, by_offset]
        if self.own_delays:
            parts.append(torch.einsum("nsyu,nmsu->nsymu", by_command, delay))
        return residual, torch.cat(parts, dim=-1).flatten(3)

    def _effective(self, x: Tensor, rows: Tensor) -> Tensor:
        """Effective commands for x (k, M, size) of the trajectories `rows` (k,), in order."""
        common, own = x.split([1 + self.missed.shape[2], self.size - 1 - self.missed.shape[2]], -1)
        return effective_commands(
            self.reference,
            self.segments[rows.numpy()],
            torch.cat([common, self.missed[rows]], dim=-1),
            self._times[rows],
            self.frozen[rows],
            own if self.own_delays else None,
        )


def _unit(context: Context, measured: Tensor) -> Tensor:
    """`context.unit` times a number for which the standard deviation of (k, d_y) is about 1.

    The same unit where nothing is measured, or outputs never change.
    """
    unit = context.unit.double()
    if not len(measured):
        return unit
    ratio = (measured.std(dim=0, correction=0) / unit).mean()
    return unit * ratio if ratio > 1e-12 else unit
