"""Emulated: a level behind a pipe, with dead time and a valve that saturates and is slow.

The twin is a first-order lag with a gain. It lacks the dead time of the pipe, the valve's limits
and its finite speed, and that the outflow is no linear function of the level. Two records of 500 s
calibrate, one tests.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import retwin as rt
from retwin.twins import State, StateTwin
from systems.system import System, trajectory

RATE, STEPS, SUBSTEPS = 4.0, 2000, 4
DEAD_TIME, SPEED, NOISE = 2.3, 0.08, 0.01
"""Dead time in s, speed of the valve in 1/s, deviation of the noise in m."""


def derivative(x, u, p):
    return ((p.gain * u.valve - x.level) / p.lag,)


LEVEL = StateTwin(
    [State("level", "m")],
    lambda x, u: x.level,
    rt.Channels(("valve",), ("1",)),
    rt.Channels(("level",), ("m",)),
    RATE,
    derivative=derivative,
    parameters=(
        rt.Parameter("gain", "m", 0.2, 20.0, 2.0),
        rt.Parameter("lag", "s", 1.0, 100.0, 10.0),
    ),
)


def measured(command, rng):
    """The level (n, T) of the real tank; the valve reaches from 0 to 0.7."""
    opening, level = np.zeros(len(command)), np.zeros(len(command))
    step, output = 1 / RATE / SUBSTEPS, np.empty(command.shape)
    delay = round(DEAD_TIME / step)
    flow = np.zeros((len(command), delay + SUBSTEPS * command.shape[1]))
    for k in range(command.shape[1]):
        output[:, k] = level
        for i in range(k * SUBSTEPS, (k + 1) * SUBSTEPS):
            change = np.clip(command[:, k], 0, 0.7) - opening
            opening = opening + np.clip(change, -step * SPEED, step * SPEED)
            flow[:, delay + i] = opening
            level = np.maximum(level + step * (0.25 * flow[:, i] - 0.12 * np.sqrt(level)), 0)
    return output + NOISE * rng.normal(size=output.shape)


def valve(folder: Path) -> System:
    rng = np.random.default_rng(3)
    command = rng.uniform(0, 1, (3, STEPS // 80)).repeat(80, axis=1)
    records = trajectory(LEVEL, command, measured(command, rng), emulated=True)
    tests = {"emulated: dead time and a saturating valve": records[2:]}
    return System(LEVEL.parametric(), records[:2], tests, "mm", 1000.0)


SYSTEMS = {"valve": valve}
