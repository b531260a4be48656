"""Emulated: a position drive whose twin lacks Coulomb friction and the backlash of its gear.

The command is the reference of the servo, the output the position behind the gear, which follows
only where the motor's shaft has crossed the play. Two records of 60 s calibrate, two test.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import retwin as rt
from retwin.twins import State, StateTwin
from systems.system import System, trajectory

RATE, STEPS, SUBSTEPS = 50.0, 3000, 20
FRICTION, PLAY, NOISE = 30.0, 0.06, 0.004
"""Deceleration by friction in rad/s^2, width of the play and deviation of the noise in rad."""


def derivative(x, u, p):
    return x.speed, p.stiffness * (u.reference - x.angle) - p.damping * x.speed


DRIVE = StateTwin(
    [State("angle", "rad"), State("speed", "rad/s")],
    lambda x, u: x.angle,
    rt.Channels(("reference",), ("rad",)),
    rt.Channels(("angle",), ("rad",)),
    RATE,
    derivative=derivative,
    parameters=(
        rt.Parameter("stiffness", "1/s^2", 10.0, 1000.0, 100.0),
        rt.Parameter("damping", "1/s", 1.0, 100.0, 10.0),
    ),
)


def measured(reference, rng):
    """The angle (n, T) of the real drive behind its gear."""
    angle, speed, load = (np.zeros(len(reference)) for _ in range(3))
    output, step = np.empty(reference.shape), 1 / RATE / SUBSTEPS
    for k in range(reference.shape[1]):
        output[:, k] = load
        for _ in range(SUBSTEPS):
            force = 160.0 * (reference[:, k] - angle) - 14.0 * speed
            free = speed + step * force
            # Friction stops the shaft, but does not turn it.
            speed = np.sign(free) * np.maximum(np.abs(free) - step * FRICTION, 0)
            angle = angle + step * speed
            load = np.clip(load, angle - PLAY / 2, angle + PLAY / 2)
    return output + NOISE * rng.normal(size=output.shape)


def drive(folder: Path) -> System:
    rng = np.random.default_rng(1)
    holds = rng.uniform(-1.5, 1.5, (4, STEPS // 30)).repeat(30, axis=1)
    reference = np.where(np.arange(STEPS) < 25, 0.0, holds)
    records = trajectory(DRIVE, reference, measured(reference, rng), emulated=True)
    tests = {"emulated: friction and backlash": records[2:]}
    return System(DRIVE.parametric(), records[:2], tests, "mrad", 1000.0)


SYSTEMS = {"drive": drive}
