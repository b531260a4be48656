"""Emulated: a cart without a spring, a double integrator, measured in closed loop.

The controller follows steps of a reference; the log has the force and the position. The track is
not level, and the wind is a force that persists for seconds: both are unknown to the twin, and
neither is white noise in a state. One record of 60 s calibrates, another tests; its start is
inferred from its first 2 s. Models are judged 2 s ahead of the last measurement.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import retwin as rt
from retwin.twins import State, StateTwin
from systems.system import System, trajectory

RATE, STEPS, SUBSTEPS = 20.0, 1200, 10
MASS, NOISE, WIND, PERSISTENCE = 4.0, 0.002, 0.15, 3.0
"""Mass in kg; deviations of the position's noise in m and of the wind in N, its duration in s."""


def derivative(x, u, p):
    return x.speed, u.force / p.mass


CART = StateTwin(
    [State("position", "m", 0.0, -5.0, 5.0), State("speed", "m/s", 0.0, -2.0, 2.0)],
    lambda x, u: x.position,
    rt.Channels(("force",), ("N",)),
    rt.Channels(("position",), ("m",)),
    RATE,
    derivative=derivative,
    parameters=(rt.Parameter("mass", "kg", 0.5, 20.0, 2.5),),
)


def closed_loop(rng) -> tuple[np.ndarray, np.ndarray]:
    """Force and measured position (T,) of one record."""
    reference = rng.uniform(-1, 1, STEPS // 100).repeat(100)
    place, speed, wind, before = rng.uniform(-1, 1), 0.0, 0.0, None
    force, measured = np.empty(STEPS), np.empty(STEPS)
    for k in range(STEPS):
        measured[k] = place + NOISE * rng.normal()
        rate = 0.0 if before is None else (measured[k] - before) * RATE
        before = measured[k]
        force[k] = np.clip(6.0 * (reference[k] - measured[k]) - 7.0 * rate, -4.0, 4.0)
        keep = np.exp(-1 / RATE / PERSISTENCE)
        wind = keep * wind + WIND * np.sqrt(1 - keep**2) * rng.normal()
        for _ in range(SUBSTEPS):
            slope = 0.2 * np.sin(2 * place)  # N, by which a track that is not level pulls
            speed += (force[k] + wind - slope - 0.3 * speed) / MASS / RATE / SUBSTEPS
            place += speed / RATE / SUBSTEPS
    return force, measured


def cart(folder: Path) -> System:
    rng = np.random.default_rng(2)
    calibration, test = (trajectory(CART, *closed_loop(rng), emulated=True) for _ in range(2))
    tests = {"emulated: double integrator in closed loop, 2 s ahead": test}
    return System(CART.parametric(), calibration, tests, "mm", 1000.0, warm_up=2.0, horizon=2.0)


SYSTEMS = {"cart": cart}
