"""Records compared with the twin that they are for."""

from __future__ import annotations

import numpy as np
import pytest

import retwin as rt
from retwin.twins import Parameter, State, StateTwin
from retwin.update.agreement import check_with_twin


@pytest.mark.parametrize("diverges", [True, False])
@pytest.mark.parametrize("exchanged", [True, False])
def test_exchanged_commands_are_named_where_the_twin_then_explains_more(
    *, exchanged: bool, diverges: bool
) -> None:
    # With a fan beyond 1 the output grows until its square overflows: that explains nothing.
    growth = 2.0 if diverges else -1.0
    twin = StateTwin(
        (State("rest", "degC", low=-20.0, high=20.0), State("air", "degC", 0.0)),
        lambda x, u: x.air + x.rest - 0.2 * u.outdoor,
        rt.Channels(("fan", "outdoor"), ("1", "degC")),
        rt.Channels(("air",), ("degC",)),
        1.0,
        derivative=lambda x, u, p: (
            -x.rest,
            np.where(u.fan > 1, growth, -1.0) * x.air + p.gain * u.fan,
        ),
        parameters=(Parameter("gain", "degC", 0.0, 10.0, 5.0),),
    ).parametric()
    rng = np.random.default_rng(0)
    fan = rng.integers(0, 2, size=(2, 200, 1)).astype(float)
    commands = np.concatenate([fan, rng.uniform(10, 26, size=fan.shape)], axis=2)
    data = twin.simulate(commands, seed=0)
    noisy = data.replace(observed=data.observed + 1.5 * rng.normal(size=data.observed.shape))
    given = noisy.replace(commands=commands[..., ::-1]) if exchanged else noisy
    kinds = {each.kind for each in check_with_twin(twin, given).findings}
    assert ("exchanged" in kinds) == (exchanged and not diverges)
