"""Diagnosers: which class does a trajectory belong to?"""

from __future__ import annotations

from retwin.diagnosis.network import NetworkDiagnoser, fit_diagnoser
from retwin.diagnosis.protocol import Diagnoser

__all__ = ["Diagnoser", "NetworkDiagnoser", "fit_diagnoser"]
