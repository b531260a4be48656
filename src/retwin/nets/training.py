"""Training of small networks: AdamW, early stopping, and the best weights of the validation set."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import AdamW
from torch.optim.lr_scheduler import LRScheduler, MultiStepLR, OneCycleLR

from retwin.checks import finite, one_of, positive, whole
from retwin.progress import Progress
from retwin.workers.threads import one_thread

Loss = Callable[[Any, tuple[Tensor, ...]], Tensor]
"""A function of the network and a batch whose value is the mean loss over the examples."""

WARM_UP = 0.1001
"""Share of the optimiser steps in which the one-cycle schedule raises the learning rate. It is just
above a tenth, because at a tenth of ten steps torch's schedule divides by zero."""


@dataclass(frozen=True)
class Training:
    """Settings of the optimiser and of its schedule.

    Parameters
    ----------
    max_epochs : int
        Greatest number of passes over the training set, at least 1.
    batch_size : int
        Examples per optimiser step, at least 1.
    learning_rate : float
        Largest learning rate of AdamW.
    decay : str
        "cosine" is the one-cycle schedule: the learning rate rises over a tenth of the steps, then
        falls to nearly 0. "step" starts at the largest rate and divides it by ten after two thirds
        of the steps.
    patience : int
        Epochs without a lower validation loss after which training stops; 0 never stops early.
    weight_decay : float
        Weight decay of AdamW.
    clip : float
        Largest norm of the gradient of all parameters together, of an ensemble those of each
        member; 0 does not clip.

    Raises
    ------
    InputError
        An unknown schedule, or a number out of its range.

    """

    max_epochs: int = 100
    batch_size: int = 64
    learning_rate: float = 1e-3
    decay: str = "cosine"
    patience: int = 0
    weight_decay: float = 0.0
    clip: float = 1.0

    def __post_init__(self) -> None:
        one_of("decay", self.decay, ("cosine", "step"))
        whole("max_epochs", self.max_epochs, at_least=1)
        whole("batch_size", self.batch_size, at_least=1)
        whole("patience", self.patience)
        positive("learning_rate", self.learning_rate)
        finite("weight_decay", self.weight_decay, at_least=0)
        finite("clip", self.clip, at_least=0)


@dataclass(frozen=True)
class Fit:
    """The record of a training, saved with the fitted model.

    Attributes
    ----------
    figures : dict of str to float
        Accuracy on held-out data, by name.
    history : dict of str to list of float
        Mean loss of each epoch, "train" and "validation".
    best_epoch : int
        Epoch whose weights were kept, counted from 1.
    reason : str
        Why training ended.

    """

    figures: dict[str, float]
    history: dict[str, list[float]]
    best_epoch: int
    reason: str

    @classmethod
    def of(cls, values: dict[str, Any] | None) -> Fit | None:
        """The record from its JSON values; None where there is none."""
        return None if values is None else cls(**values)


@contextmanager
def isolated(seed: int) -> Iterator[None]:
    """Run with torch's global generator seeded and on one thread, and restore both afterwards.

    Initial weights and dropout draw from the global generator; torch lets no other be given.
    Networks this small are slower on several threads, and their last digits would depend on the
    number of threads.
    """
    with one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


def train(
    network: nn.Module,
    loss: Loss,
    training_set: tuple[Tensor, ...],
    validation_set: tuple[Tensor, ...] | None,
    how: Training,
    *,
    seed: int,
    progress: Progress | None = None,
) -> Fit:
    """Train `network` in place, on the CPU, and leave it in evaluation mode.

    The weights of the epoch with the lowest validation loss are kept. Without a validation set the
    last weights are kept, and training does not stop early. Modules that are in evaluation mode at
    the start stay in it, so a fitted network is trained further without dropout.

    Parameters
    ----------
    network : nn.Module
        All its parameters that require a gradient are trained.
    loss : callable
        `loss(network, batch)` is the mean loss over the examples of the batch, a scalar.
    training_set, validation_set : tuple of Tensor
        Tensors whose first axis is the example; a batch has the same examples of each.
    how : Training
        Settings of the optimiser and of its schedule.
    seed : int
        Seed of the order of examples and of dropout; the same seed gives the same weights on the
        same machine.
    progress : callable, optional
        Called after each epoch with the share of the work that is done.

    Returns
    -------
    Fit
        The record, without figures.

    Raises
    ------
    RuntimeError
        The loss of a training batch is not finite; the message names the epoch.

    """
    generator = torch.Generator().manual_seed(seed)
    steps = math.ceil(len(training_set[0]) / how.batch_size) * how.max_epochs
    history: dict[str, list[float]] = {"train": [], "validation": []}
    best, best_epoch, weights = math.inf, 0, None
    reason = ""
    network.cpu()
    with isolated(seed):
        optimiser = _Optimiser(network, how, steps=steps)
        for epoch in range(1, how.max_epochs + 1):
            losses = []
            for batch in _batches(training_set, how.batch_size, generator):
                value = loss(network, batch)
                if not torch.isfinite(value):
                    raise RuntimeError(
                        f"training: the loss is {value.item()} in epoch {epoch}; "
                        "lower the learning rate or check the data's scale"
                    )
                optimiser.step(value)
                losses.append(value.detach())
            history["train"].append(torch.stack(losses).mean().item())
            if validation_set is not None:
                held_out = _batches(validation_set, 4 * how.batch_size, None)
                history["validation"].append(_validation_loss(network, loss, held_out))
                if history["validation"][-1] < best:
                    best, best_epoch = history["validation"][-1], epoch
                    weights = {k: v.clone() for k, v in network.state_dict().items()}
                elif how.patience and epoch - best_epoch >= how.patience:
                    reason = f"no better validation loss for {how.patience} epochs"
            if progress is not None:
                progress(1.0 if reason else epoch / how.max_epochs)
            if reason:
                break
    if weights is not None:
        network.load_state_dict(weights)
    network.eval()
    return Fit({}, history, best_epoch or epoch, reason or f"all {epoch} epochs done")


class _Optimiser:
    """AdamW with its schedule over `steps` steps and the clipping of gradients."""

    def __init__(self, network: nn.Module, how: Training, *, steps: int) -> None:
        # Members of an ensemble are clipped alone: the gradients of one say nothing of another.
        alone = network if isinstance(network, nn.ModuleList) else [network]
        self.parts = [list(each.parameters()) for each in alone]
        self.clip = how.clip
        self.adam = AdamW(
            network.parameters(), how.learning_rate, weight_decay=how.weight_decay, fused=True
        )
        self.schedule: LRScheduler
        if how.decay == "cosine":
            self.schedule = OneCycleLR(
                self.adam, how.learning_rate, steps, pct_start=WARM_UP, final_div_factor=1000
            )
        else:
            self.schedule = MultiStepLR(self.adam, [math.ceil(steps * 2 / 3)], gamma=0.1)

    def step(self, loss: Tensor) -> None:
        """One step down the gradient of `loss`."""
        self.adam.zero_grad()
        loss.backward()
        for part in self.parts if self.clip else ():
            nn.utils.clip_grad_norm_(part, self.clip)
        self.adam.step()
        self.schedule.step()


@torch.no_grad()
def _validation_loss(
    network: nn.Module, loss: Loss, batches: Iterable[tuple[Tensor, ...]]
) -> float:
    """Mean loss per example in evaluation mode; every module then returns to the mode it was in."""
    modes = {module: module.training for module in network.modules()}
    network.eval()
    weighted = [(len(batch[0]), loss(network, batch).item()) for batch in batches]
    for module, mode in modes.items():
        module.training = mode
    return sum(size * value for size, value in weighted) / sum(size for size, _ in weighted)


def _batches(
    tensors: tuple[Tensor, ...], batch_size: int, generator: torch.Generator | None
) -> Iterator[tuple[Tensor, ...]]:
    """The batches of one epoch in random order, or in the data's where there is no generator.

    Indices stay tensors: torch's `DataLoader` takes them as lists of Python, which costs as much
    time as a small network.
    """
    examples = len(tensors[0])
    if generator is None:
        yield from zip(*(each.split(batch_size) for each in tensors), strict=True)
        return
    for index in torch.randperm(examples, generator=generator).split(batch_size):
        yield tuple(each[index] for each in tensors)
