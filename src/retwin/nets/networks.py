"""Small networks and standardisation, chosen by frozen config objects; nothing else.

A config object says what to build; `build(inputs, outputs)` makes the torch module. Sequence
networks map (n, T, inputs) to (n, T, outputs); classifiers map (n, T, inputs) to (n, outputs), by
a `readout` of what they `represent` of a sequence.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from retwin.nets.state_space import StateSpace

__all__ = [
    "CNN",
    "LSTM",
    "MLP",
    "NETWORKS",
    "TCN",
    "LSTMClassifier",
    "Network",
    "Standardise",
    "StateSpace",
]


BLOCK = 2**22
"""Rows that are summed up together, in double precision."""


class Network(Protocol):
    """A config object that builds a network."""

    def build(self, inputs: int, outputs: int) -> nn.Module:
        """A module with fresh weights."""
        ...


class Standardise(nn.Module):
    """Subtract the mean and divide by the scale of each channel; saved with the weights.

    A channel that never varies has scale 1.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("scale", torch.ones(channels))

    def fit(self, values: Tensor) -> Standardise:
        """Take mean and standard deviation over all but the last axis, block by block."""
        blocks = values.reshape(-1, values.shape[-1]).split(BLOCK)
        told = [
            (each.mean(0), each.var(0, correction=0), each.abs().amax(0))
            for each in map(torch.Tensor.double, blocks)
        ]
        means, variances, largest = map(torch.stack, zip(*told, strict=True))
        share = torch.tensor([len(each) for each in blocks], dtype=torch.float64)
        share /= share.sum()
        mean = share @ means
        # What varies within blocks, and from one to another.
        scale = (share @ (variances + (means - mean).square())).sqrt()
        tiny = 1e-6 * largest.amax(dim=0).clamp_min(1e-30)
        self.mean.copy_(mean)
        self.scale.copy_(torch.where(scale > tiny, scale, torch.ones_like(scale)))
        return self

    def forward(self, values: Tensor) -> Tensor:
        """Physical units in, standard units out."""
        return (values - self.mean) / self.scale

    def inverse(self, values: Tensor) -> Tensor:
        """Standard units in, physical units out."""
        return values * self.scale + self.mean


@dataclass(frozen=True)
class MLP:
    """The same dense network at every sample: for twins whose nominal output has no memory."""

    hidden: tuple[int, ...] = (128, 128)

    def build(self, inputs: int, outputs: int) -> nn.Module:
        """Dense layers with SiLU between."""
        layers: list[nn.Module] = []
        for width, following in pairwise((inputs, *self.hidden)):
            # In place: at these sizes a processor spends as long on fresh memory as on numbers.
            layers += [nn.Linear(width, following), nn.SiLU(inplace=True)]
        return nn.Sequential(*layers, nn.Linear((inputs, *self.hidden)[-1], outputs))


@dataclass(frozen=True)
class LSTM:
    """Long short-term memory over time, with a dense read-out at every sample."""

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

    def forward(self, values: Tensor) -> Tensor:
        # The read-out sees the present input too: memory need not carry what is known anyway.
        remembered, _ = self.memory(values)
        return self.readout(torch.cat([remembered, self.direct(values)], dim=-1))


@dataclass(frozen=True)
class TCN:
    """Causal dilated convolutions over time; sees 1 + (kernel - 1) (2^levels - 1) samples."""

    channels: int = 32
    kernel: int = 3
    levels: int = 6

    def build(self, inputs: int, outputs: int) -> nn.Module:
        """A causal convolutional network with skip connections."""
        return _Convolutional(inputs, outputs, self)


class _Convolutional(nn.Module):
    def __init__(self, inputs: int, outputs: int, config: TCN) -> None:
        super().__init__()
        self.reach = [(config.kernel - 1) * 2**i for i in range(config.levels)]
        self.enter = nn.Conv1d(inputs, config.channels, 1)
        self.convolutions = nn.ModuleList(
            nn.Conv1d(config.channels, config.channels, config.kernel, dilation=2**i)
            for i in range(config.levels)
        )
        self.mixers = nn.ModuleList(
            nn.Conv1d(config.channels, config.channels, 1) for _ in range(config.levels)
        )
        self.leave = nn.Conv1d(config.channels, outputs, 1)

    def forward(self, values: Tensor) -> Tensor:
        state = self.enter(values.transpose(1, 2))
        for reach, convolution, mix in zip(self.reach, self.convolutions, self.mixers, strict=True):
            past = functional.pad(state, (reach, 0), mode="replicate")
            state = state + mix(functional.silu(convolution(past)))
        return self.leave(functional.silu(state)).transpose(1, 2)


@dataclass(frozen=True)
class LSTMClassifier:
    """The paper's classifier (section 4.3.2): stacked LSTM, the last step decides."""

    hidden: int = 100
    layers: int = 2
    dropout: float = 0.1

    def build(self, inputs: int, outputs: int) -> nn.Module:
        """Sequence in, logits out."""
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
    """Convolutions with pooling between, then mean and maximum over time, then a dense layer."""

    channels: tuple[int, ...] = (32, 64, 128)
    kernel: int = 5
    dropout: float = 0.2

    def build(self, inputs: int, outputs: int) -> nn.Module:
        """Sequence in, logits out."""
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
        # No pooling behind the last one: mean and maximum over time follow.
        # In two dimensions, one of them of length 1, channels may come last in memory, as they do
        # in what is given: that takes two thirds of the time on a processor.
        features = nn.Sequential(*layers[:-1])
        self.features = features.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.dropout = nn.Dropout(config.dropout)
        self.readout = nn.Linear(2 * config.channels[-1], outputs)

    def represent(self, values: Tensor) -> Tensor:
        features = self.features(values.transpose(1, 2).unsqueeze(2)).squeeze(2)
        return torch.cat([features.mean(dim=2), features.amax(dim=2)], dim=1)

    def forward(self, values: Tensor) -> Tensor:
        return self.readout(self.dropout(self.represent(values)))


NETWORKS: tuple[type, ...] = (MLP, LSTM, TCN, StateSpace, LSTMClassifier, CNN)
"""The kinds that a saved model may name."""
