"""The incubator: a heater warms the air in a styrofoam box, which loses heat to the room.

    c_heater heater' = POWER u - g_heater (heater - air)
    c_air air' = g_heater (heater - air) - g_box (air - room)

The heater's temperature is hidden. A fan stirs the air. It runs in all records, but for half a
minute at their ends, so that its effect cannot be identified: it is no input.

References
----------
H. Feng, C. Gomes, C. Thule, K. Lausdahl, A. Iosifidis and P. G. Larsen, "Introduction to digital
twin engineering", Annual Modeling and Simulation Conference (2021).

"""

from __future__ import annotations

from typing import Any

from retwin.cases.recorded import RecordedCase
from retwin.data.trajectories import HEALTHY, Channels
from retwin.twins.equations.state import State
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.limits import Limits
from retwin.twins.wrappers.parametric import Parameter

POWER = 100.0
"""Power of the heater in W, assumed: no record has it, and all four parameters are proportional."""


def _derivative(x: Any, u: Any, p: Any) -> tuple[Any, Any]:
    given = p.g_heater * (x.heater - x.air)
    lost = p.g_box * (x.air - u.room)
    return (POWER * u.heater - given) / p.c_heater, (given - lost) / p.c_air


def _output(x: Any, u: Any) -> Any:
    return x.air


INCUBATOR = StateTwin(
    (State("heater", "degC", 75.0, 20.0, 75.0), State("air", "degC", 23.63, 15.0, 65.0)),
    _output,
    Channels(("heater", "room"), ("1", "degC")),
    Channels(("air",), ("degC",)),
    1 / 3,
    derivative=_derivative,
    parameters=(
        Parameter("c_air", "J/K", 20.0, 2000.0, 453.7),
        Parameter("g_box", "W/K", 0.05, 5.0, 0.6554),
        Parameter("c_heater", "J/K", 5.0, 500.0, 30.41),
        Parameter("g_heater", "W/K", 0.05, 20.0, 0.9777),
    ),
    limits=Limits((0.0, 0.0), (1.0, 45.0)),
)
"""The twin, fitted by least squares to the record of 2020-09-18. A switch that is on for a part of
a sample is that share of the heater's power. At the first sample the heater is up to 50 K warmer
than the air, and the fit ends there."""

RECORDED = RecordedCase((HEALTHY,), INCUBATOR)
"""What files of the incubator's trajectories need of their case."""
