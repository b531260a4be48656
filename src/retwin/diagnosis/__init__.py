"""Diagnosers: the probabilities of classes for trajectories.

Belongs here: one file per kind of diagnoser, and what they share. Not here: their scores (see
`scores`) and the comparison of diagnosers (see `study`).
"""

from __future__ import annotations

from retwin.diagnosis.adversarial import DANN
from retwin.diagnosis.conclusion import Conclusion, conclude
from retwin.diagnosis.diagnoser import (
    Diagnoser,
    FittedDiagnoser,
    Method,
    TrainedDiagnoser,
    load_diagnoser,
)
from retwin.diagnosis.estimate import Calibration, Estimate
from retwin.diagnosis.features import Features
from retwin.diagnosis.fine_tuning import FineTune
from retwin.diagnosis.fitting import Classifier, fit_diagnoser
from retwin.diagnosis.inversion import Diagnosis, InversionDiagnoser
from retwin.diagnosis.inversion_fitting import fit_inversion
from retwin.diagnosis.network import NetworkDiagnoser
from retwin.diagnosis.pooled import PooledDiagnoser
from retwin.diagnosis.rocket import Rocket, RocketDiagnoser
from retwin.diagnosis.state_inversion import StateDiagnosis, StateInversionDiagnoser

__all__ = [
    "DANN",
    "Calibration",
    "Classifier",
    "Conclusion",
    "Diagnoser",
    "Diagnosis",
    "Estimate",
    "Features",
    "FineTune",
    "FittedDiagnoser",
    "InversionDiagnoser",
    "Method",
    "NetworkDiagnoser",
    "PooledDiagnoser",
    "Rocket",
    "RocketDiagnoser",
    "StateDiagnosis",
    "StateInversionDiagnoser",
    "TrainedDiagnoser",
    "conclude",
    "fit_diagnoser",
    "fit_inversion",
    "load_diagnoser",
]
