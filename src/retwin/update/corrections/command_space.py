"""`CommandSpace`: what the actuators were effectively told, pushed through the surrogate.

An output offset may leave what the system can reach, and cannot say which actuator errs. Here z
changes the commands, ỹ = G_φ(T_z(u)), so every corrected output is one that the twin can give. A
movement of an actuator may come late, end off its target, or not take place at all; then the
actuator stays where it is and catches up with the next command.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from retwin.data.trajectories import Channels
from retwin.update.corrections.command_effect import effective
from retwin.update.corrections.command_inference import infer_commands
from retwin.update.corrections.correction import Context, Discrepancy, Head
from retwin.update.corrections.warp import gather_samples
from retwin.update.piecewise_linear import distinct

__all__ = ["CommandSpace"]


@dataclass(frozen=True)
class CommandSpace:
    """z = delay, offset and missed per movement and actuator, in command space.

    Per movement: the delay in samples, one for all actuators; then for every actuator the offset of
    the level that is reached, in its command's unit; then for every actuator whether it missed the
    movement, 0 or 1.

    Parameters
    ----------
    delay_range: least and greatest delay that `infer` looks for, in samples.
    most: samples per trajectory that `infer` looks at, at most; more tell little.
    known: share of the prior's variance that the outputs must leave at most for a component of z to
        count as identified.

    """

    delay_range: tuple[float, float] = (-5.0, 30.0)
    most: int = 200
    known: float = 0.7

    @property
    def resolution(self) -> str:
        """One z per movement."""
        return "segment"

    @property
    def pools(self) -> bool:
        """What `infer` finds of one trajectory leans on what it learns from those beside it."""
        return True

    @property
    def severities(self) -> bool:
        """`infer` tells how severe a known fault is, apart from z."""
        return True

    def latent(self, inputs: Channels, outputs: Channels) -> Channels:
        """`delay` in samples, `offset_…` in the commands' units, `missed_…` 0 or 1."""
        names = ("delay", *(f"{kind}_{name}" for kind in KINDS for name in inputs.names))
        return Channels(names, ("samples", *inputs.units, *("1" for _ in inputs.names)))

    def heads(self, inputs: Channels, outputs: Channels) -> tuple[Head, ...]:
        """A mixture for the delay, one for all offsets together, and what is missed."""
        return (
            Head("delay", 1),
            Head("offset", len(inputs)),
            Head("missed", len(inputs), "bernoulli"),
        )

    def apply(self, context: Context, z: Tensor) -> Tensor:
        """ỹ = G_φ(T_z(u)), differentiable in z; a frozen actuator stays where z had brought it."""
        return context.surrogate(_told(context, z, torch.arange(context.faulty_commands.shape[1])))

    def at(self, context: Context, z: Tensor, when: Tensor) -> Tensor:
        """The same (n, S, d_y) at the samples `when` (n, S) only."""
        if not getattr(context.surrogate, "memoryless", False):
            return gather_samples(self.apply(context, z), when)
        rows, place = distinct(_told(context, z, when))
        return context.surrogate(rows[None])[0, place]

    def infer(self, context: Context, observed: Tensor, mask: Tensor) -> Discrepancy:
        """z* and its covariance from outputs alone; see `command_inference`."""
        return infer_commands(self, context, observed, mask)


KINDS = ("offset", "missed")


def _told(context: Context, z: Tensor, when: Tensor) -> Tensor:
    """T_z(u) at the samples `when`, (n, S) or (S,)."""
    told = effective(context.faulty_commands.to(z.dtype), context.segments, z, when, context.frozen)
    return told.to(context.faulty_commands.dtype)
