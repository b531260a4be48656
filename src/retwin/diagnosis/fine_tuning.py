"""Fine-tuning: a network that learnt on generated trajectories goes on with a few real ones."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from retwin.data.trajectories import Trajectories
from retwin.diagnosis.features import class_index, class_order, one_view
from retwin.diagnosis.network import NetworkDiagnoser
from retwin.nets.training import Training, isolated, train
from retwin.progress import Progress

__all__ = ["FINE_TUNING", "fine_tune"]

FINE_TUNING = Training(max_epochs=10, batch_size=48, learning_rate=1e-3, weight_decay=1e-2)
"""A third of the first training's rate; fixed beforehand, as labelled trajectories are too few to
choose it on."""

GENERATED_PER_LABELLED = 3
"""In a batch: with the default 48, there are 16 labelled beside them."""


def fine_tune(
    diagnoser: NetworkDiagnoser,
    generated: Trajectories,
    labelled: Trajectories,
    *,
    seed: int,
    training: Training = FINE_TUNING,
    progress: Progress | None = None,
) -> NetworkDiagnoser:
    """Go on training a copy of `diagnoser`, with labelled real trajectories mixed in.

    Parameters
    ----------
    diagnoser: trained on `generated`; stays as it is.
    generated: labelled; they keep what was learnt from being forgotten.
    labelled: real, a few per class; drawn with replacement, one for three generated ones.
    seed: same seed, same weights on the same machine.
    training: `batch` counts the generated ones only. All epochs are done, and the last is kept.

    The start of every trajectory is hidden, in training and from then on (`Features.hide_start`):
    it may tell the labels of real ones. Each is seen at a phase of the sensor drawn anew each time.

    Raises
    ------
    InputError: unlabelled trajectories, fewer than two classes, a label that the diagnoser does not
        know, other channels or another rate than it was trained on.

    """
    for part in (generated, labelled):
        class_order(part, diagnoser.classes)
    features = replace(diagnoser.features, hide_start=True)
    with isolated(seed):
        tuned = NetworkDiagnoser(diagnoser.config, features, classes=diagnoser.classes)
    tuned.load_state_dict(diagnoser.state_dict())
    real, real_class = features.views(labelled), class_index(labelled, diagnoser.classes)
    generator = torch.Generator().manual_seed(seed)

    def loss(module: nn.Module, batch: tuple[Tensor, ...]) -> Tensor:
        views, classes = batch
        count = max(1, len(views) // GENERATED_PER_LABELLED)
        drawn = torch.randint(len(real), (count,), generator=generator)
        mixed = torch.cat([views, real[drawn].to(views.device)])
        truth = torch.cat([classes, real_class[drawn].to(views.device)])
        return nn.functional.cross_entropy(module(one_view(mixed, generator)), truth)

    examples = (features.views(generated), class_index(generated, diagnoser.classes))
    tuned.fitted = train(tuned, loss, examples, None, training, seed=seed, progress=progress)
    return tuned
