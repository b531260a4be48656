"""A neural state-space network: a small state that a dense network moves on, sample by sample."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

__all__ = ["StateSpace"]


@dataclass(frozen=True)
class StateSpace:
    """x_{t+1} = x_t + r (A x_t + B u_t + f(x_t, u_t)), y_t = C x_t + h(x_t): for hidden states.

    f and h have one hidden layer: what is linear need not be learned by them. The state of the
    first sample is learned, the same for every record, as the twin's is. Unlike an `LSTM` it has no
    more memory than it has states, each with a rate r of its own.

    Parameters
    ----------
    states: more than the twin has do no harm.
    hidden: width of f and of h.
    slowest: time of the slowest state at first, in samples; the others' are spread down to two.

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
        rates = torch.logspace(-math.log10(config.slowest), math.log10(0.5), states)
        self.log_rate = nn.Parameter(rates.log())
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
        rate, size = self.log_rate.exp(), len(self.start)
        state = self.start.expand(len(values), -1)
        states = []
        for entered in self.enter(values).unbind(dim=1):
            states.append(state)
            linear, inside = (entered + self.now(state)).split([size, entered.shape[1] - size], 1)
            state = state + rate * (linear + self.move(torch.tanh(inside)))
        seen = torch.stack(states, dim=1)
        return self.skip(seen) + self.readout(seen)
