"""What training is told, and what it remembers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from retwin.errors import InputError

__all__ = ["Fit", "Loss", "Training", "isolated"]

Loss = Callable[[Any, tuple[Tensor, ...]], Tensor]
"""Network and batch in, mean loss out."""


@dataclass(frozen=True)
class Training:
    """How to train.

    Parameters
    ----------
    max_epochs: at most.
    batch_size: examples per step.
    learning_rate: highest learning rate of AdamW.
    decay: "cosine" rises over a tenth of the steps and falls to nothing (one cycle); "step" starts
        at the full rate and drops tenfold after two thirds of the steps.
    patience: epochs without a better validation loss before it stops; 0 never stops early.
    weight_decay: of AdamW.
    clip: largest norm of a gradient.

    """

    max_epochs: int = 100
    batch_size: int = 64
    learning_rate: float = 1e-3
    decay: str = "cosine"
    patience: int = 0
    weight_decay: float = 0.0
    clip: float = 1.0

    def __post_init__(self) -> None:
        if self.decay not in ("cosine", "step") or min(self.max_epochs, self.batch_size) < 1:
            raise InputError(
                "training",
                expected="decay 'cosine' or 'step', at least one epoch and one example per batch",
                got=f"decay {self.decay!r}, {self.max_epochs} epochs, batch {self.batch_size}",
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
    """Run with torch's global generator seeded and on one thread, and leave both as they were.

    Fresh weights and dropout draw from the global generator and take no other. Networks this small
    lose time with more threads, and their last digits would depend on how many there are.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            yield
    finally:
        torch.set_num_threads(threads)
