"""Domain-adversarial training on labelled trajectories of a twin and unlabelled real ones.

A critic classifies the network's representation of a trajectory as the twin's or as real. The
network learns the classes on the twin's trajectories, and at the same time a representation on
which the critic fails (Ganin et al., "Domain-adversarial training of neural networks", JMLR 17,
2016).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import count
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from retwin.checks import positive, require, whole
from retwin.diagnosis.diagnoser import TrainingTask
from retwin.diagnosis.trained.features import Features, class_index, class_order, random_phase
from retwin.diagnosis.trained.network import NetworkDiagnoser, training_for
from retwin.nets.networks import CNN, Network
from retwin.nets.training import isolated, train


@dataclass(frozen=True)
class DANN:
    """A domain-adversarial network, which learns from unlabelled real trajectories too.

    Parameters
    ----------
    network : Network
        `CNN` or `LSTMClassifier`.
    hidden : int
        Hidden units of the critic, at least 1; 100 as in the small architectures of Ganin et al.
    gamma : float
        Growth of the critic's weight 2 / (1 + exp(-gamma p)) - 1 over the progress p from 0 to 1
        of the training, positive; 10 as in Ganin et al., section 5.2.2.

    Raises
    ------
    InputError
        If `hidden` or `gamma` is out of range.

    """

    adapts: ClassVar[bool] = True
    network: Network = CNN()  # noqa: RUF009 - a frozen config
    hidden: int = 100
    gamma: float = 10.0

    def __post_init__(self) -> None:
        whole("hidden", self.hidden, at_least=1)
        positive("gamma", self.gamma)

    def fit(self, task: TrainingTask) -> NetworkDiagnoser:
        """Train the network and its critic; see `fit_diagnoser`.

        Each batch holds as many real trajectories as of the source, drawn with replacement. The
        start of every trajectory is hidden (`Features.hide_start`), and each is sampled at a new
        random phase each time (`Features.phases`), so that the critic learns less of single ones.
        The last epoch is kept: choosing a better one for real data would need their labels. The
        figures hold the critic's `domain_accuracy` too, the mean of its accuracies on the held-out
        fifth and the target: 0.5 where the critic fails.
        """
        source, target, seed = task.trajectories, task.target, task.seed
        assert target is not None, "checked by fit_diagnoser"
        order = class_order(source, task.classes)
        features = Features.at(source, task.rate, hide_start=True)
        fits = len(target) > 0 and target.steps == source.steps
        expected = f"at least one real trajectory of {source.steps} samples, as in the source"
        got = f"{len(target)} of {target.steps} samples"
        remedy = "give the unlabelled real trajectories, cut to the source's length"
        require(fits, "target", expected=expected, got=got, remedy=remedy)
        fitted_on, held_out = source.split(0.8, seed=seed)
        with isolated(seed):
            diagnoser = NetworkDiagnoser(self.network, features, classes=order)
            pair = _Pair(diagnoser, self.hidden)
        phases, unlabelled = features.phases(fitted_on), features.phases(target)
        diagnoser.before.fit(phases)
        how = task.training or training_for(self.network)
        steps = count()
        last = how.max_epochs * math.ceil(len(phases) / how.batch_size)
        generator = torch.Generator().manual_seed(seed)

        def loss(pair: _Pair, batch: tuple[Tensor, ...]) -> Tensor:
            """Cross-entropy of the source's classes and of both domains."""
            source = random_phase(batch[0], generator)
            drawn = torch.randint(len(unlabelled), (len(source),), generator=generator)
            real = random_phase(unlabelled[drawn], generator)
            # In one pass: batch normalisation must not give either domain a scale of its own.
            representation = pair.represent(torch.cat([source, real]))
            # From 0 to 1 over the training: an untrained critic is wrong.
            weight = 2 / (1 + math.exp(-self.gamma * next(steps) / last)) - 1
            domains = torch.cat([torch.zeros(len(source)), torch.ones(len(real))])
            classes = pair.classify(representation[: len(source)])
            critic = pair.critic(_reverse(representation, weight))[:, 0]
            of_critic = functional.binary_cross_entropy_with_logits(critic, domains)
            return functional.cross_entropy(classes, batch[1]) + of_critic

        labelled = (phases, class_index(fitted_on, order))
        result = train(pair, loss, labelled, None, how, seed=seed, progress=task.progress)
        best = diagnoser.of_features(features(held_out)).argmax(axis=1)
        accuracy = float((best == class_index(held_out, order).numpy()).mean())
        of_critic = pair.domain_accuracy(features(held_out), unlabelled[:, 0])
        figures = {"accuracy": accuracy, "domain_accuracy": of_critic}
        diagnoser.fitted = replace(result, figures=figures)
        return diagnoser


class _Pair(nn.Module):
    """A diagnoser, and the critic of its representation."""

    def __init__(self, diagnoser: NetworkDiagnoser, hidden: int) -> None:
        super().__init__()
        represents = hasattr(diagnoser.network, "represent")
        expected = "a classifier that represents a trajectory: CNN or LSTMClassifier"
        got = type(diagnoser.config).__name__
        require(represents, "network", expected=expected, got=got, remedy="choose one of these")
        self.diagnoser = diagnoser
        width = self._network.readout.in_features
        self.critic = nn.Sequential(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, 1))

    @property
    def _network(self) -> Any:
        return self.diagnoser.network

    def represent(self, features: Tensor) -> Tensor:
        return self._network.represent(self.diagnoser.before(features))

    def classify(self, representation: Tensor) -> Tensor:
        return self._network.readout(self._network.dropout(representation))

    @torch.no_grad()
    def domain_accuracy(self, source: Tensor, target: Tensor) -> float:
        """Mean of the critic's accuracies on the two domains."""
        hits = (self.critic(self.represent(source)) < 0, self.critic(self.represent(target)) >= 0)
        return float(sum(each.float().mean() for each in hits) / 2)


def _reverse(values: Tensor, weight: float) -> Tensor:
    """The same values, whose gradient is negated and scaled (Ganin et al., section 4.2)."""
    values = values.view_as(values)
    values.register_hook(lambda gradient: -weight * gradient)
    return values
