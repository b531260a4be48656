"""Small networks, each described by a frozen config object, and standardisation.

`config.build(inputs, outputs)` makes the torch module. Sequence networks map (n, T, inputs) to
(n, T, outputs). Classifiers map (n, T, inputs) to logits (n, outputs): `represent` gives the
features of a sequence, `readout` the logits of the features, and `config.default_training` is the
training that suits them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.nn import functional

from retwin.nets.training import Training

ROWS_PER_BLOCK = 2**22
"""Rows whose moments are computed together: their copy in double precision takes 32 MB a
channel."""


@runtime_checkable
class Network(Protocol):
    """The interface of a network's config object."""

    def build(self, inputs: int, outputs: int) -> nn.Module:
        """A module with random initial weights, for so many input and output channels."""


class Standardise(nn.Module):
    """Subtracts the mean of each channel and divides by its standard deviation.

    The scale of a constant channel is 1. Both are buffers, saved with the weights.

    Parameters
    ----------
    channels : int
        Size of the last axis.

    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.mean = nn.Buffer(torch.zeros(channels))
        self.scale = nn.Buffer(torch.ones(channels))

    def fit(self, values: Tensor) -> Standardise:
        """Take mean and standard deviation of `values` (..., channels), in double precision."""
        blocks = values.reshape(-1, values.shape[-1]).split(ROWS_PER_BLOCK)
        moments = [
            (each.mean(0), each.var(0, correction=0), each.abs().amax(0))
            for each in map(torch.Tensor.double, blocks)
        ]
        means, variances, largest = map(torch.stack, zip(*moments, strict=True))
        weight = torch.tensor([len(each) for each in blocks], dtype=torch.float64)
        weight /= weight.sum()
        mean = weight @ means
        # The variance within blocks, and that between their means.
        scale = (weight @ (variances + (means - mean).square())).sqrt()
        tiny = 1e-6 * largest.amax(dim=0).clamp_min(1e-30)
        self.mean.copy_(mean)
        self.scale.copy_(torch.where(scale > tiny, scale, torch.ones_like(scale)))
        return self

    def forward(self, values: Tensor) -> Tensor:
        """`values` (..., channels) in standard units."""
        return (values - self.mean) / self.scale

    def inverse(self, values: Tensor) -> Tensor:
        """`values` (..., channels) in standard units, in physical units again."""
        return values * self.scale + self.mean


def last_layers(network: nn.Module) -> tuple[nn.Module, ...]:
    """The layers whose sum is the output of a network; none if it does not name them.

    A network has them as the attribute `last_layers`, or is a sequence that ends with a layer.
    """
    if isinstance(network, nn.Sequential):
        return (network[-1],)
    return getattr(network, "last_layers", ())


@dataclass(frozen=True)
class MLP:
    """A multilayer perceptron, applied to every sample: for twins without memory.

    Parameters
    ----------
    hidden : tuple of int
        Widths of the hidden layers.

    """

    hidden: tuple[int, ...] = (128, 128)

    def build(self, inputs: int, outputs: int) -> nn.Module:
        """Dense layers with SiLU activations."""
        layers: list[nn.Module] = []
        for width, following in pairwise((inputs, *self.hidden)):
            # In place: at these sizes the allocation of memory takes as long as the arithmetic.
            layers += [nn.Linear(width, following), nn.SiLU(inplace=True)]
        return nn.Sequential(*layers, nn.Linear((inputs, *self.hidden)[-1], outputs))


@dataclass(frozen=True)
class LSTM:
    """A long short-term memory network over time, with a dense read-out at every sample.

    Parameters
    ----------
    hidden : int
        Units of each layer.
    layers : int
        Layers in series.

    """

    hidden: int = 64
    layers: int = 1

    def build(self, inputs: int, outputs: int) -> nn.Module:
        """A causal recurrent network."""
        return _Recurrent(inputs, outputs, self.hidden, self.layers)


class _Recurrent(nn.Module):
    def __init__(self, inputs: int, outputs: int, hidden: int, layers: int) -> None:
        super().__init__()
        self.memory = nn.LSTM(inputs, hidden, layers, batch_first=True)
        self.direct = nn.Linear(inputs, hidden)
        self.readout = nn.Sequential(
            nn.Linear(2 * hidden, hidden), nn.SiLU(), nn.Linear(hidden, outputs)
        )
        self.last_layers = (self.readout[-1],)

    def forward(self, values: Tensor) -> Tensor:
        # The read-out has the present input too, so the memory need not represent it.
        remembered, _ = self.memory(values)
        return self.readout(torch.cat([remembered, self.direct(values)], dim=-1))


@dataclass(frozen=True)
class TCN:
    """Causal dilated convolutions over 1 + (kernel - 1) (2^levels - 1) past samples.

    Parameters
    ----------
    channels : int
        Width of every level.
    kernel : int
        Samples that a convolution combines.
    levels : int
        Convolutions in series; the dilation doubles from each to the next.

    """

    channels: int = 32
    kernel: int = 3
    levels: int = 6

    def build(self, inputs: int, outputs: int) -> nn.Module:
        """A causal convolutional network with skip connections."""
        return _Convolutional(inputs, outputs, self)


class _Convolutional(nn.Module):
    def __init__(self, inputs: int, outputs: int, config: TCN) -> None:
        super().__init__()
        self.padding = [(config.kernel - 1) * 2**i for i in range(config.levels)]
        self.enter = nn.Conv1d(inputs, config.channels, 1)
        self.convolutions = nn.ModuleList(
            nn.Conv1d(config.channels, config.channels, config.kernel, dilation=2**i)
            for i in range(config.levels)
        )
        self.mixers = nn.ModuleList(
            nn.Conv1d(config.channels, config.channels, 1) for _ in range(config.levels)
        )
        self.leave = nn.Conv1d(config.channels, outputs, 1)
        self.last_layers = (self.leave,)

    def forward(self, values: Tensor) -> Tensor:
        state = self.enter(values.transpose(1, 2))
        for padding, convolution, mix in zip(
            self.padding, self.convolutions, self.mixers, strict=True
        ):
            past = functional.pad(state, (padding, 0), mode="replicate")
            state = state + mix(functional.silu(convolution(past)))
        return self.leave(functional.silu(state)).transpose(1, 2)


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
        self.last_layers = (self.readout[-1], self.skip)
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


@dataclass(frozen=True)
class LSTMClassifier:
    """The paper's classifier (section 4.3.2): a stacked LSTM whose last state is classified.

    Parameters
    ----------
    hidden : int
        Units of each layer.
    layers : int
        Layers in series.
    dropout : float
        Dropout between the layers and before the read-out, from 0 to below 1.

    """

    hidden: int = 100
    layers: int = 2
    dropout: float = 0.1
    default_training: ClassVar[Training] = Training(
        max_epochs=30, batch_size=32, learning_rate=1e-3, decay="step"
    )
    """That of the paper."""

    def build(self, inputs: int, outputs: int) -> nn.Module:
        """A classifier with `outputs` classes."""
        return _LastStep(inputs, outputs, self)


class _LastStep(nn.Module):
    def __init__(self, inputs: int, outputs: int, config: LSTMClassifier) -> None:
        super().__init__()
        between = config.dropout if config.layers > 1 else 0.0
        self.memory = nn.LSTM(
            inputs, config.hidden, config.layers, batch_first=True, dropout=between
        )
        self.dropout = nn.Dropout(config.dropout)
        self.readout = nn.Linear(config.hidden, outputs)

    def represent(self, values: Tensor) -> Tensor:
        remembered, _ = self.memory(values)
        return remembered[:, -1]

    def forward(self, values: Tensor) -> Tensor:
        return self.readout(self.dropout(self.represent(values)))


@dataclass(frozen=True)
class CNN:
    """A classifier of convolutions with pooling, mean and maximum over time, and a dense layer.

    Parameters
    ----------
    channels : tuple of int
        Width of each convolution.
    kernel : int
        Samples that a convolution combines.
    dropout : float
        Dropout before the dense layer, from 0 to below 1.

    """

    channels: tuple[int, ...] = (32, 64, 128)
    kernel: int = 5
    dropout: float = 0.2
    default_training: ClassVar[Training] = Training(
        max_epochs=25, batch_size=64, learning_rate=3e-3, weight_decay=1e-2
    )

    def build(self, inputs: int, outputs: int) -> nn.Module:
        """A classifier with `outputs` classes."""
        return _Pooled(inputs, outputs, self)


class _Pooled(nn.Module):
    def __init__(self, inputs: int, outputs: int, config: CNN) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for width, following in pairwise((inputs, *config.channels)):
            layers += [
                nn.Conv2d(width, following, (1, config.kernel), padding="same"),
                nn.BatchNorm2d(following),
                nn.ReLU(),
                nn.MaxPool2d((1, 2), ceil_mode=True),
            ]
        # No pooling after the last convolution: mean and maximum over time follow.
        # Two-dimensional convolutions, with one axis of length 1, allow channels last in memory, as
        # in the input: that takes two thirds of the time on a CPU.
        features = nn.Sequential(*layers[:-1])
        self.features = features.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.dropout = nn.Dropout(config.dropout)
        self.readout = nn.Linear(2 * config.channels[-1], outputs)

    def represent(self, values: Tensor) -> Tensor:
        features = self.features(values.transpose(1, 2).unsqueeze(2)).squeeze(2)
        return torch.cat([features.mean(dim=2), features.amax(dim=2)], dim=1)

    def forward(self, values: Tensor) -> Tensor:
        return self.readout(self.dropout(self.represent(values)))
