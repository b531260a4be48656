"""Effective position targets of an exported actuator, in the units of a simulator's joints."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


class EffectiveTarget:
    """What the real actuators would follow, in place of the targets that a policy sends.

    Parameters
    ----------
    file : str
        `actuator.pt`, written by `retwin export actuator`.
    environments : int
        Number of simulated robots.
    unit, zero : float or sequence of float
        A joint's position is `zero + unit * command`: rad per unit of the command, and the
        position at the command 0, for each joint or for all.
    device : str
        Of all tensors.
    seed : int
        Of the draws: each episode of an environment has another one.

    """

    def __init__(
        self,
        file: str,
        environments: int,
        *,
        unit: float | Sequence[float] = 1.0,
        zero: float | Sequence[float] = 0.0,
        device: str = "cpu",
        seed: int = 0,
    ) -> None:
        self.model = torch.jit.load(file, map_location=device)
        self.unit = torch.as_tensor(unit, dtype=torch.float32, device=device)
        self.zero = torch.as_tensor(zero, dtype=torch.float32, device=device)
        self.generator = torch.Generator(device).manual_seed(seed)
        self.fresh = torch.ones(environments, dtype=torch.bool, device=device)
        self.started = False

    def reset(self, env_ids: Tensor | Sequence[int] | slice | None = None) -> None:
        """Give environments a new draw; their actuators then rest where their joints are."""
        self.fresh[slice(None) if env_ids is None else env_ids] = True

    def __call__(self, target: Tensor, position: Tensor) -> Tensor:
        """The effective targets (n, joints) for targets and joint positions of this step."""
        if self.fresh.any():
            self._begin(self._commands(position))
        shape = target.shape
        uniform = torch.rand(shape, generator=self.generator, device=target.device)
        return self.zero + self.unit * self.model(self._commands(target), uniform)

    def _commands(self, position: Tensor) -> Tensor:
        return (position - self.zero) / self.unit

    def _begin(self, resting: Tensor) -> None:
        """New episodes, with a draw each."""
        where = self.fresh.nonzero().flatten()
        count = len(self.fresh) if not self.started else len(where)
        row = torch.randint(
            self.model.draws(), (count,), generator=self.generator, device=resting.device
        )
        if self.started:
            self.model.reset(where, resting[where], row)
        else:
            self.model.start(resting, row)
        self.started = True
        self.fresh.fill_(False)
