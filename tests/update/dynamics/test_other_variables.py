"""An equation that lacks an effect of a variable that it does not have."""

from __future__ import annotations

import numpy as np
import pytest

import retwin as rt
from retwin.twins import Parameter, State, StateTwin
from retwin.update import Dynamics, fit_dynamics

BOTH = rt.Channels(("throttle", "rudder"), ("1", "1"))
SEEN = rt.Channels(("speed", "yaw"), ("m/s", "rad/s"))


def boat(loss: float = 0.0) -> StateTwin:
    """A boat, which loses speed in turns."""
    return StateTwin(
        (State("speed", "m/s", 0.0), State("yaw", "rad/s", 0.0)),
        lambda x, u: (x.speed, x.yaw),
        BOTH,
        SEEN,
        5.0,
        derivative=lambda x, u, p: (
            p.thrust * u.throttle - p.drag * x.speed - loss * x.yaw**2,
            p.turn * u.rudder - x.yaw,
        ),
        parameters=(
            Parameter("thrust", "m/s2", 0.1, 10.0, 1.5),
            Parameter("drag", "1/s", 0.05, 5.0, 0.6),
            Parameter("turn", "rad/s2", 0.1, 10.0, 1.2),
        ),
        interpolation="hold",
    )


def measured(loss: float, seed: int, part: float = 1.0) -> rt.Trajectories:
    """Two records, with commands of a part of their range."""
    rng = np.random.default_rng(seed)
    levels = 0.5 + part * rng.uniform((-0.5, -1.5), (0.5, 0.5), size=(2, 30, 2))
    made = boat(loss).simulate(
        np.repeat(levels, 20, axis=1),
        seed=0,
        parameters={"thrust": 1.2, "drag": 0.5, "turn": 1.0},
    )
    return made.replace(observed=made.observed + 0.005 * rng.normal(size=made.observed.shape))


def error(found: rt.Trajectories, other: rt.Trajectories) -> float:
    return float(np.sqrt(np.mean((found.nominal - other.observed)[..., 0] ** 2)))


@pytest.mark.slow
def test_the_variable_that_an_equation_lacks_is_found() -> None:
    found = fit_dynamics(boat(), measured(0.4, 1))
    assert next(iter(found.terms)) == "speed: yaw^2"
    assert found.parameters["thrust"] == pytest.approx(1.2, rel=0.05)
    other = measured(0.4, 2, 0.8)
    made = found.twin.simulate(other.commands, seed=0)
    assert error(made, other) < 0.007
    closed = Dynamics(depends={"speed": ("speed", "throttle")})
    kept = fit_dynamics(boat(), measured(0.4, 1), closed).twin.simulate(other.commands, seed=0)
    assert error(kept, other) > 3 * error(made, other)


@pytest.mark.slow
def test_a_right_equation_stays_in_its_own_variables() -> None:
    found = fit_dynamics(boat(), measured(0.0, 1))
    assert not any("yaw" in name for name in found.terms if name.startswith("speed: "))
