"""Settings of the residual model: family of distributions, encoder, training, refinement."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from torch import nn

from retwin.checks import require, whole
from retwin.nets.flows import FlowHead
from retwin.nets.mixtures import MixtureHead
from retwin.nets.training import Training


@dataclass(frozen=True)
class Refinement:
    """Settings of the fine-tuning on outputs, after the maximum of the likelihood (`refine`).

    Parameters
    ----------
    draws : int
        Simulations of each trajectory from which its energy score is estimated, at least 2.
    training : Training
        Settings of the training; `batch_size` counts trajectories.

    """

    draws: int = 16
    training: Training = Training(  # noqa: RUF009 - frozen
        max_epochs=60, batch_size=8, learning_rate=1e-3, decay="step", patience=15
    )

    def __post_init__(self) -> None:
        whole("draws", self.draws, at_least=2)


@dataclass(frozen=True, kw_only=True)
class Density(ABC):
    """Settings that all families of distributions of z share.

    Parameters
    ----------
    hidden : tuple of int
        Widths of the hidden layers of the encoder of the context.
    dropout : float
        Dropout of the encoder, from 0 to below 1.
    smoothness, boundedness : float
        λ_s and λ_b of Eq. 10, on z̄ in standard units.
    training : Training
        Settings of the training.
    refinement : Refinement or None
        Fine-tuning on outputs afterwards; None for none.

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
        expected = "a number from 0 to below 1"
        got = self.dropout
        remedy = "leave it out for the default"
        require(0 <= self.dropout < 1, "dropout", expected=expected, got=got, remedy=remedy)

    @abstractmethod
    def head(self, features: int, width: int) -> nn.Module:
        """The layer from an encoded context (..., features) to a distribution over (..., width)."""


@dataclass(frozen=True, kw_only=True)
class Mixture(Density):
    """A mixture of Gaussians with full covariance for each block of z (Eq. 6).

    Parameters
    ----------
    components : int
        K of Eq. 6, for each block; at least 1. The other parameters are those of `Density`.

    """

    components: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        whole("components", self.components, at_least=1)

    def head(self, features: int, width: int) -> MixtureHead:
        """The last layer of a mixture density network."""
        return MixtureHead(features, width, self.components)


@dataclass(frozen=True, kw_only=True)
class Flow(Density):
    """A normalising flow for each block of z, instead of a mixture (needs the extra `flows`).

    Parameters
    ----------
    transforms : int
        Autoregressive transformations in series, at least 1.
    bins : int
        Bins of each spline, at least 2. The other parameters are those of `Density`.

    """

    transforms: int = 2
    bins: int = 6

    def __post_init__(self) -> None:
        super().__post_init__()
        whole("transforms", self.transforms, at_least=1)
        whole("bins", self.bins, at_least=2)

    def head(self, features: int, width: int) -> FlowHead:
        """The last layer of a network that predicts a neural spline flow."""
        return FlowHead(features, width, transforms=self.transforms, bins=self.bins)
