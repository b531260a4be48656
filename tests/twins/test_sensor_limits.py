"""Outputs between limits: of equations that return them in any form, and of any other twin."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

import retwin as rt
from retwin.twins import State, StateTwin
from retwin.twins.wrappers.sensor_limits import describe_limits, limit_equations, limit_outputs

LIMITS = np.array([[-np.inf, 0.5], [1.0, np.inf]])
LEVEL = rt.Parameter("level", "m", 0.1, 5.0, 1.5)


def twin_of(output) -> StateTwin:
    return StateTwin(
        [State("x", start=0.0), State("y", start=0.0)],
        output,
        rt.Channels(("u",), ("1",)),
        rt.Channels(("first", "second"), ("m", "m")),
        10.0,
        derivative=lambda x, u, p: (p.level * u.u - x.x, u.u - x.y),
        parameters=[LEVEL],
    )


@pytest.mark.parametrize(
    "output",
    [
        lambda x, u: (x.x, x.y),
        lambda x, u: [x.x, x.y],
        lambda x, u: torch.stack([x.x, x.y]),
    ],
)
def test_outputs_of_equations_are_between_limits(output) -> None:
    commands = np.ones((1, 40, 1))
    free = twin_of(output).parametric()
    plain, read = (
        free.simulate(commands, seed=0),
        limit_outputs(free, LIMITS).simulate(commands, seed=0),
    )
    np.testing.assert_array_equal(read.observed, np.clip(plain.observed, *LIMITS))
    assert (plain.observed[..., 0] > 1).any()
    slope = limit_outputs(free, LIMITS).sensitivities(commands, np.array([1.5]))
    assert slope is not None
    assert (slope[0, plain.observed[0, :, 0] > 1, 0] == 0).all()
    assert (slope[0, plain.observed[0, :, 0] < 1, 0][1:] > 0).all()


def test_a_constant_output_stays() -> None:
    twin = limit_equations(twin_of(lambda x, u: (x.x, 0.7)), LIMITS)
    assert (twin.simulate(np.ones((1, 9, 1)), seed=0).observed[..., 1] == 0.7).all()


def test_any_other_twin_is_read_between_limits() -> None:
    def build(values):
        def function(commands):
            return np.concatenate([values["level"] * commands, commands], axis=2)

        outputs = rt.Channels(("first", "second"), ("m", "m"))
        return rt.FunctionTwin(function, rt.Channels(("u",), ("1",)), outputs, 10.0)

    free, commands = rt.ParametricTwin.built(build, [LEVEL]), np.linspace(0, 2, 30)[None, :, None]
    made = limit_outputs(free, LIMITS).simulate(commands, seed=0).observed
    np.testing.assert_array_equal(made, np.clip(free.simulate(commands, seed=0).observed, *LIMITS))


def test_without_limits_the_twin_is_the_same() -> None:
    none, twin = np.array([[-np.inf] * 2, [np.inf] * 2]), twin_of(lambda x, u: (x.x, x.y))
    free = twin.parametric()
    assert limit_equations(twin, none) is twin
    assert limit_outputs(free, none) is free
    assert describe_limits(("first", "second"), none) == ""
    text = describe_limits(("first", "second"), LIMITS)
    assert text.startswith("first never above 1, second never below 0.5: taken for limits")


@pytest.mark.parametrize("method", ["dynamics", "output"])
def test_a_fitted_model_reads_as_its_sensor_after_it_is_saved(method: str, tmp_path) -> None:
    rng, twin = np.random.default_rng(0), one_state()
    commands = rng.uniform(0, 2, (3, 20, 1)).repeat(15, axis=1)
    made = twin.parametric().with_values([2.0]).simulate(commands, seed=0)
    limit = float(np.quantile(made.observed, 0.7))
    noisy = made.observed + 0.01 * rng.normal(size=made.observed.shape)
    records = made.replace(observed=np.minimum(noisy, limit), labels=["Healthy"] * 3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of limits, which the remarks name too
        found = rt.fit(twin, records, rt.Choice(method=method, compare=False), seed=0)
    assert any(f"first never above {limit:.6g}" in each for each in found.remarks)
    assert found.parameters["level"][2] == pytest.approx(2.0, rel=0.02)
    found.twin.save(tmp_path / "model")
    again = type(found.twin).load(tmp_path / "model")
    first, second = (each.simulate(commands, seed=1) for each in (found.twin, again))
    np.testing.assert_array_equal(first.observed, second.observed)
    error = np.abs(first.observed - np.minimum(made.observed, limit))
    assert np.sqrt(np.mean(error**2)) < 0.05


def one_state() -> StateTwin:
    return StateTwin(
        [State("x", start=0.0)],
        lambda x, u: x.x,
        rt.Channels(("u",), ("1",)),
        rt.Channels(("first",), ("m",)),
        10.0,
        derivative=lambda x, u, p: (p.level * u.u - x.x,),
        parameters=[LEVEL],
    )
