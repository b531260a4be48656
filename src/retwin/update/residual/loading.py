"""`load_residual`: a saved residual model of either kind."""

from __future__ import annotations

from pathlib import Path

from retwin.serialisation.models import kind_of, refusing
from retwin.update.residual.model import ResidualModel
from retwin.update.residual.sequence import SequenceResidual


def load_residual(
    folder: str | Path, rate: float | None = None
) -> ResidualModel | SequenceResidual:
    """The residual model that `folder` holds, of either kind; InputError if it holds none.

    `rate` in Hz is for files from before version 0.1.0 only, whose times were in samples.
    """
    sequence = kind_of(folder) == SequenceResidual.kind
    with refusing(folder, expected="a residual model"):
        return (SequenceResidual if sequence else ResidualModel).load(folder, rate)
