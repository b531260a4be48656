"""Standard errors from one record, where the model is right and where it is broken."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.signal import lfilter
from toys import AFFINE, commands

import retwin as rt
from retwin.twins import Parameter, ParametricTwin
from retwin.update.identification import LeastSquares, identify
from retwin.update.identification.identifiability import (
    Identifiability,
    correlation_time,
    identifiability,
)

TRUE = np.array([2.0, 0.7, 0.3])
"""Gain of a lag, gain of its rate, and offset."""
BREAKS = ("right", "coloured", "friction", "cubic", "clipped")


def record(kind: str, steps: int, seed: int) -> tuple[NDArray, NDArray]:
    """Derivatives (T, 3) and outputs (T,) of a plant that random steps drive."""
    rng = np.random.default_rng([11, seed])
    command = np.repeat(rng.uniform(-1, 1, steps // 40 + 1), 40)[:steps]
    state = lfilter([0.1], [1, -0.9], command)
    rate, noise = 10 * np.gradient(state), rng.normal(size=steps)
    slopes = np.stack([state, rate, np.ones(steps)], axis=1)
    broken = {
        "right": 0.3 * noise,
        "coloured": lfilter([0.3], [1, -0.9], noise),
        "friction": 0.05 * noise + 0.5 * np.tanh(rate / 0.05),
        "cubic": 0.05 * noise + 0.6 * state**3,
        "clipped": 0.05 * noise,
    }
    outputs = slopes @ TRUE + broken[kind]
    return slopes, np.clip(outputs, -0.8, 0.9) if kind == "clipped" else outputs


def fitted(slopes: NDArray, outputs: NDArray) -> tuple[NDArray, NDArray, Identifiability]:
    """Least squares and the half widths of its 95 % intervals."""
    best = np.linalg.lstsq(slopes, outputs, rcond=None)[0]
    found = identifiability(
        ("a", "b", "c"),
        slopes.reshape(1, -1, 1, 3),
        (slopes @ best - outputs).reshape(1, -1, 1),
        measured=len(outputs),
        width=np.ones(3),
        at_bound=np.zeros(3, dtype=bool),
        alternatives=np.zeros((1, 3)),
    )
    return best, stats.t.ppf(0.975, found.freedom) * found.errors, found


@pytest.mark.parametrize("kind", BREAKS)
def test_intervals_hold_the_value_of_unlimited_data(kind: str) -> None:
    """Of 300 records; without blocks, 0.49 of the gains beside a cubic term are inside."""
    limit = TRUE if kind in ("right", "coloured") else fitted(*record(kind, 400_000, 1))[0]
    inside = np.zeros(3)
    for seed in range(300):
        best, half, _ = fitted(*record(kind, 2000, seed))
        inside += np.abs(best - limit) <= half
    assert (inside / 300 >= 0.90).all(), inside / 300


def test_intervals_are_hardly_wider_where_the_model_is_right() -> None:
    widths = []
    for seed in range(100):
        slopes, outputs = record("right", 2000, seed)
        widths.append(fitted(slopes, outputs)[1] / (1.96 * fitted(slopes, outputs)[2].white))
    assert (np.median(widths, axis=0) < 1.2).all()


def test_persistent_residuals_leave_a_parameter_whose_effect_alternates_determined() -> None:
    """Their effective sample size, by which all errors would be widened, is three."""
    rng = np.random.default_rng(0)
    time = np.arange(3000)
    drift = lfilter([0.01], [1, -0.999], rng.normal(size=3000))
    slopes = np.stack([np.sin(time / 5), np.cos(time / 7), np.ones(3000)], axis=1)
    best, half, found = fitted(slopes, slopes @ TRUE + drift)
    assert correlation_time((slopes @ best - slopes @ TRUE - drift)[None, :, None]) > 500
    assert (half[:2] < 0.05).all()
    assert (np.abs(best - TRUE)[:2] < half[:2]).all()
    assert half[2] > 0.1
    assert found.freedom[2] < found.freedom[0]


def test_copies_of_a_trajectory_count_once() -> None:
    made = AFFINE.with_values({"a": 1.0, "b": -0.5}).simulate(commands(1, seed=0), seed=0)
    noise = 0.3 * np.random.default_rng(0).normal(size=made.observed.shape)
    one = made.replace(observed=made.observed + noise)
    copies = rt.Trajectories.concatenate([one.replace(ids=[str(i)]) for i in range(6)])
    with pytest.warns(UserWarning, match="5 of 6 trajectories are copies"):
        six = identify(AFFINE, copies, LeastSquares(1), seed=0)
    alone = identify(AFFINE, one, LeastSquares(1), seed=0)
    errors = [each.identifiability.errors for each in (six, alone)]
    assert errors[0] == pytest.approx(errors[1], rel=1e-3)
    assert np.isnan(list(six.errors.values())).all()


@pytest.mark.parametrize("records", [1, 6])
def test_outputs_of_unequal_noise_have_errors_of_their_own(records: int) -> None:
    """Under a robust loss, most samples of the noisier output count as outliers."""
    inputs, outputs = rt.Channels(("u",), ("V",)), rt.Channels(("y1", "y2"), ("m", "K"))

    def build(v: dict[str, float]) -> rt.FunctionTwin:
        gains = np.array([v["a"], v["b"]])
        return rt.FunctionTwin(lambda u: u * gains, inputs, outputs, rate=1.0)

    free = [Parameter("a", "m/V", 0.1, 5.0), Parameter("b", "K/V", 0.1, 5.0)]
    twin, found = ParametricTwin.built(build, free), []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        u = rng.normal(size=(records, 1200 // records, 1))
        noise = rng.normal(size=(*u.shape[:2], 2)) * [0.02, 0.2]
        observed = u * [2.0, 1.0] + noise
        record = rt.Trajectories(
            commands=u, nominal=0 * observed, observed=observed, rate=1.0,
            inputs=inputs, outputs=outputs,
        )  # fmt: skip
        it = rt.identify(twin, record, LeastSquares(starts=1), seed=0)
        local = it.identifiability
        half = stats.t.ppf(0.975, local.freedom) * local.errors
        if records > 2:
            half = np.array([np.ptp(it.intervals[name]) / 2 for name in ("a", "b")])
        found.append([*it.values.values(), *half])
    values, halves = np.array(found)[:, :2], np.array(found)[:, 2:]
    inside = np.abs(values - [2.0, 1.0]) <= halves
    assert (inside.mean(axis=0) >= 0.85).all()
    assert (np.median(halves, axis=0) < 4 * values.std(axis=0)).all()
