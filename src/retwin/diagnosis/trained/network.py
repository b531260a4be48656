"""`NetworkDiagnoser`: a network on nominal output and residual, x = concat(ŷ, r) (Eq. 11)."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.catalog import CLASSIFIERS, classes
from retwin.data.trajectories import Trajectories
from retwin.diagnosis.diagnoser import TrainingTask
from retwin.diagnosis.trained.features import Features, class_index, class_names, class_order
from retwin.nets.networks import Network, Standardise
from retwin.nets.training import Fit, Training, isolated, train
from retwin.serialisation.configs import from_config, to_config
from retwin.serialisation.models import read_model, save_model


class NetworkDiagnoser(nn.Module):
    """A neural network that classifies trajectories.

    Parameters
    ----------
    network : Network
        The config from which the network is built.
    features : Features
        The input of the network.
    classes : tuple of str
        Class names, in the order of the probabilities.

    Attributes
    ----------
    config : Network
        As given.
    fitted : Fit or None
        History and figures of the training; None before it.

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
        """Logits (n, classes) of features (n, T', 2 d_y)."""
        return self.network(self.before(features))

    def predict_proba(self, trajectories: Trajectories) -> NDArray:
        """Probabilities (n, classes), see `Diagnoser`."""
        return self.of_features(self.features(trajectories))

    @torch.no_grad()
    def of_features(self, features: Tensor, *, trajectories_per_batch: int = 256) -> NDArray:
        """Probabilities (n, classes) of features (n, T', 2 d_y), computed in batches.

        Parameters
        ----------
        trajectories_per_batch : int, default 256
            Trajectories that are classified together: activations of more would leave the cache.

        """
        batches = features.split(trajectories_per_batch)
        return torch.cat([self(each).double().softmax(dim=1) for each in batches]).numpy()

    def save(self, folder: str | Path) -> None:
        """Write weights and description, see `retwin.serialisation.models`."""
        about = {
            "network": to_config(self.config, classes(CLASSIFIERS, Network)),
            "classes": self.classes,
            **self.features.about(),
            "fitted": None if self.fitted is None else asdict(self.fitted),
        }
        save_model(folder, "diagnoser", about, self.state_dict())

    @classmethod
    def load(cls, folder: str | Path) -> NetworkDiagnoser:
        """Read what `save` wrote.

        Raises
        ------
        InputError
            If the folder holds no network diagnoser, or a damaged one.

        """
        about, weights = read_model(folder, "diagnoser")
        network = from_config(about["network"], classes(CLASSIFIERS, Network))
        model = cls(network, Features.of(about), classes=class_names(about["classes"]))
        model.load_state_dict(weights)
        model.fitted = Fit.of(about["fitted"])
        return model.eval()


def training_for(network: Network) -> Training:
    """The training that suits a network: its `default_training`, if it has one."""
    return getattr(network, "default_training", Training())


def fit_network(network: Network, task: TrainingTask) -> NetworkDiagnoser:
    """Train a network by cross-entropy; see `fit_diagnoser`."""
    trajectories, seed = task.trajectories, task.seed
    order = class_order(trajectories, task.classes)
    features = Features.at(trajectories, task.rate)
    with isolated(seed):
        model = NetworkDiagnoser(network, features, classes=order)
    # Features are split and not trajectories, which may not fit into memory.
    inputs, truth = features(trajectories), class_index(trajectories, order)
    sets = [(inputs[part], truth[part]) for part in trajectories.split_index(0.8, seed=seed)]
    del inputs
    model.before.fit(sets[0][0])

    def loss(module: nn.Module, batch: tuple[Tensor, ...]) -> Tensor:
        return nn.functional.cross_entropy(module(batch[0]), batch[1])

    how = task.training or training_for(network)
    result = train(model, loss, sets[0], sets[1], how, seed=seed, progress=task.progress)
    correct = model.of_features(sets[1][0]).argmax(axis=1) == sets[1][1].numpy()
    model.fitted = replace(result, figures={"accuracy": float(correct.mean())})
    return model
