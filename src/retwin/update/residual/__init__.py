"""Residual Generator (RG), Eq. 6–10: the distribution of the discrepancy z given the commands."""

from __future__ import annotations

from retwin.update.residual.fitting import fit_residual, infer_discrepancy
from retwin.update.residual.loading import load_residual
from retwin.update.residual.model import ResidualModel
from retwin.update.residual.residual import Residual, segment
from retwin.update.residual.sequence import SequenceMixture, SequenceResidual
from retwin.update.residual.settings import Density, Flow, Mixture, Refinement
from retwin.update.residual.stationary import StationaryNoise, StationaryResidual

__all__ = [
    "Density",
    "Flow",
    "Mixture",
    "Refinement",
    "Residual",
    "ResidualModel",
    "SequenceMixture",
    "SequenceResidual",
    "StationaryNoise",
    "StationaryResidual",
    "fit_residual",
    "infer_discrepancy",
    "load_residual",
    "segment",
]
