"""A tank whose outflow is larger than its twin's, and records of it."""

from __future__ import annotations

import numpy as np

import retwin as rt
from retwin.twins import Parameter, State, StateTwin

TANK = StateTwin(
    (State("level", "m", 0.5, 0.0, 3.0),),
    lambda x, u: x.level,
    rt.Channels(("pump",), ("V",)),
    rt.Channels(("level",), ("m",)),
    1.0,
    derivative=lambda x, u, p: (0.1 * u.pump - p.drain * x.level,),
    parameters=(Parameter("drain", "1/s", 0.01, 1.0, 0.1),),
)


def recorded(
    seed: int, fault: rt.Fault | None = None, count: int = 1, *, steps: int = 400
) -> rt.Trajectories:
    """Records of the emulated machine, with noise of 0.01 m."""
    rng = np.random.default_rng(seed)
    pump = np.repeat(rng.uniform(0.0, 2.0, size=(count, steps // 20, 1)), 20, axis=1)
    made = TANK.simulate(pump, faults=[fault] * count, seed=0, parameters={"drain": 0.13})
    return made.replace(observed=made.observed + 0.01 * rng.normal(size=made.observed.shape))
