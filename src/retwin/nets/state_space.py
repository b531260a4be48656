"""A neural state-space network: a small state with a learned transition from sample to sample."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class StateSpace:
    """x_{t+1} = x_t + r (A x_t + B u_t + f(x_t, u_t)), y_t = C x_t + h(x_t).

    f and h have one hidden layer; A, B and C are the linear part. Each state has an inverse time
    constant r of its own. The initial state is learned and the same for every record, as the
    twin's is.

    Parameters
    ----------
    states : int
        Number of states; it may exceed that of the twin.
    hidden : int
        Width of the hidden layers of f and h.
    slowest : float
        Largest initial time constant, in samples; the others are spread geometrically down to 2.

    """

    states: int = 6
    hidden: int = 32
    slowest: float = 30.0

    def build(self, inputs: int, outputs: int) -> nn.Module:
        """A causal recurrent network."""
        return _States(inputs, outputs, self)


class _States(nn.Module):
    def __init__(self, inputs: int, outputs: int, config: StateSpace) -> None:
        super().__init__()
        states, hidden = config.states, config.hidden
        self.start = nn.Parameter(torch.zeros(states))
        inverse_times = torch.logspace(-math.log10(config.slowest), math.log10(0.5), states)
        self.log_rate = nn.Parameter(inverse_times.log())
        self.enter = nn.Linear(inputs, states + hidden)
        self.now = nn.Linear(states, states + hidden, bias=False)
        self.move = nn.Linear(hidden, states, bias=False)
        self.readout = nn.Sequential(
            nn.Linear(states, hidden), nn.SiLU(), nn.Linear(hidden, outputs)
        )
        self.skip = nn.Linear(states, outputs, bias=False)
        with torch.no_grad():
            self.now.weight[:states] = -torch.eye(states)

    def forward(self, values: Tensor) -> Tensor:
        # The parameter is named `log_rate` in saved weights.
        inverse_times, size = self.log_rate.exp(), len(self.start)
        state = self.start.expand(len(values), -1)
        states = []
        for entered in self.enter(values).unbind(dim=1):
            states.append(state)
            linear, inside = (entered + self.now(state)).split([size, entered.shape[1] - size], 1)
            state = state + inverse_times * (linear + self.move(torch.tanh(inside)))
        trajectory = torch.stack(states, dim=1)
        return self.skip(trajectory) + self.readout(trajectory)

    @property
    def last_layers(self) -> tuple[nn.Module, ...]:
        return self.readout[-1], self.skip
