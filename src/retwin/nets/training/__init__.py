"""The one way to train a network: lightning's loop, the best weights, and why it stopped."""

from __future__ import annotations

import logging
import math
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.utils.data import (
    BatchSampler,
    DataLoader,
    RandomSampler,
    SequentialSampler,
    TensorDataset,
)

from retwin.nets.training.settings import Fit, Loss, Training, isolated

__all__ = ["Fit", "Loss", "Training", "isolated", "train"]


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

    from retwin.nets.training.loop import Loop

    steps = math.ceil(len(training_set[0]) / how.batch_size)
    loop = Loop(network, loss, how, steps=steps, progress=progress)
    generator = torch.Generator().manual_seed(seed)
    with isolated(seed), _quiet(), _interruptible():
        trainer = Trainer(
            max_epochs=how.max_epochs,
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
            _loader(training_set, how.batch_size, generator),
            None if validation_set is None else _loader(validation_set, 4 * how.batch_size, None),
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
def _interruptible() -> Iterator[None]:
    """Ctrl-C is a KeyboardInterrupt: lightning would end the process, deaf to the next one."""
    before = signal.getsignal(signal.SIGINT)
    try:
        yield
    except SystemExit as end:
        if not isinstance(end.__context__, KeyboardInterrupt):
            raise
        signal.signal(signal.SIGINT, before)
        raise KeyboardInterrupt from None


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
