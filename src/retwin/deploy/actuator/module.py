"""Actuators step by step: the causal form of `CommandSpace` and `DelayOffset`, for torch.jit.

Within an episode an environment keeps its delay, its offsets and its probability of missing a
segment. T_z(u) of `CommandSpace` then depends on past commands alone, from the end of the first
segment on: all segments have the same delay, so that no segment is stretched, and the error is the
same before and after a motion, so that it need not be known how far the motion will go. A gain per
actuator changes the error in proportion to the command, which T_z interpolates in the same way.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from retwin.deploy.actuator.draws import Draws

AT_REST = 1e6
"""Steps at rest with which an episode begins: more than any number of steps that counts as rest."""


class ActuatorStep(nn.Module):
    """One step of n environments as a function of their state; nothing is remembered.

    Parameters
    ----------
    plant : nn.Module
        Commands (n, d_u) to undelayed outputs (n, d_y): the identity, or a network without memory.
    found : Draws
        Its gain is the error in proportion to the distance of the output from `centre`, within the
        range from `low` to `high`, in which it was estimated.
    tolerance : Tensor
        (d_u,), the largest change of a command that counts as none.
    speed : Tensor
        (d_u,), the largest change per step at which an actuator catches up with a missed segment.
    rest : float
        Steps without a change after which a change begins a new segment.

    """

    def __init__(
        self, plant: nn.Module, found: Draws, *, tolerance: Tensor, speed: Tensor, rest: float
    ) -> None:
        super().__init__()
        self.plant = plant
        self.rest = rest
        self.gain = nn.Buffer(found.gain)
        self.centre = nn.Buffer(found.centre)
        self.low = nn.Buffer(found.low)
        self.high = nn.Buffer(found.high)
        self.tolerance = nn.Buffer(tolerance)
        self.speed = nn.Buffer(speed)

    def forward(
        self,
        command: Tensor,
        uniform: Tensor,
        delay: Tensor,
        offset: Tensor,
        probability: Tensor,
        previous: Tensor,
        reference: Tensor,
        resting: Tensor,
        missed: Tensor,
        history: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Execute a command.

        Parameters
        ----------
        command : Tensor, shape (n, d_u)
            The commands that are sent in this step.
        uniform : Tensor, shape (n, d_u)
            Uniform noise in [0, 1): a segment that begins is missed below the probability.
        delay : Tensor, shape (n, 1)
            In steps, from 0 to L - 2.
        offset : Tensor, shape (n, d_y)
            The error at `centre`, in the output's unit.
        probability : Tensor, shape (n, d_u)
            That an actuator misses a segment.
        previous : Tensor, shape (n, d_u)
            The commands of the step before.
        reference : Tensor, shape (n, d_u)
            What the actuators followed in the step before, without delay and error.
        resting : Tensor, shape (n, 1)
            Steps since a command changed.
        missed : Tensor, shape (n, d_u)
            1 where an actuator misses the current segment.
        history : Tensor, shape (L, n, d_y)
            Undelayed outputs of the last L steps, the newest last.

        Returns
        -------
        tuple of Tensor
            What is executed (n, d_y), and the new state in the order of the arguments.

        """
        change = (command - previous).abs()
        moving = (change > self.tolerance).any(dim=1, keepdim=True)
        begins = moving & (resting >= self.rest)
        missed = torch.where(begins, (uniform < probability).to(missed.dtype), missed)
        resting = torch.where(moving, torch.zeros_like(resting), resting + 1.0)
        limit = torch.maximum(change, self.speed)
        behind = command - reference
        followed = reference + torch.minimum(torch.maximum(behind, -limit), limit)
        # Exactly the command where it is reached: a sum of differences is rounded.
        followed = torch.where(behind.abs() <= limit, command, followed)
        reference = torch.where(missed > 0.5, reference, followed)
        history = torch.cat([history[1:], self.plant(reference)[None]])
        whole = delay.floor()
        newer = (history.shape[0] - 1 - whole.to(torch.int64))[None].expand(
            1, history.shape[1], history.shape[2]
        )
        after = history.gather(0, newer)[0]
        before = history.gather(0, newer - 1)[0]
        undelayed = after + (delay - whole) * (before - after)
        error = offset + self.gain * (torch.clamp(undelayed, self.low, self.high) - self.centre)
        return undelayed + error, command, reference, resting, missed, history


class Actuators(nn.Module):
    """Actuators of n environments with their state and the draws of z: what TorchScript holds.

    Call `start` once, `reset` for environments whose episode begins anew, and the module itself in
    each step.

    Parameters
    ----------
    step : ActuatorStep
        One step.
    delays : Tensor
        (K, 1), the delays of the draws of z, in steps.
    found : Draws
        The draws of z.
    length : int
        Steps in the history, L.

    """

    def __init__(self, step: ActuatorStep, delays: Tensor, found: Draws, length: int) -> None:
        super().__init__()
        offsets, probabilities = found.offset, found.probability
        self.step = step
        self.length = length
        self.at_rest = AT_REST
        self.delays = nn.Buffer(delays)
        self.offsets = nn.Buffer(offsets)
        self.probabilities = nn.Buffer(probabilities)
        self.delay: Tensor = nn.Buffer(delays[:0].clone())
        self.offset: Tensor = nn.Buffer(offsets[:0].clone())
        self.probability: Tensor = nn.Buffer(probabilities[:0].clone())
        self.previous: Tensor = nn.Buffer(probabilities[:0].clone())
        self.reference: Tensor = nn.Buffer(probabilities[:0].clone())
        self.resting: Tensor = nn.Buffer(delays[:0].clone())
        self.missed: Tensor = nn.Buffer(probabilities[:0].clone())
        self.history: Tensor = nn.Buffer(offsets.new_zeros(length, 0, offsets.shape[1]))

    @torch.jit.export
    def draws(self) -> int:
        """The number of draws of z, K."""
        return self.delays.shape[0]

    @torch.jit.export
    def start(self, command: Tensor, row: Tensor) -> None:
        """Begin an episode in n environments.

        Parameters
        ----------
        command : Tensor, shape (n, d_u)
            Commands at which the actuators rest.
        row : Tensor, shape (n,)
            Which draw of z each environment has, below `draws()`.

        """
        n = command.shape[0]
        self.delay = self.delays[row]
        self.offset = self.offsets[row]
        self.probability = self.probabilities[row]
        self.previous = command.clone()
        self.reference = command.clone()
        self.resting = torch.full([n, 1], self.at_rest, dtype=command.dtype, device=command.device)
        self.missed = torch.zeros_like(command)
        self.history = self.step.plant(command)[None].expand(self.length, -1, -1).clone()

    @torch.jit.export
    def reset(self, environments: Tensor, command: Tensor, row: Tensor) -> None:
        """Begin a new episode in some environments.

        Parameters
        ----------
        environments : Tensor, shape (m,)
            Their indices.
        command : Tensor, shape (m, d_u)
            Commands at which their actuators rest.
        row : Tensor, shape (m,)
            Which draw of z each of them has.

        """
        # Not in place: under torch.inference_mode tensors of another mode cannot be changed.
        self.delay = self.delay.index_copy(0, environments, self.delays[row])
        self.offset = self.offset.index_copy(0, environments, self.offsets[row])
        self.probability = self.probability.index_copy(0, environments, self.probabilities[row])
        self.previous = self.previous.index_copy(0, environments, command)
        self.reference = self.reference.index_copy(0, environments, command)
        self.resting = self.resting.index_fill(0, environments, self.at_rest)
        self.missed = self.missed.index_fill(0, environments, 0.0)
        rested = self.step.plant(command)[None].expand(self.length, -1, -1)
        self.history = self.history.index_copy(1, environments, rested)

    def forward(self, command: Tensor, uniform: Tensor) -> Tensor:
        """What is executed (n, d_y) for the commands of this step; see `ActuatorStep`."""
        executed, previous, reference, resting, missed, history = self.step(
            command,
            uniform,
            self.delay,
            self.offset,
            self.probability,
            self.previous,
            self.reference,
            self.resting,
            self.missed,
            self.history,
        )
        self.previous = previous
        self.reference = reference
        self.resting = resting
        self.missed = missed
        self.history = history
        return executed
