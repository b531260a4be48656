"""What every residual model offers: the law of z for a context, drawn or averaged."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.data.segments import Segments
from retwin.nets.training import Fit
from retwin.serialisation.models import kind_of
from retwin.update.corrections import Context, Correction
from retwin.update.residual.model import ResidualModel
from retwin.update.residual.sequence import SequenceResidual
from retwin.update.surrogate import Surrogate

__all__ = ["Residual", "load_residual"]


class Residual(Protocol):
    """A fitted RG, whatever its resolution; see `ResidualModel` and `SequenceResidual`.

    Attributes
    ----------
    correction: what z means.
    segmentation: by which rule movements are found, see `segment`.
    emulated: whether it was fitted to a stand-in for the real system.
    timing: (k, M) onsets in samples that it was calibrated on.
    fitted: what it remembers of its training.

    """

    correction: Correction
    segmentation: str
    emulated: bool
    timing: NDArray
    fitted: Fit | None

    def context(
        self,
        surrogate: Surrogate,
        commands: NDArray,
        segments: Segments | None = None,
        *,
        faulty_commands: NDArray | None = None,
        frozen: NDArray | None = None,
    ) -> Context:
        """What it is called on, for commands (n, T, d_u)."""
        ...

    def mean(self, context: Context) -> Tensor:
        """The mean z̄ (n, M, d_z) of Eq. 8, within b."""
        ...

    def sample(self, context: Context, *, generator: torch.Generator) -> Tensor:
        """Draws of z (n, M, d_z), within b."""
        ...

    def save(self, folder: str | Path) -> None:
        """Write weights and description."""
        ...


def load_residual(folder: str | Path) -> ResidualModel | SequenceResidual:
    """The residual model that was saved there, of either kind; InputError where there is none."""
    if kind_of(folder) == "sequence residual":
        return SequenceResidual.load(folder)
    return ResidualModel.load(folder)
