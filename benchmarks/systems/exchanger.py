"""The steam heat exchanger, DaISy 97-002: from the liquid's flow to its temperature at the outlet.

The first half of the record calibrates, the second half tests. The twin is a first-order lag: as
equations and as a Python function that begins in equilibrium with its first command, each without
and with a dead time.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import retwin as rt
from retwin.twins import State, StateTwin
from systems.system import System, trajectory

RATE = 1.0
WARM_UP = 100.0
"""Duration in s, about four times the lag, in which the start of the second half is forgotten."""
CHANNELS = rt.Channels(("flow",), ("1",)), rt.Channels(("outlet",), ("degC",))
PARAMETERS = (
    rt.Parameter("base", "degC", 80.0, 130.0, 105.0),
    rt.Parameter("gain", "degC", -60.0, 0.0, -20.0),
    rt.Parameter("lag", "s", 2.0, 200.0, 20.0),
)
DEAD_TIME = rt.Parameter("dead_time", "s", 0.0, 20.0, 5.0)


def derivative(x, u, p):
    return ((p.base + p.gain * u.flow - x.outlet) / p.lag,)


def equations(*further: rt.Parameter, **options: Any) -> rt.ParametricTwin:
    return StateTwin(
        [State("outlet", "degC", 98.0, 85.0, 110.0)],
        lambda x, u: x.outlet,
        *CHANNELS,
        RATE,
        derivative=derivative,
        parameters=(*PARAMETERS, *further),
        **options,
    ).parametric()


def lagged(commands: NDArray, base: float, gain: float, lag: float, dead_time: float) -> NDArray:
    """Flows (n, T, 1) to temperatures (n, T, 1)."""
    flow, time = commands[..., 0], np.arange(commands.shape[1]) / RATE
    late = np.stack([np.interp(time - dead_time, time, each) for each in flow])
    steady, share = base + gain * late, 1 - np.exp(-1 / (RATE * lag))
    outlet = steady.copy()
    for k in range(1, len(time)):
        outlet[:, k] = outlet[:, k - 1] + share * (steady[:, k - 1] - outlet[:, k - 1])
    return outlet[..., None]


def build(values: Mapping[str, float]) -> rt.FunctionTwin:
    return rt.FunctionTwin(partial(lagged, **{"dead_time": 0.0} | dict(values)), *CHANNELS, RATE)


def function(*further: rt.Parameter) -> rt.ParametricTwin:
    return rt.ParametricTwin.built(build, (*PARAMETERS, *further))


def exchanger(folder: Path, row: str, twin: rt.ParametricTwin) -> System:
    _, flow, outlet = np.loadtxt(
        folder / "exchanger" / "exchanger.csv", delimiter=",", skiprows=1, unpack=True
    )
    whole = trajectory(twin, flow, outlet)
    first, second = whole.between(0, 2000 / RATE), whole.between(2000 / RATE, 4000 / RATE)
    return System(twin, first, {row: second}, "degC", warm_up=WARM_UP, data="exchanger")


SYSTEMS = {
    "exchanger": lambda folder: exchanger(folder, "exchanger, equations", equations()),
    "exchanger_dead_time": lambda folder: exchanger(
        folder,
        "exchanger, equations with dead time",
        equations(DEAD_TIME, delays={"flow": "dead_time"}),
    ),
    "exchanger_function": lambda folder: exchanger(folder, "exchanger, function", function()),
    "exchanger_function_dead_time": lambda folder: exchanger(
        folder, "exchanger, function with dead time", function(DEAD_TIME)
    ),
}
