"""`CommandSpace`: the effective commands of the actuators, pushed through the surrogate.

An output offset may leave what the system can reach, and does not show which actuator errs. Here z
changes the commands, ỹ = G_φ(T_z(u)), so that every corrected output is one that the twin can give.
In a segment actuators may respond with a delay and end off their targets, and one may miss the
segment altogether: it stays where it is and catches up with the next command.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from retwin.data.trajectories import Channels
from retwin.update.corrections.commands.effective_commands import effective_commands
from retwin.update.corrections.commands.inference import Hyperparameters, infer_commands
from retwin.update.corrections.correction import Context, Discrepancy, Head
from retwin.update.corrections.delay_range import checked_range, range_in_samples, range_in_seconds
from retwin.update.corrections.delays import gather_samples
from retwin.update.corrections.surrogate_slopes import outputs_at
from retwin.update.kernels.generation import at_effective_commands

KINDS = ("offset", "missed")
"""What z has for every actuator, besides the common delay, in this order."""


@dataclass(frozen=True)
class CommandSpace:
    """z = delay, offsets and missed segments of the actuators, in command space.

    Of each segment: the delay in samples (settings are in seconds), one for all actuators; then for
    every actuator the offset of the level that it reaches, in its command's unit; then for every
    actuator whether it missed the segment, 0 or 1.

    Parameters
    ----------
    delay_range : tuple of float, optional
        Smallest and largest delay that `infer` considers, in seconds; by default chosen from the
        measured outputs, see `plausible_delays`.
    max_samples : int
        Samples per trajectory that `infer` uses at most: more add little information.
    identified_below : float
        A component of z is identified if its posterior variance is below this share of its prior
        variance, from 0 to 1.

    Raises
    ------
    InputError
        The range does not rise.

    """

    resolution: ClassVar[str] = "segment"
    """One z per segment."""
    pools: ClassVar[bool] = True
    """`infer` learns its priors from all trajectories together."""
    severities: ClassVar[bool] = True
    """`infer` estimates the severity of a known fault apart from z."""
    delay_range: tuple[float, float] | None = None
    max_samples: int = 200
    identified_below: float = 0.7

    def __post_init__(self) -> None:
        checked_range(self.delay_range)

    def latent(self, inputs: Channels, outputs: Channels) -> Channels:
        """`delay` in samples, `offset_…` in the commands' units, `missed_…` 0 or 1."""
        names = ("delay", *(f"{kind}_{name}" for kind in KINDS for name in inputs.names))
        return Channels(names, ("samples", *inputs.units, *("1" for _ in inputs.names)))

    def heads(self, inputs: Channels, outputs: Channels) -> tuple[Head, ...]:
        """A mixture for the delay, one for all offsets together, and missed segments."""
        width = len(inputs)
        return Head("delay", 1), Head("offset", width), Head("missed", width, "bernoulli")

    def apply(self, context: Context, z: Tensor) -> Tensor:
        """ỹ = G_φ(T_z(u)), differentiable in z; a frozen actuator stays where z had brought it."""
        commands = context.faulty_commands
        times = torch.arange(commands.shape[1], device=commands.device)
        return context.surrogate(_commands(context, z, times))

    def at(self, context: Context, z: Tensor, when: Tensor) -> Tensor:
        """The same (n, S, d_y) at the samples `when` (n, S) only."""
        if not getattr(context.surrogate, "memoryless", False):
            return gather_samples(self.apply(context, z), when)
        made = at_effective_commands(context, z, when)
        if made is None:
            made = outputs_at(context.surrogate, _commands(context, z, when))
        return made

    def completed(self, context: Context, observed: Tensor, mask: Tensor) -> CommandSpace:
        """The operator with the range of delays that measured outputs show, where none is given."""
        found = range_in_seconds(self.delay_range, context, observed, mask)
        return replace(self, delay_range=found)

    def infer(self, context: Context, observed: Tensor, mask: Tensor) -> Discrepancy:
        """z* and its covariance from outputs alone; see `command_inference`."""
        return self.infer_with_hyperparameters(context, observed, mask)[0]

    def infer_with_hyperparameters(
        self, context: Context, observed: Tensor, mask: Tensor
    ) -> tuple[Discrepancy, Hyperparameters | None]:
        """As `infer`, with what was learned of prior and noise; None without any segment."""
        return infer_commands(
            context,
            observed,
            mask,
            delay_range=range_in_samples(self.delay_range, context, observed, mask),
            max_samples=self.max_samples,
            identified_below=self.identified_below,
        )


def _commands(context: Context, z: Tensor, times: Tensor) -> Tensor:
    """T_z(u) at `times`, (n, S) or (S,), in the precision of the commands."""
    given = context.faulty_commands
    made = effective_commands(given.to(z.dtype), context.segments, z, times, context.frozen)
    return made.to(given.dtype)
