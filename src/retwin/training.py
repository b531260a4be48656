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
from torch.utils.data import BatchSampler, DataLoader, RandomSampler, SequentialSampler, TensorDataset

__all__ = ["Fit", "Training", "isolated", "train"]

Loss = Callable[[nn.Module, tuple[Tensor, ...]], Tensor]
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

    steps = max(1, math.ceil(len(training_set[0]) / how.batch))
    module, keeper = _lightning_parts(network, loss, how, steps, progress)
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
            callbacks=[keeper],
        )
        trainer.fit(
            module,
            _loader(training_set, how.batch, generator),
            None if validation_set is None else _loader(validation_set, 4 * how.batch, None),
        )
    network.cpu()
    if keeper.weights is not None:
        network.load_state_dict(keeper.weights)
    network.eval()
    epochs = len(keeper.history["train"])
    best = keeper.best_epoch if keeper.weights is not None else epochs
    reason = (
        f"no better validation loss for {how.patience} epochs"
        if keeper.stopped
        else f"all {epochs} epochs done"
    )
    return Fit({}, keeper.history, best, reason)


def _lightning_parts(
    network: nn.Module,
    loss: Loss,
    how: Training,
    steps: int,
    progress: Callable[[float], None] | None,
) -> tuple:
    """The lightning module and callback, defined here so that importing retwin stays quick."""
    from lightning.pytorch import Callback, LightningModule, Trainer

    class Module(LightningModule):
        def __init__(self) -> None:
            super().__init__()
            self.network = network
            self.train_losses: list[Tensor] = []
            self.valid_losses: list[tuple[Tensor, int]] = []

        def training_step(self, batch: list[Tensor], _: int) -> Tensor:
            value = loss(self.network, tuple(batch))
            if not torch.isfinite(value):
                raise RuntimeError(
                    f"training: the loss is {value.item()} in epoch {self.current_epoch + 1}; "
                    "lower the learning rate or check the data's scale"
                )
            self.train_losses.append(value.detach())
            return value

        def validation_step(self, batch: list[Tensor], _: int) -> None:
            self.valid_losses.append((loss(self.network, tuple(batch)).detach(), len(batch[0])))

        def configure_optimizers(self) -> dict:
            optimiser = torch.optim.AdamW(
                self.network.parameters(), lr=how.rate, weight_decay=how.weight_decay
            )
            total = steps * how.epochs
            if how.decay == "cosine":
                schedule: torch.optim.lr_scheduler.LRScheduler = (
                    torch.optim.lr_scheduler.OneCycleLR(
                        optimiser, how.rate, total, pct_start=0.1, final_div_factor=1000
                    )
                )
            else:
                schedule = torch.optim.lr_scheduler.MultiStepLR(
                    optimiser, [math.ceil(total * 2 / 3)], gamma=0.1
                )
            return {
                "optimizer": optimiser,
                "lr_scheduler": {"scheduler": schedule, "interval": "step"},
            }

    class Keeper(Callback):
        """Keeps history and the best weights, stops early, tells progress."""

        def __init__(self) -> None:
            self.history: dict[str, list[float]] = {"train": [], "validation": []}
            self.weights: dict[str, Tensor] | None = None
            self.best = math.inf
            self.best_epoch = 0
            self.stopped = False

        def on_validation_epoch_end(self, trainer: Trainer, module: LightningModule) -> None:
            total = sum(value.item() * count for value, count in module.valid_losses)
            value = total / sum(count for _, count in module.valid_losses)
            module.valid_losses.clear()
            self.history["validation"].append(value)
            epoch = len(self.history["validation"])
            if value < self.best:
                self.best, self.best_epoch = value, epoch
                self.weights = {k: v.detach().cpu().clone() for k, v in network.state_dict().items()}
            elif how.patience and epoch - self.best_epoch >= how.patience:
                self.stopped = trainer.should_stop = True

        def on_train_epoch_end(self, trainer: Trainer, module: LightningModule) -> None:
            self.history["train"].append(torch.stack(module.train_losses).mean().item())
            module.train_losses.clear()
            if progress is not None:
                progress(1.0 if self.stopped else (trainer.current_epoch + 1) / how.epochs)

    return Module(), Keeper()


def _loader(
    tensors: tuple[Tensor, ...], batch: int, generator: torch.Generator | None
) -> DataLoader:
    """Whole batches by one index each: example-wise collation would cost more than the network."""
    dataset = TensorDataset(*tensors)
    order = (
        SequentialSampler(dataset) if generator is None else RandomSampler(dataset, generator=generator)
    )
    return DataLoader(
        dataset, sampler=BatchSampler(order, batch, drop_last=False), batch_size=None
    )


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
