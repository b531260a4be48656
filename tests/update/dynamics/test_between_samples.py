"""How commands pass between samples, where a twin leaves it open, on systems where it is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import retwin as rt
from retwin.twins import Parameter, State, StateTwin
from retwin.update import Dynamics, Library, fit_dynamics

CUBE = Dynamics(library=Library(degree=3, knots=(), friction=False), memory=False)
OSCILLATOR = StateTwin(
    (State("position", "m"), State("velocity", "m/s")),
    lambda x, u: x.position,
    rt.Channels(("force",), ("N",)),
    rt.Channels(("position",), ("m",)),
    40.0,
    derivative=lambda x, u, p: (
        x.velocity,
        u.force - p.damping * x.velocity - p.stiffness * x.position,
    ),
    parameters=(
        Parameter("stiffness", "N/m", 10.0, 100.0, 40.0),
        Parameter("damping", "N s/m", 0.05, 5.0, 0.6),
    ),
)


def hardening(x, u, p):
    pull = p.stiffness * x.position + 120 * x.position**3
    return x.velocity, u.force - p.damping * x.velocity - pull


def levels(power):
    """Equations of two tanks whose lower one drains by this power of its level."""

    def derivative(x, u, p):
        between = p.upper * x.upper.clamp(min=1e-6) ** 0.5
        return (
            p.pump * u.pump - between,
            between - p.lower * x.lower.clamp(min=1e-6) ** power,
        )

    return derivative


TANKS = StateTwin(
    tuple(State(name, "V", 5.0) for name in ("upper", "lower")),
    lambda x, u: x.lower,
    rt.Channels(("pump",), ("V",)),
    rt.Channels(("level",), ("V",)),
    0.25,
    derivative=levels(0.5),
    parameters=tuple(
        Parameter(name, "1/s", 1e-3, 1.0, 0.05) for name in ("pump", "upper", "lower")
    ),
    substeps=2,
)


def measured(real: StateTwin, commands: np.ndarray, noise: float) -> rt.Trajectories:
    made = real.simulate(commands, seed=0)
    error = noise * np.random.default_rng(1).normal(size=made.observed.shape)
    return made.replace(observed=made.observed + error)


def forces(count: int, samples: int) -> np.ndarray:
    white = np.random.default_rng(0).normal(size=(count, samples))
    kernel = np.hanning(7) / 2
    return 8 * np.apply_along_axis(np.convolve, 1, white, kernel, mode="same")[..., None]


@pytest.mark.slow
def test_commands_are_held_where_they_were_and_the_equations_are_wrong() -> None:
    """The errors of the twin alone would show something else: its equations are wrong."""
    voltage = np.random.default_rng(0).uniform(1, 5, size=(1, 300, 1))
    record = measured(replace(TANKS, derivative=levels(0.42)), voltage, 0.01)
    assert fit_dynamics(TANKS, record, CUBE).twin.equations.interpolation == "hold"


@pytest.mark.slow
def test_a_spline_is_found_behind_wrong_equations_and_a_given_interpolation_is_kept() -> None:
    real = replace(OSCILLATOR, derivative=hardening, interpolation="spline")
    record = measured(real, forces(2, 200), 1e-3)
    fitted = fit_dynamics(OSCILLATOR, record, CUBE)
    assert fitted.twin.equations.interpolation == "spline"
    assert fitted.figures["rms_after"] < 2e-3
    given = fit_dynamics(replace(OSCILLATOR, interpolation="hold"), record, CUBE)
    assert given.twin.equations.interpolation == "hold"
    assert given.figures["rms_after"] > 4e-3
