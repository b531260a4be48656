"""The Silverbox: an electronic circuit that behaves like a mass on a hardening spring.

    x'' = gain (u + offset) - damping x' - stiffness x - square x² - cubic x³
    y = x + feedthrough (u + offset)

The input was band-limited before it was sampled, so it is a spline between samples.

References
----------
T. Wigren and J. Schoukens, "Three free data sets for development and benchmarking in nonlinear
system identification", European Control Conference (2013).

"""

from __future__ import annotations

from typing import Any

from retwin.cases.recorded import RecordedCase
from retwin.data.trajectories import HEALTHY, Channels
from retwin.twins.equations.state import State
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.wrappers.parametric import Parameter


def _derivative(x: Any, u: Any, p: Any) -> tuple[Any, Any]:
    spring = p.stiffness * x.position + p.square * x.position**2 + p.cubic * x.position**3
    return x.velocity, p.gain * (u.input + p.offset) - p.damping * x.velocity - spring


def _output(x: Any, u: Any, p: Any) -> Any:
    return x.position + p.feedthrough * (u.input + p.offset)


SILVERBOX = StateTwin(
    (State("position", "V"), State("velocity", "V/s")),
    _output,
    Channels(("input",), ("V",)),
    Channels(("output",), ("V",)),
    1e7 / 2**14,
    derivative=_derivative,
    parameters=(
        Parameter("gain", "1/s^2", 1e5, 3e5, 187220.0),
        Parameter("damping", "1/s", 10.0, 200.0, 42.695),
        Parameter("stiffness", "1/s^2", 1e5, 3e5, 190770.0),
        Parameter("offset", "V", -0.02, 0.02, -0.0053363),
        Parameter("square", "1/(V s^2)", -2e6, 2e6, 0.0),
        Parameter("cubic", "1/(V^2 s^2)", -2e6, 2e6, 0.0),
        Parameter("feedthrough", "1", -0.2, 0.2, 0.0),
    ),
    interpolation="spline",
    substeps=2,
)
"""The linear twin, fitted by least squares to realisations 1 to 9; all parameters can be freed."""

RECORDED = RecordedCase((HEALTHY,), SILVERBOX)
"""What files of the Silverbox's trajectories need of their case."""
