"""What errors of actuators may depend on: a constant, direction and distance, pose, condition.

A condition is a segment with certain commands of all actuators, before and after it. Its replicates
have an effect in common that no regression need explain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from retwin.inference.hierarchy import CONDITION, FLAT, Design
from retwin.update.corrections.commands.effective_commands import STILL
from retwin.update.corrections.commands.problem import CommandProblem
from retwin.update.corrections.correction import DifferentiableTwin

FIRST_OFFSET = 0.05
"""Standard deviation of an offset at first, in that of the targets of actuators of its kind, and
the scale of its half-normal prior."""
DELAY_VARIANCE = 1 / 12
"""Variance of the delays that the hyperprior expects, in samples squared: that of the time of an
event within a sample."""
ZERO, SMALL = 16.0, 0.01
"""Expected variance of an actuator's constant offset, and of the coefficients of a regression,
relative to that of effects of conditions: where the zero of an actuator is says nothing of how much
its offsets vary, and a regression explains little unless data say more."""
WIDE = 30.0
"""Standard deviation of the prior, in that of a healthy offset, where a fault may be anything."""


@dataclass(frozen=True, eq=False)
class OffsetFeatures:
    """The scales that make features of size one.

    Attributes
    ----------
    centre, spread : Tensor
        (d_u,), mean and standard deviation of the targets.
    travel : Tensor
        (d_u,), root mean square of the distance from target to target.
    unit : Tensor
        (d_u,), standard deviations of the offsets at first. They are alike for actuators whose
        commands have the same unit: how far a program moves one says little of its errors.
    replicated : Tensor
        (C, 2 d_u), the conditions that are there more than once, see `conditions`.
    regression : bool
        Whether the mean of an offset depends on direction, distance and pose.
    constants_expected : bool
        Whether constant offsets are expected to be those of other machines, and are not shrunk.

    """

    centre: Tensor
    spread: Tensor
    travel: Tensor
    unit: Tensor
    replicated: Tensor
    regression: bool = False
    constants_expected: bool = False

    @classmethod
    def of(cls, problem: CommandProblem, *, max_effects: int = 1000) -> OffsetFeatures:
        """The scales of the commands of `problem`; 1 where an actuator never moves.

        Where all targets are the same, as in a single segment, distances stand for their spread.

        Parameters
        ----------
        max_effects : int, default 1000
            Largest number of effects of conditions; of more conditions the last ones have none.

        """
        first, last = (each[problem.valid] for each in problem.levels)
        centre = last.mean(dim=0)
        apart = (last - centre, last - first)
        spread, travel = (each.square().mean(dim=0).sqrt() for each in apart)
        smallest = STILL * problem.reference.abs().amax(dim=(0, 1))
        moved = (travel > smallest) | (spread > smallest)
        travel = torch.where(travel <= smallest, 1.0, travel)
        spread = torch.where(spread <= smallest, travel, spread)
        unit = FIRST_OFFSET * _pool_alike(spread, moved, problem.surrogate)
        found = cls(centre, spread, travel, unit, centre.new_zeros(0, 2 * len(centre)))
        every, counts = found.conditions(problem)[problem.valid].unique(dim=0, return_counts=True)
        return replace(found, replicated=every[counts > 1][: max_effects // problem.size])

    def conditions(self, problem: CommandProblem, *, equal: float = 0.01) -> Tensor:
        """(n, M, 2 d_u), commands before and after each segment, in multiples of what is equal.

        Parameters
        ----------
        equal : float, default 0.01
            Distance, in the spread of the targets, below which commands are equal.

        """
        scaled = [(each - self.centre) / (equal * self.spread) for each in problem.levels]
        return torch.cat(scaled, dim=-1).round()

    def replicates(self, problem: CommandProblem) -> Tensor:
        """(n, M), the number of segments of the same condition."""
        every = self.conditions(problem).flatten(0, 1)
        index = every.unique(dim=0, return_inverse=True)[1]
        valid = problem.valid.flatten().double()
        counts = torch.zeros_like(valid).index_add(0, index, valid)
        return counts[index].clamp_min(1).view(problem.valid.shape)

    def design(self, problem: CommandProblem) -> Design:
        """The regression of x on a common delay, features of the offsets, and conditions.

        Group 0 holds the common delays, group 1 + u the offsets of actuator u, and the last group
        the differences of the actuators' own delays from the common one.
        """
        n, segments, width = problem.missed.shape
        own = self._features(problem)
        count, base = own.shape[-1], 1 + width * own.shape[-1]
        match = self._match(problem).to(own)
        effects = len(self.replicated) * problem.size
        features = own.new_zeros(n, segments, problem.size, base + effects)
        features[:, :, 0, 0] = 1.0
        identity = torch.eye(problem.size, dtype=own.dtype)
        features[..., base:] = torch.einsum("nmc,pq->nmpcq", match, identity).flatten(3)
        for u in range(width):
            features[:, :, 1 + u, 1 + u * count : 1 + (u + 1) * count] = own[:, :, u]
        # Where a fault bends the reference, nothing is known of its severity.
        wider = features.new_ones(n, segments, problem.size)
        wider[:, :, 1 : 1 + width] = torch.where(problem.faulty, WIDE, 1.0)
        moved = problem.healthy & (problem.missed < 0.5)
        used = torch.zeros_like(wider)
        used[:, :, 0] = problem.valid
        used[:, :, 1 : 1 + width] = moved
        if problem.own_delays:
            used[:, :, 1 + width :] = moved & (self._direction(problem) != 0)
        actuators = torch.arange(1, 1 + width)
        zero, last = torch.tensor([0]), torch.tensor([1 + width])
        group = torch.cat([zero, actuators, last.expand(problem.size - 1 - width)])
        delay = own.new_tensor([DELAY_VARIANCE]).sqrt()
        single = (1 - match.sum(dim=-1)) * float(len(self.replicated) > 0)
        kinds = torch.arange(1, 1 + count).repeat(width)
        if self.constants_expected:
            kinds[::count] = FLAT
        share = own.new_tensor([1.0, ZERO, *[SMALL] * (count - 1)])
        return Design(
            features.flatten(1, 2),
            group=group.repeat(segments),
            wider=wider.flatten(1),
            used=used.flatten(1),
            owner=torch.cat(
                [zero, actuators.repeat_interleave(count), group.repeat(len(self.replicated))]
            ),
            kind=torch.cat([zero, kinds, torch.full((effects,), CONDITION)]),
            single=single[..., None].expand_as(wider).flatten(1),
            tied=(1, 1 + width),
            unit=torch.cat([delay, self.unit, delay]),
            share=share,
        )

    def _match(self, problem: CommandProblem) -> Tensor:
        """(n, M, C) bool, whether a segment is a replicate of a condition."""
        match = (self.conditions(problem)[:, :, None] == self.replicated).all(dim=-1)
        return match & problem.valid[..., None]

    def _direction(self, problem: CommandProblem) -> Tensor:
        """Sign (n, M, d_u) of each actuator's motion, 0 where it stands still."""
        first, last = problem.levels
        size = problem.reference.abs().amax(dim=(0, 1))
        return (last - first).sign() * ((last - first).abs() > STILL * size)

    def _features(self, problem: CommandProblem, *, max_coefficients: int = 500) -> Tensor:
        """(n, M, d_u, F), those of every actuator's offset.

        Three are of an actuator's own motion: a constant, its direction, and its distance.

        Parameters
        ----------
        max_coefficients : int, default 500
            Largest number of coefficients in all with which offsets depend on the targets of all
            actuators; with more actuators, each offset depends on its own actuator's target only.

        """
        first, last = problem.levels
        distance, width = last - first, last.shape[-1]
        direction = self._direction(problem)
        if not self.regression:
            return torch.ones_like(last)[..., None]
        own = torch.stack([torch.ones_like(last), direction, distance / self.travel], dim=-1)
        pose = (last - self.centre) / self.spread
        if width * (own.shape[-1] + width) > max_coefficients:
            return torch.cat([own, pose[..., None]], dim=-1)
        every = pose[:, :, None].expand(*pose.shape, width)
        # An actuator's own target first: coefficients of a kind share a variance.
        order = (torch.arange(width)[:, None] + torch.arange(width)) % width
        return torch.cat([own, every.gather(-1, order.expand_as(every))], dim=-1)


def _pool_alike(spread: Tensor, moved: Tensor, surrogate: DifferentiableTwin) -> Tensor:
    """Root mean square (d_u,) of the spreads of those that moved and have commands of one unit.

    An actuator without a unit ("1") is alone.
    """
    channels = getattr(surrogate, "inputs", None)
    units = channels.units if channels else ["1"] * len(spread)
    alike = torch.tensor([[a == b != "1" for b in units] for a in units]) & moved
    alone = ~alike.any(dim=1)
    weight = alike.to(spread) + torch.diag(alone.to(spread))
    return (weight @ spread.square() / weight.sum(dim=1)).sqrt()
