"""What an actuator's offset may depend on: a constant, the direction and distance, the pose."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from retwin.inference.hierarchy import Design
from retwin.update.corrections.command_problem import CommandProblem
from retwin.update.corrections.effective_commands import STILL

OWN_FEATURES = 3
"""Features of an actuator's own motion: a constant, its direction, and its distance."""
MAX_COEFFICIENTS = 500
"""Largest number of coefficients in all with which offsets depend on the targets of all actuators;
with more actuators, each offset depends on its own actuator's target only."""
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

    """

    centre: Tensor
    spread: Tensor
    travel: Tensor

    @classmethod
    def of(cls, problem: CommandProblem) -> OffsetFeatures:
        """The scales of the commands of `problem`; 1 where an actuator never moves.

        Where all targets are the same, as in a single segment, distances stand for their spread.
        """
        first, last = (each[problem.valid] for each in problem.levels)
        centre = last.mean(dim=0)
        spread, travel = (
            each.square().mean(dim=0).sqrt() for each in (last - centre, last - first)
        )
        smallest = STILL * problem.reference.abs().amax(dim=(0, 1))
        travel = torch.where(travel <= smallest, 1.0, travel)
        return cls(centre, torch.where(spread <= smallest, travel, spread), travel)

    def design(self, problem: CommandProblem) -> Design:
        """The regression of x on a common delay, and on the features of the offsets.

        Group 0 holds the common delays, group 1 + u the offsets of actuator u, and the last group
        the differences of the actuators' own delays from the common one.
        """
        n, segments, width = problem.missed.shape
        own = self._features(problem)
        count = own.shape[-1]
        features = own.new_zeros(n, segments, problem.size, 1 + width * count)
        features[:, :, 0, 0] = 1.0
        for u in range(width):
            features[:, :, 1 + u, 1 + u * count : 1 + (u + 1) * count] = own[:, :, u]
        # Where a fault bends the reference, nothing is known of its severity.
        wider = features.new_ones(n, segments, problem.size)
        wider[:, :, 1 : 1 + width] = torch.where(problem.faulty, WIDE, 1.0)
        moved = problem.healthy & (problem.missed < 0.5)
        used = torch.zeros_like(wider)
        used[:, :, 0] = problem.valid
        used[:, :, 1 : 1 + width] = moved
        used[:, :, 1 + width :] = (moved & (self._direction(problem) != 0)).repeat(
            1, 1, int(problem.own_delays)
        )
        actuators = torch.arange(1, 1 + width)
        zero, last = torch.tensor([0]), torch.tensor([1 + width])
        group = torch.cat([zero, actuators, last.expand(problem.size - 1 - width)])
        return Design(
            features.flatten(1, 2),
            group=group.repeat(segments),
            wider=wider.flatten(1),
            used=used.flatten(1),
            owner=torch.cat([zero, actuators.repeat_interleave(count)]),
            kind=torch.cat([zero, torch.arange(1, 1 + count).repeat(width)]),
        )

    def _direction(self, problem: CommandProblem) -> Tensor:
        """Sign (n, M, d_u) of each actuator's motion, 0 where it stands still."""
        first, last = problem.levels
        size = problem.reference.abs().amax(dim=(0, 1))
        return (last - first).sign() * ((last - first).abs() > STILL * size)

    def _features(self, problem: CommandProblem) -> Tensor:
        """(n, M, d_u, F), those of every actuator's offset."""
        first, last = problem.levels
        distance, width = last - first, last.shape[-1]
        direction = self._direction(problem)
        own = torch.stack([torch.ones_like(last), direction, distance / self.travel], dim=-1)
        pose = (last - self.centre) / self.spread
        if width * (OWN_FEATURES + width) > MAX_COEFFICIENTS:
            return torch.cat([own, pose[..., None]], dim=-1)
        every = pose[:, :, None].expand(*pose.shape, width)
        # An actuator's own target first: coefficients of a kind share a variance.
        order = (torch.arange(width)[:, None] + torch.arange(width)) % width
        return torch.cat([own, every.gather(-1, order.expand_as(every))], dim=-1)
