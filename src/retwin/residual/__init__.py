"""Residual Generator (RG), Eq. 6–10: the distribution of the gap z, given what was commanded."""

from __future__ import annotations

from retwin.residual.fitting import fit_residual, infer_discrepancy
from retwin.residual.model import ResidualModel, segment
from retwin.residual.protocol import Residual, load_residual
from retwin.residual.sequence import SequenceMixture, SequenceResidual
from retwin.residual.settings import Density, Flow, Mixture, Refinement

__all__ = [
    "NAMED_DENSITIES",
    "Density",
    "Flow",
    "Mixture",
    "Refinement",
    "Residual",
    "ResidualModel",
    "SequenceMixture",
    "SequenceResidual",
    "fit_residual",
    "infer_discrepancy",
    "load_residual",
    "segment",
]

NAMED_DENSITIES: dict[str, Density | SequenceMixture] = {
    "mixture": Mixture(),
    "flow": Flow(),
    "sequence_mixture": SequenceMixture(),
}
"""Those that the command line knows by name."""
