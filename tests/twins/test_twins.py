"""The closed-form twin; the contract of all twins is in tests/testing."""

from __future__ import annotations

import numpy as np

import retwin as rt
from retwin.cases.armpi_fpv.twin import KINEMATIC, ServoLag


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


def test_stuck_joint_stands_exactly_still() -> None:
    commands = np.full((1, 300, 4), 500.0)
    commands[0, :, 1] += np.clip(np.arange(300) - 10, 0, 100)
    made = KINEMATIC.simulate(commands, faults=[rt.Stuck(1)], seed=0)
    assert np.ptp(made.observed[0, 49:], axis=0).max() == 0
    assert np.ptp(made.nominal[0, 49:], axis=0).max() > 0.01
