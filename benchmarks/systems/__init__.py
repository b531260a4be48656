"""Systems on which every method is judged, real ones and emulated ones; one module for each.

A module has `SYSTEMS`, functions from the folder of the data to a `System`.
"""

from __future__ import annotations

from systems import (
    arm,
    cart,
    drive,
    emps,
    exchanger,
    incubator,
    servo_logs,
    silverbox,
    tanks,
    valve,
)
from systems.system import System

__all__ = ["SYSTEMS", "System"]

MODULES = (
    *(arm, tanks, silverbox, incubator, exchanger, emps, servo_logs),
    *(drive, cart, valve),
)
SYSTEMS = {name: load for module in MODULES for name, load in module.SYSTEMS.items()}
