"""Friction, saturation and stops: kinks of the equations, whose places are learned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch

import retwin as rt
from retwin.twins import Parameter, State, StateTwin
from retwin.update import FittedDynamics, Library, fit_dynamics

VOLTAGE = rt.Channels(("voltage",), ("V",))
SPEED = rt.Channels(("speed",), ("rad/s",))
TRUTH = {"gain": 8.0, "damping": 3.0}
NOISE = 0.02
"""Standard deviation in rad/s."""


@dataclass(frozen=True)
class Kink:
    """What a real motor has and its twin lacks."""

    friction: float = 0.0
    saturation: float = 100.0
    stop: float = 100.0
    cubic: float = 0.0
    dry: float = 0.0


def motor(kink: Kink = Kink(), substeps: int = 4) -> StateTwin:
    def derivative(x, u, p):
        torque = p.gain * torch.clamp(u.voltage, -kink.saturation, kink.saturation)
        friction = p.damping * x.speed + kink.friction * torch.tanh(x.speed / 0.05)
        more = 40 * torch.relu(x.speed - kink.stop) + kink.cubic * x.speed**3
        net = torque - friction - more
        return (net - torch.clamp(net, -kink.dry, kink.dry),)

    return StateTwin(
        (State("speed", "rad/s", 0.0),),
        lambda x, u: x.speed,
        VOLTAGE,
        SPEED,
        100.0,
        derivative=derivative,
        parameters=(
            Parameter("gain", "rad/s2/V", 1.0, 20.0, 6.0),
            Parameter("damping", "1/s", 0.1, 10.0, 2.5),
        ),
        substeps=substeps,
        interpolation="hold",
    )


def levels(low: float, high: float, count: int, rng: np.random.Generator) -> np.ndarray:
    return np.repeat(rng.uniform(low, high, size=(count, 20, 1)), 30, axis=1)


def fitted(real: StateTwin, low: float, rng: np.random.Generator) -> FittedDynamics:
    made = real.simulate(levels(low, 6.0, 2, rng), seed=0, parameters=TRUTH)
    noise = NOISE * rng.normal(size=made.observed.shape)
    return fit_dynamics(motor(), made.replace(observed=made.observed + noise))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kink", "low", "term"),
    [
        pytest.param(Kink(friction=8.0), -4.0, "sign(speed)", id="friction"),
        pytest.param(Kink(friction=8.0), -1.0, "sign(speed)", id="friction, mostly forward"),
        pytest.param(Kink(saturation=3.3), -6.0, "max(0, voltage - 0.4)", id="saturation"),
        pytest.param(Kink(stop=7.3), -6.0, "max(0, speed - 0.4)", id="stop"),
    ],
)
def test_a_kink_is_learned_where_it_is(kink: Kink, low: float, term: str) -> None:
    """The error of a fresh record is below the noise; terms at fixed places had 0.1 rad/s."""
    rng = np.random.default_rng(1)
    real = motor(kink, substeps=20)
    found = fitted(real, low, rng)
    fresh = real.simulate(levels(0.8 * low, 4.8, 1, rng), seed=0, parameters=TRUTH)
    error = found.twin.simulate(fresh.commands, seed=0).nominal - fresh.observed
    assert np.sqrt(np.mean(error**2)) < 0.75 * NOISE
    assert term in str(list(found.terms)[:3])
    assert abs(found.parameters["gain"] / TRUTH["gain"] - 1) < 0.1


@pytest.mark.slow
def test_dry_friction_is_a_dead_zone_of_the_motion() -> None:
    """Without that term the error was 0.36 rad/s, and the gain 6.3."""
    rng = np.random.default_rng(1)
    real = motor(Kink(dry=4.0), substeps=20)
    found = fitted(real, -6.0, rng)
    fresh = real.simulate(levels(-4.8, 4.8, 1, rng), seed=0, parameters=TRUTH)
    error = found.twin.simulate(fresh.commands, seed=0).nominal - fresh.observed
    assert np.sqrt(np.mean(error**2)) < 2 * NOISE
    assert next(iter(found.terms)) == "speed: dead zone of speed'"
    for name, value in TRUTH.items():
        assert found.parameters[name] == pytest.approx(value, rel=0.03)


@pytest.mark.slow
def test_a_cube_needs_no_hinges() -> None:
    """Hinges and friction beside it would make the parameters uncertain."""
    found = fitted(motor(Kink(cubic=0.04), substeps=8), -6.0, np.random.default_rng(1))
    assert found.form == Library(3, (), False)
    for name, value in TRUTH.items():
        assert abs(found.parameters[name] / value - 1) < 4 * found.errors[name] / value < 0.02


@pytest.mark.slow
def test_the_assumed_error_of_an_exact_twin_is_that_of_its_outputs() -> None:
    """With 0.6 of it, standard errors were a fifth too small."""
    found = fitted(motor(), -6.0, np.random.default_rng(1))
    assert 0.9 < found.figures["strength"] < 1.2
