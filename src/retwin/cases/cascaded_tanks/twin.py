"""The tanks: a pump fills the upper of two tanks, which drains into the lower, measured one.

Torricelli's law, with levels in volts of the lower tank's sensor:

    upper' = pump u - upper x^p - over
    lower' = upper x^p + spill over - lower y^q - WEIR max(y - FULL, 0)
    over = WEIR max(x - edge, 0)

with levels x and y. The simple twin has p = q = 1/2 and no overflow. A real outlet may be between
that and laminar flow, where the exponent is 1, and a level need not be counted from the outlet. The
level of the upper tank is hidden; in its unit the upper tank loses as much as the lower one gains.

References
----------
M. Schoukens and J. P. Noël, "Three benchmarks addressing open challenges in nonlinear system
identification", IFAC-PapersOnLine 50 (2017).

"""

from __future__ import annotations

from typing import Any

from retwin.cases.recorded import RecordedCase
from retwin.data.trajectories import HEALTHY, Channels
from retwin.twins.equations.state import State
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.limits import Limits
from retwin.twins.wrappers.parametric import Parameter

INPUTS = Channels(("pump",), ("V",))
OUTPUTS = Channels(("level",), ("V",))
RATE = 0.25
"""Sample rate in Hz: one sample every 4 s, as in the benchmark."""
FULL = 10.0
"""Level of the lower tank in V at which it overflows, where its sensor saturates."""
WEIR = 0.5
"""Overflow in V/s per V above the edge, so high that levels stay close to the edge."""
SUBSTEPS = 2
"""Steps per sample, at which overflow has an error of some mV and the rest of some µV."""


def _power(level: Any, exponent: Any) -> Any:
    """The power of a level; zero, with a finite derivative, for an empty tank."""
    import torch

    wet = level > 0
    return torch.where(wet, torch.where(wet, level, 1.0) ** exponent, 0.0)


def _draining(x: Any, u: Any, p: Any) -> tuple[Any, Any]:
    between = p.upper * _power(x.upper, 0.5)
    return p.pump * u.pump - between, between - p.lower * _power(x.lower, 0.5)


def _overflowing(x: Any, u: Any, p: Any) -> tuple[Any, Any]:
    between = p.upper * _power(x.upper, p.upper_power)
    over = WEIR * (x.upper - p.edge).clamp(min=0)
    out = p.lower * _power(x.lower, p.lower_power) + WEIR * (x.lower - FULL).clamp(min=0)
    return p.pump * u.pump - between - over, between + p.spill * over - out


def _level(x: Any, u: Any) -> Any:
    return x.lower.clamp(min=0)


def _saturated(x: Any, u: Any) -> Any:
    return x.lower.clamp(min=0, max=FULL)


def _levels(highest: float) -> tuple[State, State]:
    """Both levels, the upper one's start at most at `highest`."""
    return State("upper", "V", 14.0431, 0.1, highest), State("lower", "V", 5.1309, 0.1, 10.0)


FLOWS = (
    Parameter("pump", "V/(V s)", 0.005, 0.3, 0.074680),
    Parameter("upper", "V/s", 0.005, 0.3, 0.053939),
    Parameter("lower", "V/s", 0.005, 0.3, 0.089720),
)
"""The inflow per volt on the pump, and the outflow of each tank at a level of 1 V."""

TANKS = StateTwin(
    _levels(15.0),
    _level,
    INPUTS,
    OUTPUTS,
    RATE,
    derivative=_draining,
    parameters=FLOWS,
    substeps=SUBSTEPS,
    limits=Limits((0.0,), (10.0,)),
)
"""The simple twin, fitted by least squares to the benchmark's estimation record. The lower level
determines the upper level and its start only weakly. Starts are the system's own, the same in every
record."""

OVERFLOWING_TANKS = StateTwin(
    _levels(30.0),
    _saturated,
    INPUTS,
    OUTPUTS,
    RATE,
    derivative=_overflowing,
    parameters=(
        *FLOWS,
        Parameter("edge", "V", 2.0, 40.0, 10.0),
        Parameter("spill", "1", 0.0, 1.0, 0.5),
        Parameter("upper_power", "1", 0.25, 1.0, 0.5),
        Parameter("lower_power", "1", 0.25, 1.0, 0.5),
    ),
    substeps=SUBSTEPS,
    limits=Limits((0.0,), (10.0,)),
)
"""The complete physics, before its identification: also the level at which the upper tank
overflows, the fraction of this that falls into the lower tank, and the exponents of both
outflows."""

RECORDED = RecordedCase((HEALTHY,), TANKS)
"""What files of the tanks' trajectories need of their case."""
