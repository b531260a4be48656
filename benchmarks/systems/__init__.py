"""Systems on which every method is judged, real ones and emulated ones; one module for each.

A module has `SYSTEMS`, functions from the folder of the data to a `System`.
"""

from __future__ import annotations

from systems import emps, exchanger, tanks
from systems.system import System

__all__ = ["SYSTEMS", "System"]

SYSTEMS = {**tanks.SYSTEMS, **exchanger.SYSTEMS, **emps.SYSTEMS}
