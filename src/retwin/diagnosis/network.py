"""`NetworkDiagnoser`: a network on nominal output and residual, x = concat(ŷ, r) (Eq. 11)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.data.trajectories import Trajectories
from retwin.diagnosis.features import Features, class_index, class_order
from retwin.nets.networks import CNN, NETWORKS, Network, Standardise
from retwin.nets.training import Fit, Training, isolated, train
from retwin.progress import Progress
from retwin.serialisation.configs import from_config, to_config
from retwin.serialisation.models import read_model, write_model

__all__ = ["NetworkDiagnoser", "fit_diagnoser", "training_for"]

CHUNK = 256


class NetworkDiagnoser(nn.Module):
    """A trained classifier of trajectories.

    Parameters
    ----------
    network: the config its module was built from.
    features: what it looks at.
    classes: in the order of the probabilities.

    """

    def __init__(self, network: Network, features: Features, *, classes: tuple[str, ...]) -> None:
        super().__init__()
        self.config = network
        self.features = features
        self.classes = classes
        self.before = Standardise(features.width)
        self.network = network.build(features.width, len(classes))
        self.fitted: Fit | None = None

    def forward(self, features: Tensor) -> Tensor:
        """Logits (n, classes)."""
        return self.network(self.before(features))

    def predict_proba(self, trajectories: Trajectories) -> NDArray:
        """Probabilities (n, classes), see `Diagnoser`."""
        return self.of_features(self.features(trajectories))

    @torch.no_grad()
    def of_features(self, features: Tensor) -> NDArray:
        """Probabilities (n, classes) for features (n, T', d), in chunks."""
        parts = [self(part).double().softmax(dim=1) for part in features.split(CHUNK)]
        return torch.cat(parts).numpy()

    def save(self, folder: str | Path) -> None:
        """Write weights and description, see `retwin.serialisation.models`."""
        about = {
            "network": to_config(self.config, NETWORKS),
            "classes": self.classes,
            **self.features.about(),
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
            Features.of(about),
            classes=tuple(about["classes"]),
        )
        model.load_state_dict(weights)
        model.fitted = Fit.of(about["fitted"])
        return model.eval()


DEFAULTS = {
    "CNN": Training(max_epochs=25, batch_size=64, learning_rate=3e-3, weight_decay=1e-2),
    "LSTMClassifier": Training(max_epochs=30, batch_size=32, learning_rate=1e-3, decay="step"),
}


def training_for(network: Network) -> Training:
    """What suits the network."""
    return DEFAULTS.get(type(network).__name__, Training())


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
    order = class_order(trajectories, classes)
    features = Features.at(trajectories, rate)
    with isolated(seed):
        model = NetworkDiagnoser(network, features, classes=order)
    # Features are split and not trajectories, which no memory may hold.
    every, truth = features(trajectories), class_index(trajectories, order)
    sets = [(every[part], truth[part]) for part in trajectories.split_index(0.8, seed=seed)]
    del every
    model.before.fit(sets[0][0])

    def loss(module: nn.Module, batch: tuple[Tensor, ...]) -> Tensor:
        return nn.functional.cross_entropy(module(batch[0]), batch[1])

    result = train(
        model,
        loss,
        sets[0],
        sets[1],
        training or training_for(network),
        seed=seed,
        progress=progress,
    )
    right = model.of_features(sets[1][0]).argmax(axis=1) == sets[1][1].numpy()
    model.fitted = replace(result, figures={"accuracy": float(right.mean())})
    return model
