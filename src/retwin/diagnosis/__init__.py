"""Diagnosers: the probabilities of classes for trajectories.

Belongs here: one file per kind of diagnoser, those that are trained and those that invert physics,
and what they share. Not here: their scores (see `scores`) and their comparison (see `study`).
"""

from __future__ import annotations

from retwin.diagnosis.conclusion import Conclusion, conclude
from retwin.diagnosis.diagnoser import (
    Diagnoser,
    FittedDiagnoser,
    Method,
    TrainedDiagnoser,
    load_diagnoser,
)
from retwin.diagnosis.estimate import Calibration, Estimate
from retwin.diagnosis.inversion.fitting import fit_inversion
from retwin.diagnosis.inversion.states import StateDiagnosis, StateInversionDiagnoser
from retwin.diagnosis.inversion.trajectories import Diagnosis, InversionDiagnoser
from retwin.diagnosis.trained.adversarial import DANN
from retwin.diagnosis.trained.features import Features
from retwin.diagnosis.trained.fine_tuning import FineTune
from retwin.diagnosis.trained.fitting import Classifier, fit_diagnoser
from retwin.diagnosis.trained.network import NetworkDiagnoser
from retwin.diagnosis.trained.pooled import PooledDiagnoser
from retwin.diagnosis.trained.rocket import Rocket, RocketDiagnoser

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
