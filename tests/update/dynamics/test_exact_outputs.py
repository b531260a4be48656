"""Filters of nearly exact outputs: variances that rounding would make negative stay positive."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

import retwin as rt
from retwin.twins import State, StateTwin
from retwin.twins.compiled import steps
from retwin.update.dynamics.filter.prediction import Prediction

FORCE = rt.Channels(("force",), ("N",))
POSITION = rt.Channels(("y",), ("m",))
EXACT = 2.0**-80
"""Variance of the measurement noise; states have variances of about 1."""
DOUBLE = StateTwin(
    (State("a"), State("b")),
    lambda x, u: (x.a + 0.5 * x.b,),
    FORCE,
    POSITION,
    10.0,
    step=lambda x, u: (1.25 * x.a + 0.5 * x.b + u.force, 0.75 * x.b),
)


def rational(samples: int) -> list[float]:
    """Variances of the output given all earlier samples, in exact arithmetic."""
    one, half = Fraction(1), Fraction(1, 2)
    spread = [[4 * one, one], [one, 2 * one]]
    forward, h, found = [[Fraction(5, 4), half], [0 * one, Fraction(3, 4)]], [one, half], []
    for _ in range(samples):
        g = [sum(spread[i][j] * h[j] for j in range(2)) for i in range(2)]
        variance = sum(h[i] * g[i] for i in range(2)) + Fraction(EXACT)
        found.append(float(variance))
        spread = [[spread[i][j] - g[i] * g[j] / variance for j in range(2)] for i in range(2)]
        moved = [
            [sum(forward[i][k] * spread[k][j] for k in range(2)) for j in range(2)]
            for i in range(2)
        ]
        spread = [
            [sum(moved[i][k] * forward[j][k] for k in range(2)) for j in range(2)] for i in range(2)
        ]
    return found


def given(samples: int) -> tuple[np.ndarray, ...]:
    commands = np.random.default_rng(0).normal(size=(1, samples, 1))
    measured = DOUBLE.steps().run(commands, np.array([[1.0, 1.0]]))[0]
    spread, variances = np.array([[[4.0, 1.0], [1.0, 2.0]]]), (np.zeros(2), np.array([EXACT]))
    return commands, np.zeros((1, 2)), (measured, np.ones(measured.shape)), spread, variances


@pytest.mark.parametrize("is_compiled", [True, False])
def test_variances_of_the_filter_are_positive(
    is_compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first sample tells one state, the second the other one; then there is only noise."""
    if not is_compiled:
        monkeypatch.setattr(steps, "compiled", lambda source: None)
    mean, covariance, *_ = DOUBLE.steps().filter(*given(30))
    found, exact = covariance.ravel(), np.array(rational(30))
    np.testing.assert_allclose(found[:2], exact[:2], rtol=1e-12)
    assert exact[2:].max() < 100 * EXACT
    assert (found >= EXACT).all(), "no less than the noise of the measurement"
    assert found[2:].max() < 1e-15, "no more than the rounding of 1"
    measured = given(30)[2][0].ravel()
    np.testing.assert_allclose(mean.ravel()[2:], measured[2:], rtol=1e-6)


def test_parameters_that_are_known_to_all_digits_leave_positive_variances() -> None:
    rng, samples = np.random.default_rng(0), 400
    slopes = rng.normal(size=(1, samples, 2, 6))
    noise = np.tile(1e-24 * np.eye(2), (1, samples, 1, 1))
    truth = rng.normal(size=6)
    outputs = rt.Channels(("y", "z"), ("m", "m"))
    record = rt.Trajectories(
        commands=np.zeros((1, samples, 1)),
        nominal=np.zeros((1, samples, 2)),
        observed=slopes @ truth,
        rate=10.0,
        inputs=FORCE,
        outputs=outputs,
    )
    known = Prediction(record, np.zeros((1, samples, 2)), noise, np.zeros((1, samples, 1)))
    found = known.marginal(slopes)
    assert np.linalg.eigvalsh(found.covariance).min() > 0.99e-24
    np.testing.assert_allclose(found.mean[0, 3:], record.observed[0, 3:], rtol=1e-5, atol=1e-6)
    assert found.deviation[0, 3:].max() < 1e-7
