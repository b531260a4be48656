"""The lightning module behind `train`; apart, so that retwin imports without lightning."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torch.optim.lr_scheduler import LRScheduler, MultiStepLR, OneCycleLR

from retwin.nets.training.settings import Fit, Loss, Training

__all__ = ["Loop"]


WARM = 0.1001
"""Share of steps in which the rate rises. A tenth of ten steps would leave torch nothing to divide
by."""


class Loop(LightningModule):
    """Trains a network; keeps history and the best weights, stops early, tells progress."""

    def __init__(
        self,
        network: nn.Module,
        loss: Loss,
        how: Training,
        *,
        steps: int,
        progress: Callable[[float], None] | None,
    ) -> None:
        super().__init__()
        self.network = network
        self.loss = loss
        self.how = how
        self.steps = steps
        self.progress = progress
        self.history: dict[str, list[float]] = {"train": [], "validation": []}
        self.weights: dict[str, Tensor] | None = None
        self.best_epoch = 0
        self.stopped = False
        self._best = math.inf
        self._train_losses: list[Tensor] = []
        self._valid_losses: list[tuple[float, int]] = []

    def training_step(self, batch: list[Tensor], _: int) -> Tensor:
        """One step; a loss that is not finite ends training."""
        value = self.loss(self.network, tuple(batch))
        if not torch.isfinite(value):
            raise RuntimeError(
                f"training: the loss is {value.item()} in epoch {self.current_epoch + 1}; "
                "lower the learning rate or check the data's scale"
            )
        self._train_losses.append(value.detach())
        return value

    def validation_step(self, batch: list[Tensor], _: int) -> None:
        """The loss on one batch that is held out."""
        value = self.loss(self.network, tuple(batch))
        self._valid_losses.append((value.item(), len(batch[0])))

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """AdamW, its rate decayed as the training says."""
        how = self.how
        optimiser = torch.optim.AdamW(
            self.network.parameters(),
            lr=how.learning_rate,
            weight_decay=how.weight_decay,
            fused=True,
        )
        total = self.steps * how.max_epochs
        schedule: LRScheduler
        if how.decay == "cosine":
            schedule = OneCycleLR(
                optimiser, how.learning_rate, total, pct_start=WARM, final_div_factor=1000
            )
        else:
            schedule = MultiStepLR(optimiser, [math.ceil(total * 2 / 3)], gamma=0.1)
        return {
            "optimizer": optimiser,
            "lr_scheduler": {"scheduler": schedule, "interval": "step"},
        }

    def on_validation_epoch_end(self) -> None:
        """Keep the weights if they are the best so far; stop when none were for long enough."""
        count = sum(examples for _, examples in self._valid_losses)
        value = sum(loss * examples for loss, examples in self._valid_losses) / count
        self._valid_losses.clear()
        self.history["validation"].append(value)
        epoch = len(self.history["validation"])
        if value < self._best:
            self._best, self.best_epoch = value, epoch
            state = self.network.state_dict()
            self.weights = {name: each.detach().cpu().clone() for name, each in state.items()}
        elif self.how.patience and epoch - self.best_epoch >= self.how.patience:
            self.stopped = self.trainer.should_stop = True

    def on_train_epoch_end(self) -> None:
        """Note the loss and tell progress."""
        self.history["train"].append(torch.stack(self._train_losses).mean().item())
        self._train_losses.clear()
        if self.progress is not None:
            done = (self.current_epoch + 1) / self.how.max_epochs
            self.progress(1.0 if self.stopped else done)

    def result(self) -> Fit:
        """What the trained model remembers of this."""
        epochs = len(self.history["train"])
        best = self.best_epoch if self.weights is not None else epochs
        patience = f"no better validation loss for {self.how.patience} epochs"
        reason = patience if self.stopped else f"all {epochs} epochs done"
        return Fit({}, self.history, best, reason)
