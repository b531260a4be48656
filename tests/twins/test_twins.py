"""What all built-in twins of the arm have in common, and what sets each apart."""

from __future__ import annotations

import numpy as np
import pytest

import retwin as rt
from retwin.twins.kinematic import ServoLag


@pytest.fixture(params=["kinematic", "emulated", "surrogate", "corrected"])
def twin(request: pytest.FixtureRequest, case: rt.Case) -> rt.Twin:
    if request.param == "kinematic":
        return case.twin
    if request.param == "emulated":
        return case.emulator
    return request.getfixturevalue("ibg" if request.param == "surrogate" else "updated")


def test_satisfies_the_protocol(twin: rt.Twin, case: rt.Case) -> None:
    assert isinstance(twin, rt.Twin)
    commands = case.sampler.sample(3, rng=np.random.default_rng(0))
    faults = [None, case.faults["Motor_2_Stuck"], case.faults["Motor_3_Steady_state_error"]]
    told: list[float] = []
    made = twin.simulate(commands, faults=faults, seed=5, progress=told.append)
    assert told[-1] == 1.0
    np.testing.assert_array_equal(made.commands, commands)
    assert made.labels.tolist() == ["Healthy", "Stuck", "Steady_state_error"]
    assert made.observed.shape == (3, 1000, 3)
    assert np.abs(made.residual[2]).max() > np.abs(made.residual[0]).max() / 2
    again = twin.simulate(commands, faults=faults, seed=5)
    assert made.observed.tobytes() == again.observed.tobytes()
    alone = twin.simulate(commands, seed=5)
    assert alone.labels.tolist() == ["Healthy"] * 3


def test_bad_commands_are_refused(twin: rt.Twin) -> None:
    with pytest.raises(rt.InputError, match=r"commands: expected .* \(n, T, 4\)"):
        twin.simulate(np.zeros((2, 10, 3)), seed=0)
    with pytest.raises(rt.InputError, match="NaN or an infinite value"):
        twin.simulate(np.full((2, 10, 4), np.nan), seed=0)
    with pytest.raises(rt.InputError, match="an actuator from 0 to 3"):
        twin.simulate(np.zeros((1, 10, 4)), faults=[rt.Stuck(7)], seed=0)
    with pytest.raises(rt.InputError, match="one per trajectory"):
        twin.simulate(np.zeros((2, 10, 4)), faults=[None], seed=0)


def test_lag_follows_a_ramp_by_its_seconds() -> None:
    lag = ServoLag(proportional=-0.47, integral=45.0)
    ramp = np.clip(np.arange(400.0) - 10, 0, 300)[None, :, None]
    followed = lag.respond(ramp, rate=100.0)[0, :, 0]
    np.testing.assert_allclose(ramp[0, 200, 0] - followed[200], 100 * lag.seconds, rtol=1e-6)
    np.testing.assert_allclose(followed[-1], 300, atol=1e-6)


def test_lag_is_the_exact_response_to_a_ramp() -> None:
    """Against the closed form of (P s + I) / ((1 + P) s + I) driven by t from t = 0."""
    proportional, integral, rate = -0.3, 38.0, 100.0
    time = np.arange(100) / rate
    decay = np.exp(-integral / (1 + proportional) * time)
    truth = time - (1 - decay) / integral
    got = ServoLag(proportional, integral).respond(time[None, :, None], rate)[0, :, 0]
    np.testing.assert_allclose(got, truth, atol=1e-12)


def test_stuck_joint_stands_exactly_still_in_the_twin(case: rt.Case) -> None:
    commands = np.full((1, 300, 4), 500.0)
    commands[0, :, 1] += np.clip(np.arange(300) - 10, 0, 100)
    made = case.twin.simulate(commands, faults=[rt.Stuck(1)], seed=0)
    assert np.ptp(made.observed[0, 49:], axis=0).max() == 0
    assert np.ptp(made.nominal[0, 49:], axis=0).max() > 0.01


def test_emulated_data_say_so(case: rt.Case, emulated: rt.Trajectories) -> None:
    assert emulated.emulated
    assert not rt.generate(case.twin, case, per_class=1, seed=0).emulated


def test_emulated_readings_are_polled(emulated: rt.Trajectories) -> None:
    """Between polls the path is a straight line: its second difference is 0."""
    bend = np.abs(np.diff(emulated.observed.astype(float), n=2, axis=1)).max(axis=2)
    at_poll = np.arange(1, 999) % 10 == 0
    assert bend[:, ~at_poll & (np.arange(1, 999) < 990)].max() < 1e-6
    assert bend[:, at_poll].max() > 1e-3
