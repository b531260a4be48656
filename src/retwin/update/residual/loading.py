"""`load_residual`: a saved residual model of any kind."""

from __future__ import annotations

from pathlib import Path

from retwin.serialisation.models import kind_of, refusing
from retwin.update.residual.model import ResidualModel
from retwin.update.residual.residual import Residual
from retwin.update.residual.sequence import SequenceResidual
from retwin.update.residual.stationary import StationaryResidual

KINDS: dict[str, type[Residual]] = {
    each.kind: each for each in (ResidualModel, SequenceResidual, StationaryResidual)
}


def load_residual(folder: str | Path) -> Residual:
    """The residual model that `folder` holds, of any kind; InputError if it holds none."""
    with refusing(folder, expected="a residual model"):
        return KINDS.get(kind_of(folder), ResidualModel).load(folder)
