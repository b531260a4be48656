"""The range of delays: chosen from outputs at any rate, in seconds, and said where it ends."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import retwin as rt
from retwin.update.corrections.delay_range import plausible_delays

MAP = np.array([[1.0, 0.5], [-0.3, 0.8], [0.2, -1.0]])
OPERATORS = (rt.DelayOffset, rt.CommandSpace)
LENGTH, RAMP = 1.5, 0.5
"""Duration of a segment and of its motion, in seconds."""


class Linear(torch.nn.Module):
    """y = A u, a differentiable twin without memory."""

    memoryless = True

    def forward(self, commands: torch.Tensor) -> torch.Tensor:
        return commands @ torch.tensor(MAP.T, dtype=commands.dtype)

    def predict(self, commands: NDArray) -> NDArray:
        return (np.asarray(commands) @ MAP.T).astype(np.float32)


def commands_of(rate: float, count: int, *, segments: int = 5, seed: int = 0) -> NDArray:
    """Ramps of half a second to random targets, and holds, in float64."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(segments * LENGTH * rate)) / rate
    onsets = LENGTH * np.arange(segments) + 0.2
    knots = np.stack([onsets, onsets + RAMP], axis=1).ravel()
    levels = rng.uniform(-1, 1, (count, segments + 1, 2))
    values = np.repeat(levels, 2, axis=1)[:, 1:-1]
    return np.stack([[np.interp(time, knots, u) for u in each.T] for each in values]).swapaxes(1, 2)


def measured(rate: float, delay: float, count: int = 6) -> tuple[rt.Context, torch.Tensor]:
    """Outputs delayed by about `delay` seconds, with offsets and noise."""
    commands = commands_of(rate, count)
    segments = rt.Segments.from_commands(commands)
    context = rt.Context.of(Linear(), commands, segments, rate=rate)
    rng = np.random.default_rng(1)
    shape = segments.start.shape
    z = np.concatenate(
        [
            rate * (delay + rng.normal(0, 0.004, (*shape, 1))),
            rng.normal(0, 0.03, (*shape, 2)),
            np.zeros((*shape, 2)),
        ],
        axis=2,
    )
    outputs = rt.CommandSpace().apply(context, torch.tensor(z)).double()
    return context, outputs + torch.tensor(rng.normal(0, 0.005, outputs.shape))


@pytest.mark.parametrize("rate", [25.0, 100.0, 500.0, 610.0])
@pytest.mark.parametrize("delay", [0.0, 0.03, 0.12, 0.3])
def test_the_range_holds_the_delays_at_any_rate(rate: float, delay: float) -> None:
    context, outputs = measured(rate, delay)
    low, high = plausible_delays(context, outputs, torch.ones(outputs.shape, dtype=torch.bool))
    assert low / rate <= delay - 0.012
    assert delay + 0.012 <= high / rate
    assert high - low <= rate * (3 * delay + 0.2) + 4, "no wider than is needed"


@pytest.mark.slow
@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("rate", [100.0, 500.0])
@pytest.mark.parametrize("delay", [0.03, 0.12, 0.3])
def test_delays_are_found_at_any_rate(operator: type, rate: float, delay: float) -> None:
    context, outputs = measured(rate, delay)
    mask = torch.ones(outputs.shape, dtype=torch.bool)
    found = operator().infer(context, outputs, mask)
    assert not found.at_bound.any()
    np.testing.assert_allclose(found.z[..., 0].mean() / rate, delay, atol=0.004)
    error = (operator().apply(context, found.z) - outputs).square().mean().sqrt()
    assert error < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("operator", OPERATORS)
def test_a_range_that_ends_too_soon_is_said(operator: type) -> None:
    context, outputs = measured(500.0, 0.12)
    mask = torch.ones(outputs.shape, dtype=torch.bool)
    found = operator(delay_range=(-0.01, 0.06)).infer(context, outputs, mask)
    assert found.at_bound.float().mean() > 0.8
    assert found.z[..., 0].max() < 500.0 * 0.06 + 1, "as far as the bound, and not beyond"
    assert not found.identified[..., 0][found.at_bound].any()


@pytest.mark.slow
@pytest.mark.parametrize("operator", OPERATORS)
def test_a_fitted_operator_holds_numbers(operator: type) -> None:
    context, outputs = measured(500.0, 0.12)
    mask = torch.ones(outputs.shape, dtype=torch.bool)
    made = operator().completed(context, outputs, mask)
    low, high = made.delay_range
    assert low < 0.12 < high < 0.5
    assert made.completed(context, outputs, mask) == made
    one, other = (each.infer(context, outputs, mask).z for each in (operator(), made))
    torch.testing.assert_close(one, other)


@pytest.mark.parametrize("bad", [(0.1, 0.1), (0.2, 0.1), (0.0, float("nan"))])
@pytest.mark.parametrize("operator", OPERATORS)
def test_a_range_that_does_not_rise_is_refused(operator: type, bad: tuple[float, float]) -> None:
    with pytest.raises(rt.InputError, match=r"delay_range: expected .* in seconds"):
        operator(delay_range=bad)


def recorded(rate: float, delay: float) -> tuple[rt.Trajectories, Linear]:
    """The same as calibration data, with the twin that they belong to."""
    context, outputs = measured(rate, delay)
    twin = Linear()
    twin.inputs, twin.outputs = rt.Channels.numbered("u", 2), rt.Channels.numbered("y", 3)
    twin.rate = rate
    found = rt.Trajectories(
        commands=context.commands.numpy(),
        nominal=context.nominal.numpy(),
        observed=outputs.float().numpy(),
        rate=rate,
        inputs=twin.inputs,
        outputs=twin.outputs,
        labels=np.full(len(outputs), "Healthy"),
    )
    return found, twin


SHORT = rt.Mixture(components=1, hidden=(4,), training=rt.Training(max_epochs=2, batch_size=32))


@pytest.mark.slow
def test_a_residual_model_holds_the_range_and_says_where_it_ends() -> None:
    record, twin = recorded(500.0, 0.12)
    rg = rt.fit_residual(twin, record, rt.DelayOffset(), SHORT, seed=0)
    low, high = rg.correction.delay_range
    assert low < 0.12 < high
    assert rg.fitted.figures["delays_at_bound"] == 0
    assert "delay_range" not in rg.fitted.reason
    ends = rt.fit_residual(twin, record, rt.DelayOffset((-0.01, 0.06)), SHORT, seed=0)
    assert ends.fitted.figures["delays_at_bound"] > 0.8
    wanted = r"; \d+% of the delays are at a bound of delay_range, give a wider one$"
    assert re.search(wanted, ends.fitted.reason)


def test_samples_in_place_of_seconds_are_refused() -> None:
    record, twin = recorded(100.0, 0.12)
    expected = r"delay_range: expected delays in seconds, shorter than the trajectories of 7\.5 s"
    with pytest.raises(rt.InputError, match=expected):
        rt.fit_residual(twin, record, rt.CommandSpace((-5, 30)), SHORT, seed=0)


def test_delays_of_a_slow_sensor_are_identified() -> None:
    """A tenth of the samples is measured, in motion as at rest."""
    context, outputs = measured(100.0, 0.12)
    mask = torch.zeros(outputs.shape, dtype=torch.bool)
    mask[:, ::10] = True
    found = rt.DelayOffset().infer(context, outputs, mask)
    assert found.identified[..., 0].float().mean() > 0.9
    np.testing.assert_allclose(found.z[..., 0].mean() / 100, 0.12, atol=0.004)
    start, settle = context.segments.start[0, 2], context.segments.settle[0, 2]
    mask[0, int(start) - 1 : int(settle) + 2] = False
    found = rt.DelayOffset().infer(context, outputs, mask)
    assert not found.identified[0, 2, 0]
