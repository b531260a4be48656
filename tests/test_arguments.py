"""Public verbs that are given no trajectories."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

import retwin as rt
from retwin.twins import Parameter, State, StateTwin

TWIN: Any = StateTwin(
    (State("x"),),
    lambda x, u: x.x,
    rt.Channels(("u",), ("V",)),
    rt.Channels(("y",), ("m",)),
    20.0,
    derivative=lambda x, u, p: (u.u - p.rate * x.x,),
    parameters=(Parameter("rate", "1/s", 0.1, 9.0, 2.0),),
)
NONE: Any = None


@pytest.mark.parametrize(
    ("argument", "call"),
    [
        ("observed", lambda: rt.update.fit_dynamics(TWIN, NONE)),
        ("observed", lambda: rt.identify(TWIN.parametric(), NONE, seed=0)),
        ("twin", lambda: rt.fit_surrogate(NONE, seed=0)),
        ("calibration", lambda: rt.fit_residual(TWIN, NONE, seed=0)),
        ("trajectories", lambda: rt.fit_diagnoser(NONE, seed=0)),
        ("test", lambda: rt.evaluate(NONE, NONE)),
    ],
)
def test_no_trajectories_are_refused_by_name(argument: str, call: Callable[[], object]) -> None:
    with pytest.raises(rt.InputError, match=f"^{argument}: expected Trajectories, got NoneType"):
        call()
