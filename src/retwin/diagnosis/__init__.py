"""Diagnosers: the probabilities of classes for trajectories.

Belongs here: one file per kind of diagnoser, and what they share. Not here: their scores (see
`scores`) and the comparison of diagnosers (see `study`).
"""

from __future__ import annotations

from retwin.diagnosis.adversarial import fit_dann
from retwin.diagnosis.diagnoser import Diagnoser
from retwin.diagnosis.fine_tuning import fine_tune
from retwin.diagnosis.inversion import Diagnosis, Estimate, InversionDiagnoser, fit_inversion
from retwin.diagnosis.network import NetworkDiagnoser, fit_diagnoser
from retwin.diagnosis.pooled import PooledDiagnoser
from retwin.diagnosis.rocket import RocketDiagnoser, fit_rocket
from retwin.diagnosis.saved import load_diagnoser

__all__ = [
    "Diagnoser",
    "Diagnosis",
    "Estimate",
    "InversionDiagnoser",
    "NetworkDiagnoser",
    "PooledDiagnoser",
    "RocketDiagnoser",
    "fine_tune",
    "fit_dann",
    "fit_diagnoser",
    "fit_inversion",
    "fit_rocket",
    "load_diagnoser",
]
