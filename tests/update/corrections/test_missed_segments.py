"""Machines whose actuators miss segments: a few, most of them, or all."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from test_extreme_records import RATE, Plane, commands_of

import retwin as rt
from retwin.update.corrections.delay_range import plausible_delays

pytestmark = pytest.mark.numerical


def record(missed: float | None, seed: int) -> tuple[rt.Context, torch.Tensor, torch.Tensor]:
    """The context, z and outputs if so many segments are missed; None for all of one actuator."""
    commands, rng = commands_of(8, seed=seed), np.random.default_rng(seed)
    segments = rt.Segments.from_commands(commands)
    context = rt.Context.of(Plane(), commands, segments, rate=RATE)
    shape = segments.start.shape
    flags = np.zeros((*shape, 2))
    if missed is None:
        flags[..., 0] = 1.0
    else:
        flags[rng.random(flags.shape) < missed] = 1.0
    parts = rng.normal(4, 0.2, (*shape, 1)), rng.normal(0, 0.03, (*shape, 2)), flags
    z = torch.tensor(np.concatenate(parts, axis=-1))
    outputs = rt.CommandSpace().apply(context, z).double()
    return context, z, outputs + 0.005 * torch.tensor(rng.normal(size=outputs.shape))


@pytest.mark.parametrize("missed", [0.5, 0.8, 0.95])
def test_missed_segments_do_not_widen_the_range_of_delays(missed: float) -> None:
    for seed in range(3):
        context, _, outputs = record(missed, seed)
        low, high = plausible_delays(context, outputs, torch.ones(outputs.shape).bool())
        assert -10 <= low < 4 < high <= 20
