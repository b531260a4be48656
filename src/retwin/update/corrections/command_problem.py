"""What `CommandSpace` is inferred from: measured outputs, and what a surrogate says for any z."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from retwin.update.corrections.command_effect import effective
from retwin.update.corrections.correction import Context
from retwin.update.corrections.warp import gather_samples
from retwin.update.piecewise_linear import distinct

if TYPE_CHECKING:
    from retwin.update.corrections.command_space import CommandSpace

__all__ = ["TAILS", "Problem"]

NUDGE = 0.05
"""Step of the finite differences through a surrogate with memory, in samples and units."""
TURN = 1e-4
"""The same through the commands alone, which follow x piece by piece in a straight line."""
MARGIN = 15
"""Samples after the command has settled in which an output may still be on its way."""
TAILS = 4.0
"""Degrees of freedom of the noise (Student's t): glitches do not count."""
CHUNK = 64
"""Trajectories linearised together."""
ROWS = ("told", "at", "seen", "moving", "observed", "valid", "healthy", "faulty", "frozen")
"""Attributes of `Problem` that have one row per trajectory."""


class Problem:
    """Residual and derivative for x = (delay, offsets) per movement (n, M, 1 + d_u) and for what
    was missed (n, M, d_u).

    Attributes
    ----------
    told: (n, T, d_u), the reference, faults included.
    at: (n, S), the samples used of each trajectory, in order. A trajectory that has fewer than S
        repeats its last one.
    seen: (n, S), 1 where `at` is a measured sample, 0 where it only fills the row.
    moving: (n, S), 1 where a movement may be under way: there the surrogate is told less exactly.
    observed: (n, S, d_y), in `unit` (d_y,), the standard deviation of the outputs.
    valid: (n, M) bool, movements that exist.
    healthy: (n, M, d_u) bool, where z is a discrepancy: no fault bends or holds the actuator.
    faulty: (n, M, d_u) bool, where a fault bends the reference: how far off the actuator ends is
        the fault's severity, of which nothing is believed beforehand.

    """

    def __init__(
        self, operator: CommandSpace, context: Context, observed: Tensor, mask: Tensor
    ) -> None:
        self.operator = operator
        self.surrogate = context.surrogate
        self.segments = context.segments
        self.told = context.faulty_commands.double()
        start = torch.as_tensor(context.segments.start)[..., None]
        bent = (context.faulty_commands != context.commands).any(dim=1)[:, None]
        self.valid = torch.as_tensor(context.segments.valid)
        self.faulty = bent & self.valid[..., None]
        self.healthy = self.valid[..., None] & ~bent & (start < context.frozen[:, None])

        seen = mask.all(dim=-1)
        self.at, used = _thinned(seen, operator.most)
        self.seen = used.double()
        told = observed.double()[seen]
        unit = context.unit.double()
        spread = told.std(dim=0, correction=0) / unit if len(told) else torch.ones_like(unit)
        self.unit = unit * spread.mean().clamp_min(1e-12)
        values = torch.where(seen[..., None], observed.double(), 0.0)
        self.observed = gather_samples(values, self.at) / self.unit
        begin = start + operator.delay_range[0]
        end = torch.as_tensor(context.segments.settle)[..., None] + MARGIN
        at = self.at[:, None]
        near = (at >= begin) & (at <= end) & self.valid[..., None]
        self.moving = near.any(dim=1).double()
        # A surrogate with memory must be told everything that came before.
        self.memory = not getattr(context.surrogate, "memoryless", False)
        self.frozen = context.frozen.double()

    def __len__(self) -> int:
        return len(self.told)

    def __getitem__(self, rows: Tensor) -> Problem:
        """The problem of some of the trajectories."""
        part = object.__new__(Problem)
        part.__dict__.update(self.__dict__)
        part.segments = self.segments[rows.numpy()]
        for name in ROWS:
            setattr(part, name, getattr(self, name)[rows])
        return part

    @property
    def when(self) -> Tensor:
        """Samples (n, ·) at which the surrogate needs commands: with memory, all of them."""
        if self.memory:
            return torch.arange(self.told.shape[1]).expand(len(self), -1)
        return self.at

    def predicted(self, commands: Tensor) -> Tensor:
        """The surrogate's outputs (n, S, d_y) at `at` for commands at `when`."""
        outputs = self.surrogate(commands)
        return gather_samples(outputs, self.at) if self.memory else outputs

    def nothing(self) -> tuple[Tensor, Tensor]:
        """What x and missed are of trajectories without any discrepancy."""
        shape = (*self.valid.shape, self.told.shape[2])
        x = torch.zeros(*shape[:2], 1 + shape[2], dtype=torch.float64)
        return x, torch.zeros(shape, dtype=torch.float64)

    def commands(self, x: Tensor, missed: Tensor) -> Tensor:
        """What the actuators are effectively told, single precision."""
        z = torch.cat([x, missed], dim=-1)
        return effective(self.told, self.segments, z, self.when, self.frozen).float()

    @torch.no_grad()
    def residual(self, x: Tensor, missed: Tensor) -> Tensor:
        """Observed minus said (n, S, d_y)."""
        return torch.cat([part._residual(*given) for part, given in self._parts(x, missed)])

    @torch.no_grad()
    def linearised(self, x: Tensor, missed: Tensor) -> tuple[Tensor, Tensor]:
        """The residual, and how the outputs turn with x: (n, S, d_y, P)."""
        parts = [part._linearised(*given) for part, given in self._parts(x, missed)]
        residual, jacobian = zip(*parts, strict=True)
        return torch.cat(residual), torch.cat(jacobian)

    @torch.no_grad()
    def apart(self, x: Tensor, missed: Tensor) -> Tensor:
        """How the outputs turn with a delay of each actuator's own: (n, S, d_y, M d_u)."""
        return torch.cat([part._apart(*given) for part, given in self._parts(x, missed)])

    def first_delays(self) -> Tensor:
        """The delay (n, M) in whole samples that fits each movement best, nothing else being off.

        Where all fit alike, the smallest.
        """
        low, high = self.operator.delay_range
        grid = torch.arange(low, high + 1.0, dtype=torch.float64)
        grid = grid[grid.abs().argsort(stable=True)]
        start, settle = (
            torch.as_tensor(times)[..., None]
            for times in (self.segments.start, self.segments.settle)
        )
        at = self.at[:, None]
        near = ((at >= start + low) & (at <= settle + high)).double()
        x, missed = self.nothing()
        costs = []
        for delay in grid:
            x[..., 0] = delay
            error = self.residual(x, missed).norm(dim=-1) * self.seen
            costs.append((near * error[:, None]).sum(dim=-1))
        return grid[torch.stack(costs).argmin(dim=0)]

    def inside(self) -> Tensor:
        """(n, M, S), 1 where a measured sample belongs to a movement."""
        start, stop = (
            torch.as_tensor(times)[..., None] for times in (self.segments.start, self.segments.stop)
        )
        at = self.at[:, None]
        return ((at >= start) & (at < stop)).double() * self.seen[:, None]

    def _parts(self, *given: Tensor) -> Iterator[tuple[Problem, tuple[Tensor, ...]]]:
        for rows in torch.arange(len(self)).split(CHUNK):
            yield self[rows], tuple(each[rows] for each in given)

    def _residual(self, x: Tensor, missed: Tensor) -> Tensor:
        told = self.commands(x, missed)
        if self.memory:
            return self.observed - self.predicted(told).double() / self.unit
        rows, place = distinct(told)
        return self.observed - self.surrogate(rows[None])[0, place].double() / self.unit

    def _linearised(self, x: Tensor, missed: Tensor) -> tuple[Tensor, Tensor]:
        if self.memory:
            residual = self._residual(x, missed)
            basis = torch.eye(x[0].numel(), dtype=x.dtype).unflatten(1, x.shape[1:])
            moved = [self._residual(x + NUDGE * each, missed) for each in basis]
            return residual, torch.stack([(residual - each) / NUDGE for each in moved], dim=-1)
        # Without memory the chain rule is local: the surrogate's slope, sample by sample.
        residual, slope = self._slope(x, missed)
        late, off = self._turns(x, missed)
        by_delay = torch.einsum("nsyu,nmsu->nsym", slope, late)[..., None]
        by_offset = torch.einsum("nsyu,nmsu->nsymu", slope, off)
        return residual, torch.cat([by_delay, by_offset], dim=-1).flatten(3)

    def _slope(self, x: Tensor, missed: Tensor) -> tuple[Tensor, Tensor]:
        """The residual (n, S, d_y), and how outputs turn with commands (n, S, d_y, d_u)."""
        rows, place = distinct(self.commands(x, missed))
        with torch.enable_grad():
            asked = rows[None].requires_grad_()
            said = self.surrogate(asked)
            slopes = torch.cat(
                [
                    torch.autograd.grad(each.sum(), asked, retain_graph=True)[0]
                    for each in said.unbind(dim=-1)
                ]
            )
        residual = self.observed - said.detach()[0, place].double() / self.unit
        return residual, slopes.movedim(0, 1)[place].double() / self.unit[..., None]

    def _apart(self, x: Tensor, missed: Tensor) -> Tensor:
        late = self._turns(x, missed)[0]
        if not self.memory:
            return torch.einsum("nsyu,nmsu->nsymu", self._slope(x, missed)[1], late).flatten(3)
        told = self.commands(x, missed)
        said = self.predicted(told)
        columns = []
        for movement, actuator in itertools.product(*map(range, missed.shape[1:])):
            moved = told.clone()
            moved[..., actuator] += (NUDGE * late[:, movement, :, actuator]).to(told)
            columns.append((self.predicted(moved) - said).double() / NUDGE)
        return torch.stack(columns, dim=-1) / self.unit[..., None]

    def _turns(self, x: Tensor, missed: Tensor) -> tuple[Tensor, Tensor]:
        """How the commands turn with each movement's delay, and with its offsets, (n, M, S, d_u).

        An actuator's command turns with its own offset only, so all are moved at once.
        """
        movements, width = x.shape[1:]
        step = torch.zeros(2, movements, movements, width, dtype=x.dtype)
        index = torch.arange(movements)
        step[0, index, index, 0] = TURN
        step[1, index, index, 1:] = TURN
        moved = torch.cat([torch.zeros_like(step[0, :1]), step.flatten(0, 1)])
        count = len(moved)
        rows = torch.arange(len(x)).repeat_interleave(count)
        z = torch.cat([(x[:, None] + moved).flatten(0, 1), missed[rows]], dim=-1)
        segments, frozen = self.segments[rows.numpy()], self.frozen[rows]
        told = effective(self.told[rows], segments, z, self.when[rows], frozen)
        told = told.unflatten(0, (len(x), count))
        late, off = ((told[:, 1:] - told[:, :1]) / TURN).split(movements, dim=1)
        return late, off


def _thinned(measured: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """At most `most` evenly chosen samples of each row of `measured` (n, T) bool.

    Each trajectory is thinned by itself: trajectories may be polled at different phases.

    Returns the samples (n, S), where shorter rows repeat their last one, and which of them are no
    such repetition (n, S) bool. A row without any measurement has only False.

    """
    rank = measured.cumsum(dim=1)
    every = (-(-rank[:, -1:] // most)).clamp_min(1)
    used = measured & ((rank - 1) % every == 0)
    count = used.sum(dim=1, keepdim=True)
    column = torch.arange(int(count.amax()) if len(count) else 0)
    order = used.byte().argsort(dim=1, descending=True, stable=True)
    return order.gather(1, column.minimum((count - 1).clamp_min(0))), column < count
