"""The one way to train a network: lightning's loop, the best weights, and why it stopped."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import (
    BatchSampler,
    DataLoader,
    RandomSampler,
    SequentialSampler,
    TensorDataset,
)

from retwin.errors import InputError

__all__ = ["Fit", "Training", "isolated", "train"]

Loss = Callable[[Any, tuple[Tensor, ...]], Tensor]
"""Network and batch in, mean loss out."""


@dataclass(frozen=True)
class Training:
    """How to train.

    Parameters
    ----------
    epochs: at most.
    batch: examples per step.
    rate: highest learning rate of AdamW.
    decay: "cosine" rises over a tenth of the steps and falls to nothing (one cycle); "step" starts
        at the full rate and drops tenfold after two thirds of the steps.
    patience: epochs without a better validation loss before it stops; 0 never stops early.
    weight_decay: of AdamW.
    clip: largest norm of a gradient.

    """

    epochs: int = 100
    batch: int = 64
    rate: float = 1e-3
    decay: str = "cosine"
    patience: int = 0
    weight_decay: float = 0.0
    clip: float = 1.0

    def __post_init__(self) -> None:
        if self.decay not in ("cosine", "step") or min(self.epochs, self.batch) < 1:
            raise InputError(
                "training",
                expected="decay 'cosine' or 'step', at least one epoch and one example per batch",
                got=f"decay {self.decay!r}, {self.epochs} epochs, batch {self.batch}",
                remedy="see the parameters of Training",
            )


@dataclass(frozen=True)
class Fit:
    """What a fitted model remembers of its training, saved with it.

    Attributes
    ----------
    figures: what it reached, by name.
    history: losses per epoch, "train" and "validation".
    best_epoch: the epoch whose weights were kept.
    reason: why training stopped.

    """

    figures: dict[str, float]
    history: dict[str, list[float]]
    best_epoch: int
    reason: str

    @classmethod
    def of(cls, values: dict[str, Any] | None) -> Fit | None:
        """From plain JSON values."""
        return None if values is None else cls(**values)


@contextmanager
def isolated(seed: int) -> Iterator[None]:
    """Run with torch's global generator seeded, and leave it as it was.

    Fresh weights and dropout draw from the global generator and take no other.
    """
    with torch.random.fork_rng(devices=[]):
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
    progress: Callable[[float], None] | None = None,
) -> Fit:
    """Train `network` in place on tensors whose first axis is the example; keep the best weights.

    Without a validation set the last weights are kept and nothing stops early. A batch whose loss
    is not finite raises RuntimeError with the epoch, rather than leaving a broken network.
    """
    from lightning.pytorch import Trainer

    from retwin.training_loop import Loop

    steps = math.ceil(len(training_set[0]) / how.batch)
    loop = Loop(network, loss, how, steps=steps, progress=progress)
    generator = torch.Generator().manual_seed(seed)
    with isolated(seed), _quiet():
        trainer = Trainer(
            max_epochs=how.epochs,
            accelerator="auto",
            devices=1,
            logger=False,
            enable_checkpointing=False,
            enable_model_summary=False,
            enable_progress_bar=False,
            num_sanity_val_steps=0,
            gradient_clip_val=how.clip,
        )
        trainer.fit(
            loop,
            _loader(training_set, how.batch, generator),
            None if validation_set is None else _loader(validation_set, 4 * how.batch, None),
        )
    network.cpu()
    if loop.weights is not None:
        network.load_state_dict(loop.weights)
    network.eval()
    return loop.result()


def _loader(
    tensors: tuple[Tensor, ...], batch: int, generator: torch.Generator | None
) -> DataLoader:
    """Whole batches by one index each: example-wise collation would cost more than the network."""
    dataset = TensorDataset(*tensors)
    order = (
        SequentialSampler(dataset)
        if generator is None
        else RandomSampler(dataset, generator=generator)
    )
    return DataLoader(dataset, sampler=BatchSampler(order, batch, drop_last=False), batch_size=None)


@contextmanager
def _quiet() -> Iterator[None]:
    """Lightning's advice on workers and loggers is not for users of this library."""
    loggers = [
        logging.getLogger(name)
        for name in ("lightning.pytorch", "lightning.pytorch.utilities.rank_zero")
    ]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="lightning|pytorch_lightning")
            warnings.filterwarnings("ignore", message=".*(does not have many workers|LeafSpec).*")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
