"""State equations without a correction, as a distribution."""

from __future__ import annotations

import numpy as np

import retwin as rt
from retwin.twins import Parameter, State, StateTwin
from retwin.update.dynamics import estimate_noise
from retwin.update.forecasts import free_moments

NOISE = 0.02
TANK = StateTwin(
    (State("level", "m", low=0.0, high=2.0),),
    lambda x, u: x.level,
    rt.Channels(("pump",), ("V",)),
    rt.Channels(("level",), ("m",)),
    10.0,
    derivative=lambda x, u, p: (u.pump - p.drain * x.level,),
    parameters=(Parameter("drain", "1/s", 0.05, 10.0, 1.3),),
)


def test_parameters_keep_their_values_and_noise_is_that_of_the_records() -> None:
    rng = np.random.default_rng(0)
    commands = np.repeat(rng.uniform(0, 2, size=(2, 30, 1)), 20, axis=1)
    data = TANK.simulate(commands, seed=0, parameters={"start_level": 0.5})
    noisy = data.replace(observed=data.observed + NOISE * rng.normal(size=data.observed.shape))
    found = estimate_noise(TANK, noisy)
    values = dict(zip(found.equations.names, found.values, strict=True))
    assert values["drain"] == 1.3
    np.testing.assert_allclose(np.sqrt(found.noise), NOISE, rtol=0.1)
    drain = list(found.equations.names).index("drain")
    deviation = np.linalg.norm(found.factor[drain])
    assert 1e-4 < deviation < 0.02  # 1200 samples determine it to a few thousandths
    fresh = noisy.replace(observed=data.observed + NOISE * rng.normal(size=data.observed.shape))
    predicted = free_moments(found.started(fresh[[0]]), fresh.commands[[0]])[0]
    assert np.std(fresh.observed[0] - predicted[0]) < 1.2 * NOISE
