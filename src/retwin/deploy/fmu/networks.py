"""Networks as C99: their weights in the order in which `networks.c` reads them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.errors import InputError
from retwin.nets.networks import LSTM, MLP, TCN, Network, StateSpace


@dataclass(frozen=True)
class CNetwork:
    """How C calls a network.

    Attributes
    ----------
    kind : str
        The function of `networks.c`.
    sizes : str
        Its arguments between the weights and the input.
    memory : int
        Numbers that it remembers.
    widest : int
        Its widest layer.

    """

    kind: str
    sizes: str
    memory: int
    widest: int

    def defined(self, name: str) -> str:
        """A macro by which C calls it, as `name(weights, in, memory, first, out)`."""
        call = f"{self.kind}(w, {self.sizes}, in, memory, first, out)"
        return f"#define {name}(w, in, memory, first, out) {call}\n"


def c_network(config: Network, inputs: int, outputs: int) -> CNetwork:
    """How C calls the network of a config object, with so many input and output channels.

    Raises
    ------
    InputError
        `networks.c` has no such network.

    """
    match config:
        case MLP(hidden):
            widths = (inputs, *hidden, outputs)
            written = ", ".join(map(str, widths))
            sizes = f"{len(widths) - 1}, (const int[]){{{written}}}"
            return CNetwork("mlp", sizes, 0, max(widths))
        case LSTM(hidden, layers):
            sizes = f"{inputs}, {hidden}, {layers}, {outputs}"
            widest = max(4 * hidden, inputs + hidden)
            return CNetwork("lstm", sizes, 2 * hidden * layers, widest)
        case TCN(channels, kernel, levels):
            sizes = f"{inputs}, {channels}, {kernel}, {levels}, {outputs}"
            past = (kernel - 1) * (2**levels - 1)
            return CNetwork("tcn", sizes, past * channels, kernel * channels)
        case StateSpace(states, hidden):
            sizes = f"{inputs}, {states}, {hidden}, {outputs}"
            return CNetwork("state_space", sizes, states, max(states + hidden, outputs))
    expected = "networks that exist in C: MLP, LSTM, TCN and StateSpace"
    remedy = "fit it with one of these"
    raise InputError("model", expected=expected, got=repr(config), remedy=remedy)


def weights_of(config: Network, module: Any) -> NDArray:
    """The weights of the module of a config object, one after the other, in double precision."""
    parts: list[NDArray]
    match config:
        case MLP():
            parts = [dense_weights(each) for each in module if isinstance(each, nn.Linear)]
        case LSTM(layers=layers):
            parts = [_gates(module.memory, layer) for layer in range(layers)]
            parts += map(dense_weights, (module.direct, module.readout[0], module.readout[2]))
        case TCN():
            pairs = zip(module.convolutions, module.mixers, strict=True)
            between = [each for pair in pairs for each in pair]
            parts = [dense_weights(each) for each in (module.enter, *between, module.leave)]
        case _:
            first, second = module.readout[0], module.readout[2]
            after = (first, second, module.skip, module.enter, module.now, module.move)
            start = [flat(module.start), flat(module.log_rate.double().exp())]
            parts = [*start, *map(dense_weights, after)]
    return np.concatenate(parts)


def dense_weights(layer: Any) -> NDArray:
    """The matrix of a dense layer, or of a convolution with its taps in series, and its bias."""
    matrix = layer.weight.movedim(1, -1) if layer.weight.ndim == 3 else layer.weight
    return np.concatenate([flat(each) for each in (matrix, layer.bias) if each is not None])


def _gates(memory: nn.LSTM, layer: int) -> NDArray:
    """The matrix of a layer of an LSTM for its input and its own output, and the sum of biases."""
    own = {
        name: getattr(memory, f"{name}_l{layer}").double()
        for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
    }
    matrix = torch.cat([own["weight_ih"], own["weight_hh"]], dim=1)
    return np.concatenate([flat(matrix), flat(own["bias_ih"] + own["bias_hh"])])


def flat(values: Tensor) -> NDArray:
    """The numbers of a tensor, in double precision."""
    return values.detach().double().flatten().numpy()
