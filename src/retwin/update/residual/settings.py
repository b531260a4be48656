"""How the residual model looks and learns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from torch import nn

from retwin.errors import InputError
from retwin.nets.flows import FlowHead
from retwin.nets.mixtures import MixtureHead
from retwin.nets.training import Training

__all__ = ["DENSITIES", "Density", "Flow", "Mixture", "Refinement"]


@dataclass(frozen=True)
class Refinement:
    """Fine-tuning of the RG on outputs, after its likelihood: see `refining`.

    Parameters
    ----------
    draws: simulations of each trajectory that an energy score is estimated from.
    training: epochs, rate, patience; a batch is so many trajectories.

    """

    draws: int = 16
    training: Training = Training(  # noqa: RUF009 - frozen
        max_epochs=60, batch_size=8, learning_rate=1e-3, decay="step", patience=15
    )

    def __post_init__(self) -> None:
        if self.draws < 2:
            raise InputError(
                "draws", expected="at least 2", got=repr(self.draws), remedy="16 serve well"
            )


@dataclass(frozen=True, kw_only=True)
class Density(ABC):
    """What all residual models share: an encoder of the context, and how it learns.

    Parameters
    ----------
    hidden: widths of the shared encoder.
    dropout: of the encoder.
    smoothness, boundedness: λ_s and λ_b of Eq. 10, on z in standard units.
    training: epochs, rate, patience.
    refinement: fine-tuning on outputs afterwards; None leaves it.

    """

    hidden: tuple[int, ...] = (32,)
    dropout: float = 0.3
    smoothness: float = 0.01
    boundedness: float = 1.0
    training: Training = Training(  # noqa: RUF009 - frozen
        max_epochs=300,
        batch_size=64,
        learning_rate=3e-3,
        decay="step",
        patience=40,
        weight_decay=1e-2,
    )
    refinement: Refinement | None = None

    def __post_init__(self) -> None:
        self._check("dropout", self.dropout, 0 <= self.dropout < 1, "from 0 to below 1")

    @staticmethod
    def _check(name: str, value: object, sound: bool, expected: str) -> None:
        if not sound:
            raise InputError(
                name, expected=expected, got=repr(value), remedy="leave it out for the default"
            )

    @abstractmethod
    def head(self, features: int, width: int) -> nn.Module:
        """From an encoded context (..., features) to a law of `width` components of z."""


@dataclass(frozen=True, kw_only=True)
class Mixture(Density):
    """A mixture of Gaussians with full covariance for each block of z (Eq. 6).

    Parameters
    ----------
    components: K of Eq. 6, for each head.

    The others are those of `Density`.

    """

    components: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check("components", self.components, self.components >= 1, "at least 1")

    def head(self, features: int, width: int) -> MixtureHead:
        """A mixture density head."""
        return MixtureHead(features, width, self.components)


@dataclass(frozen=True, kw_only=True)
class Flow(Density):
    """A normalising flow for each block of z, instead of a mixture (needs the extra `flows`).

    Parameters
    ----------
    transforms: autoregressive transformations in series.
    bins: of the splines in them.

    The others are those of `Density`.

    """

    transforms: int = 2
    bins: int = 6

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check("transforms", self.transforms, self.transforms >= 1, "at least 1")
        self._check("bins", self.bins, self.bins >= 2, "at least 2")

    def head(self, features: int, width: int) -> FlowHead:
        """A head of neural splines."""
        return FlowHead(features, width, transforms=self.transforms, bins=self.bins)


DENSITIES: tuple[type, ...] = (Mixture, Flow, Refinement, Training)
"""Those that a model folder may name, and their parts."""
