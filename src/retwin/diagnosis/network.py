"""`NetworkDiagnoser`: a network on nominal output and residual, x = concat(ŷ, r) (Eq. 11)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.configs import from_config, to_config
from retwin.errors import InputError
from retwin.models import read_model, write_model
from retwin.networks import CNN, NETWORKS, Network, Standardise
from retwin.training import Fit, Training, isolated, train
from retwin.trajectories import Channels, Trajectories
from retwin.twins.protocol import Progress

__all__ = ["NetworkDiagnoser", "fit_diagnoser"]

CHUNK = 256


class NetworkDiagnoser(nn.Module):
    """A trained classifier of trajectories.

    Parameters
    ----------
    network: the config its module was built from.
    classes: in the order of the probabilities.
    outputs: channels it was trained on.
    rate: samples per second of the trajectories it takes.
    stride: every how many samples it looks; the sensor's true rate is often lower than the file's.

    """

    def __init__(
        self,
        network: Network,
        *,
        classes: tuple[str, ...],
        outputs: Channels,
        rate: float,
        stride: int,
    ) -> None:
        super().__init__()
        self.config = network
        self.classes = classes
        self.outputs = outputs
        self.rate = rate
        self.stride = stride
        self.before = Standardise(2 * len(outputs))
        self.network = network.build(2 * len(outputs), len(classes))
        self.fitted: Fit | None = None

    def features(self, trajectories: Trajectories) -> Tensor:
        """concat(ŷ, r) at every `stride`-th sample, (n, T', 2 d_y); r is 0 where missing."""
        for name, ours, theirs in (
            ("outputs", self.outputs, trajectories.outputs),
            ("rate", self.rate, trajectories.rate),
        ):
            if ours != theirs:
                raise InputError(
                    f"trajectories.{name}",
                    expected=f"what the diagnoser was trained on, {ours}",
                    got=f"{theirs}",
                    remedy="resample or rename, or train on data like these",
                )
        thin = slice(None, None, self.stride)
        nominal = trajectories.nominal[:, thin]
        residual = np.where(
            trajectories.mask[:, thin], trajectories.observed[:, thin] - nominal, 0.0
        )
        return torch.as_tensor(np.concatenate([nominal, residual], axis=2), dtype=torch.float32)

    def forward(self, features: Tensor) -> Tensor:
        """Logits (n, classes)."""
        return self.network(self.before(features))

    @torch.no_grad()
    def predict_proba(self, trajectories: Trajectories) -> NDArray:
        """Probabilities (n, classes), see `Diagnoser`."""
        parts = [
            self(part).double().softmax(dim=1) for part in self.features(trajectories).split(CHUNK)
        ]
        return torch.cat(parts).numpy()

    def save(self, folder: str | Path) -> None:
        """Write weights and description, see `retwin.models`."""
        about = {
            "network": to_config(self.config, NETWORKS),
            "classes": self.classes,
            "outputs": vars(self.outputs),
            "rate": self.rate,
            "stride": self.stride,
            "fitted": None if self.fitted is None else asdict(self.fitted),
        }
        with write_model(folder, "diagnoser", about, self.state_dict()):
            pass

    @classmethod
    def load(cls, folder: str | Path) -> NetworkDiagnoser:
        """Read what `save` wrote; InputError when it is not a diagnoser or damaged."""
        about, weights = read_model(folder, "diagnoser")
        model = cls(
            from_config(about["network"], NETWORKS),
            classes=tuple(about["classes"]),
            outputs=Channels.of(about["outputs"]),
            rate=about["rate"],
            stride=about["stride"],
        )
        model.load_state_dict(weights)
        model.fitted = Fit.of(about["fitted"])
        return model.eval()


def _stride(given: float, wanted: float) -> int:
    """Every how many samples at `given` Hz make `wanted` Hz."""
    stride = given / wanted if wanted > 0 else 0.0
    if stride < 1 or abs(stride - round(stride)) > 1e-6:
        raise InputError(
            "rate",
            expected=f"{given:g} Hz, the data's rate, or a whole part of it",
            got=f"{wanted:g} Hz",
            remedy="choose a rate that takes every sample, every second, every third …",
        )
    return round(stride)


DEFAULTS = {
    "CNN": Training(epochs=25, batch=64, rate=3e-3, weight_decay=1e-2),
    "LSTMClassifier": Training(epochs=30, batch=32, rate=1e-3, decay="step"),
}


def fit_diagnoser(
    trajectories: Trajectories,
    network: Network = CNN(),  # noqa: B008 - a frozen config
    *,
    seed: int,
    classes: Sequence[str] | None = None,
    rate: float | None = None,
    training: Training | None = None,
    progress: Progress | None = None,
) -> NetworkDiagnoser:
    """Train a classifier on labelled trajectories.

    Parameters
    ----------
    trajectories: labelled; a stratified fifth is held out to choose the best epoch.
    network: `CNN` or `LSTMClassifier`.
    seed: same seed, same weights on the same machine.
    classes: their order; by default sorted by name.
    rate: samples per second the network looks at; by default 10 Hz or the data's, if lower.
    training: epochs, batch, rate; by default what suits the network.

    `fitted.figures` hold the `accuracy` on the held-out fifth.

    Raises
    ------
    InputError: unlabelled trajectories, fewer than two classes, a label not among `classes`, a
        rate that is no whole part of the data's.

    """
    named = trajectories.known_labels
    order = tuple(classes) if classes is not None else tuple(sorted(named))
    unknown = named - set(order)
    if len(named) < 2 or unknown or "" in trajectories.labels:
        raise InputError(
            "trajectories",
            expected=f"labelled trajectories of at least two of the classes {', '.join(order)}",
            got=f"unknown {sorted(unknown)}"
            if unknown
            else f"labels {sorted(set(trajectories.labels))}",
            remedy="label every trajectory with a known class",
        )
    stride = _stride(trajectories.rate, min(10.0, trajectories.rate) if rate is None else rate)
    with isolated(seed):
        model = NetworkDiagnoser(
            network,
            classes=order,
            outputs=trajectories.outputs,
            rate=trajectories.rate,
            stride=stride,
        )
    fitted_on, held_out = trajectories.split(0.8, seed=seed)
    sets = [
        (model.features(part), torch.tensor([order.index(label) for label in part.labels]))
        for part in (fitted_on, held_out)
    ]
    model.before.fit(sets[0][0])

    def loss(module: nn.Module, batch: tuple[Tensor, ...]) -> Tensor:
        return nn.functional.cross_entropy(module(batch[0]), batch[1])

    result = train(
        model,
        loss,
        sets[0],
        sets[1],
        training or DEFAULTS.get(type(network).__name__, Training()),
        seed=seed,
        progress=progress,
    )
    right = model.predict_proba(held_out).argmax(axis=1) == sets[1][1].numpy()
    model.fitted = replace(result, figures={"accuracy": float(right.mean())})
    return model
