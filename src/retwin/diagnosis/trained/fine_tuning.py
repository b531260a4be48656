"""Fine-tuning: training a network on generated trajectories is continued with a few real ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor, nn

from retwin.checks import instance, require, whole
from retwin.diagnosis.diagnoser import TrainingTask
from retwin.diagnosis.trained.features import class_index, class_order, random_phase
from retwin.diagnosis.trained.network import NetworkDiagnoser
from retwin.nets.training import Training, isolated, train

FINE_TUNING = Training(max_epochs=10, batch_size=48, learning_rate=1e-3, weight_decay=1e-2)
"""The default training. Its learning rate is a third of the first training's; it was fixed in
advance, because labelled trajectories are too few to choose it."""


@dataclass(frozen=True)
class FineTune:
    """Continue the training of a network with labelled real trajectories.

    Parameters
    ----------
    base : NetworkDiagnoser
        The network, trained on generated trajectories; a copy of it is trained.
    generated_per_labelled : int
        Generated trajectories per labelled one in a batch, at least 1. They keep the network from
        forgetting. With a batch of 48 generated trajectories, the default of 3 adds 16 labelled
        ones. `batch_size` of the training counts the generated ones alone.

    Raises
    ------
    InputError
        If `base` is no network, or if there is no generated trajectory per labelled one.

    """

    adapts: ClassVar[bool] = True
    base: NetworkDiagnoser
    generated_per_labelled: int = 3

    def __post_init__(self) -> None:
        remedy = "train one with fit_diagnoser on generated trajectories"
        instance("base", self.base, NetworkDiagnoser, remedy=remedy)
        whole("generated_per_labelled", self.generated_per_labelled, at_least=1)

    def fit(self, task: TrainingTask) -> NetworkDiagnoser:
        """Train a copy of the base on both sets; see `fit_diagnoser`.

        Trajectories of the target are drawn with replacement. All epochs are run and the last is
        kept. The start of every trajectory is hidden, in training and in later use
        (`Features.hide_start`), and each is sampled at a new random phase each time
        (`Features.phases`).
        """
        generated, target = task.trajectories, task.target
        assert target is not None, "checked by fit_diagnoser"
        fits = task.classes is None and task.rate is None
        expected = "none for FineTune, which keeps those of its base"
        got = f"{task.classes} and {task.rate}"
        remedy = "leave them out, or train another base"
        require(fits, "classes and rate", expected=expected, got=got, remedy=remedy)
        base = self.base
        for part in (generated, target):
            class_order(part, base.classes)
        features = replace(base.features, hide_start=True)
        with isolated(task.seed):
            tuned = NetworkDiagnoser(base.config, features, classes=base.classes)
        tuned.load_state_dict(base.state_dict())
        real, real_class = features.phases(target), class_index(target, base.classes)
        generator = torch.Generator().manual_seed(task.seed)

        def loss(module: nn.Module, batch: tuple[Tensor, ...]) -> Tensor:
            phases, labels = batch
            count = max(1, len(phases) // self.generated_per_labelled)
            drawn = torch.randint(len(real), (count,), generator=generator)
            mixed = torch.cat([phases, real[drawn].to(phases.device)])
            truth = torch.cat([labels, real_class[drawn].to(phases.device)])
            return nn.functional.cross_entropy(module(random_phase(mixed, generator)), truth)

        examples = (features.phases(generated), class_index(generated, base.classes))
        how, seed = task.training or FINE_TUNING, task.seed
        tuned.fitted = train(tuned, loss, examples, None, how, seed=seed, progress=task.progress)
        return tuned
