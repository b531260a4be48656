"""Corrections inside the state equations of a twin, learned from its outputs alone.

Corrections of outputs and commands are in `retwin.update.corrections`.
"""

from retwin.update.dynamics.discrepancy.curves import Curve
from retwin.update.dynamics.discrepancy.domain import Domain
from retwin.update.dynamics.discrepancy.library import Library
from retwin.update.dynamics.discrepancy.network import TanhNetwork
from retwin.update.dynamics.filter.prediction import Prediction
from retwin.update.dynamics.fitting import FittedDynamics, fit_dynamics
from retwin.update.dynamics.settings import Dynamics
from retwin.update.dynamics.twin import DynamicsTwin
from retwin.update.dynamics.uncorrected import estimate_noise
from retwin.update.dynamics.unknowns import state_names, state_twin_of

__all__ = [
    "Curve",
    "Domain",
    "Dynamics",
    "DynamicsTwin",
    "FittedDynamics",
    "Library",
    "Prediction",
    "TanhNetwork",
    "estimate_noise",
    "fit_dynamics",
    "state_names",
    "state_twin_of",
]
