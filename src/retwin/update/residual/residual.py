"""The interface of residual models: draws and the mean of z for a context."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.data.segments import Segments
from retwin.nets.training import Fit
from retwin.serialisation.models import kind_of, refusing
from retwin.update.corrections import Context, Correction
from retwin.update.residual.model import ResidualModel
from retwin.update.residual.sequence import SequenceResidual
from retwin.update.surrogate import Surrogate

__all__ = ["Residual", "load_residual"]


class Residual(Protocol):
    """A fitted residual model, with one z per segment or per sample.

    Attributes
    ----------
    correction : Correction
        The operator g, which defines z.
    segmentation : str
        Rule by which segments are found, see `segment`.
    emulated : bool
        Whether it was fitted to an emulated system instead of the real one.
    timing : NDArray
        (k, M) onsets, in samples, of the segments of the calibration trajectories.
    fitted : Fit or None
        Record of the training.

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
        """The context of commands (n, T, d_u), which the model is conditioned on."""
        ...

    def mean(self, context: Context) -> Tensor:
        """The mean z̄ (n, M, d_z) of Eq. 8, within b."""
        ...

    def sample(self, context: Context, *, generator: torch.Generator) -> Tensor:
        """Draws of z (n, M, d_z), within b."""
        ...

    def save(self, folder: str | Path) -> None:
        """Write the weights and the description."""
        ...


def load_residual(
    folder: str | Path, rate: float | None = None
) -> ResidualModel | SequenceResidual:
    """The residual model that `folder` holds, of either kind; InputError if it holds none."""
    with refusing(folder, expected="a residual model"):
        if kind_of(folder) == "sequence residual":
            return SequenceResidual.load(folder, rate)
        return ResidualModel.load(folder, rate)
