"""Domain-adversarial training: labelled twin data, and real outputs without labels.

Ganin et al., "Domain-adversarial training of neural networks", JMLR 17 (2016). A critic tells from
the network's representation whether an example is the twin's or real. The network learns the
classes on the twin's, and at the same time a representation in which the critic cannot tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from retwin.data.trajectories import Trajectories
from retwin.diagnosis.features import Features, class_index, class_order, one_view
from retwin.diagnosis.network import NetworkDiagnoser, training_for
from retwin.errors import InputError
from retwin.nets.networks import CNN, Network
from retwin.nets.training import Training, isolated, train
from retwin.progress import Progress

__all__ = ["fit_dann"]

HIDDEN = 100
"""Units of the critic, as in the paper's small architectures."""
GAMMA = 10.0
"""How fast the critic's say grows; the paper's."""


def fit_dann(
    source: Trajectories,
    target: Trajectories,
    network: Network = CNN(),  # noqa: B008 - a frozen config
    *,
    seed: int,
    classes: Sequence[str] | None = None,
    rate: float | None = None,
    training: Training | None = None,
    progress: Progress | None = None,
) -> NetworkDiagnoser:
    """Train a classifier on labelled trajectories so that it does not tell them from real ones.

    Parameters
    ----------
    source: labelled, of a twin; a stratified fifth is held out, for figures only.
    target: real; their labels are not looked at. As many as of the source are in each batch, drawn
        with replacement.
    network: `CNN` or `LSTMClassifier`.
    seed: same seed, same weights on the same machine.
    classes: their order; by default sorted by name.
    rate: samples per second the network looks at; by default 10 Hz or the data's, if lower.
    training: epochs, batch, rate; by default what suits the network.

    The start of every trajectory is hidden (`Features.hide_start`). Each is seen at a phase of the
    sensor drawn anew each time (`Features.views`), which tells the critic less of single ones.
    The last epoch is kept: what would choose a better one for real data is their labels.
    `fitted.figures` hold the `accuracy` on the held-out fifth, and the critic's `domain_accuracy`
    on it and the target, balanced: 0.5 where it cannot tell.

    Raises
    ------
    InputError: a source that is not labelled with at least two of the classes, target trajectories
        of other channels, rate or length, or none, a network without a representation.

    """
    order = class_order(source, classes)
    features = Features.at(source, rate, hide_start=True)
    if len(target) == 0 or target.steps != source.steps:
        raise InputError(
            "target",
            expected=f"at least one real trajectory of {source.steps} samples, as in the source",
            got=f"{len(target)} of {target.steps} samples",
            remedy="give the unlabelled real trajectories, cut to the source's length",
        )
    fitted_on, held_out = source.split(0.8, seed=seed)
    with isolated(seed):
        pair = _Pair(NetworkDiagnoser(network, features, classes=order))
    views, unlabelled = features.views(fitted_on), features.views(target)
    pair.diagnoser.before.fit(views)
    how = training or training_for(network)
    steps = how.max_epochs * math.ceil(len(views) / how.batch_size)
    loss = _Loss(unlabelled, torch.Generator().manual_seed(seed), steps)
    labelled = (views, class_index(fitted_on, order))
    result = train(pair, loss, labelled, None, how, seed=seed, progress=progress)
    figures = {
        "accuracy": _accuracy(pair.diagnoser, held_out),
        "domain_accuracy": pair.domain_accuracy(features(held_out), unlabelled[:, 0]),
    }
    pair.diagnoser.fitted = replace(result, figures=figures)
    return pair.diagnoser


class _Pair(nn.Module):
    """A diagnoser, and the critic of its representation."""

    def __init__(self, diagnoser: NetworkDiagnoser) -> None:
        super().__init__()
        if not hasattr(diagnoser.network, "represent"):
            raise InputError(
                "network",
                expected="a classifier that represents a trajectory: CNN or LSTMClassifier",
                got=type(diagnoser.config).__name__,
                remedy="choose one of these",
            )
        self.diagnoser = diagnoser
        width = self._network.readout.in_features
        self.critic = nn.Sequential(nn.Linear(width, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 1))

    @property
    def _network(self) -> Any:
        return self.diagnoser.network

    def represent(self, features: Tensor) -> Tensor:
        return self._network.represent(self.diagnoser.before(features))

    def classify(self, representation: Tensor) -> Tensor:
        return self._network.readout(self._network.dropout(representation))

    @torch.no_grad()
    def domain_accuracy(self, source: Tensor, target: Tensor) -> float:
        """Of the critic, the mean of its accuracies on the two domains."""
        right = (self.critic(self.represent(source)) < 0, self.critic(self.represent(target)) >= 0)
        return float(sum(each.float().mean() for each in right) / 2)


class _Reversed(torch.autograd.Function):
    """The identity, whose gradient is turned around and scaled (the paper's section 4.2)."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, strength: float) -> Tensor:
        ctx.strength = strength
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return -ctx.strength * gradients[0], None


@dataclass
class _Loss:
    """Classes of the source, and domains of both; counts its steps, for the critic's strength."""

    target: Tensor
    generator: torch.Generator
    steps: int
    done: int = 0

    @property
    def strength(self) -> float:
        """From 0 to 1 over the training: at first a critic has nothing sound to say."""
        return 2 / (1 + math.exp(-GAMMA * self.done / self.steps)) - 1

    def __call__(self, pair: _Pair, batch: tuple[Tensor, ...]) -> Tensor:
        views, classes = batch
        source = one_view(views, self.generator)
        drawn = torch.randint(len(self.target), (len(source),), generator=self.generator)
        target = one_view(self.target[drawn], self.generator).to(source.device)
        # In one pass: batch normalisation must not give either domain a scale of its own.
        representation = pair.represent(torch.cat([source, target]))
        logits = pair.classify(representation[: len(source)])
        suspicion = pair.critic(_Reversed.apply(representation, self.strength))[:, 0]
        domains = torch.cat([torch.zeros(len(source)), torch.ones(len(target))]).to(source.device)
        self.done += 1
        return functional.cross_entropy(
            logits, classes
        ) + functional.binary_cross_entropy_with_logits(suspicion, domains)


def _accuracy(diagnoser: NetworkDiagnoser, held_out: Trajectories) -> float:
    best = diagnoser.predict_proba(held_out).argmax(axis=1)
    return float((best == class_index(held_out, diagnoser.classes).numpy()).mean())
