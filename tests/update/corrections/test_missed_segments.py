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


def ways(context: rt.Context, missed: NDArray) -> NDArray:
    """How far each actuator is from its target when a segment begins, (n, M, d_u)."""
    each, commands = np.arange(len(context))[:, None], context.commands.numpy()
    targets = commands[each, np.ceil(context.segments.settle).astype(int)]
    place, made = commands[:, 0], []
    for m in range(targets.shape[1]):
        made.append(np.abs(targets[:, m] - place))
        place = np.where(missed[:, m], place, targets[:, m])
    return np.stack(made, axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("missed", [0.0, 0.1, 0.5, 0.8, 0.95, 1.0, None])
def test_missed_segments_are_found_however_many(missed: float | None) -> None:
    """Offsets that undo all motions would explain outputs as well, were they what is common."""
    found_, true_, known, covered = [], [], [], []
    for seed in range(2):
        context, z, outputs = record(missed, seed)
        found = rt.CommandSpace().infer(context, outputs, torch.ones(outputs.shape).bool())
        true, seen = z[..., 3:].numpy() > 0.5, found.z[..., 3:].numpy() > 0.5
        # A small motion that is missed is hardly more than an offset.
        clear = ways(context, true) > 0.15
        assert found.identified[..., 3:].numpy()[clear].mean() > 0.97
        assert not found.identified[..., 3:].numpy()[ways(context, seen) < 0.05].any()
        true_.append(true[clear])
        found_.append(seen[clear])
        deviation = found.covariance.diagonal(dim1=-2, dim2=-1).sqrt()[..., 1:3]
        moved = found.identified[..., 1:3] & ~torch.tensor(true)
        covered.append(((found.z - z)[..., 1:3].abs() <= 1.645 * deviation)[moved])
        known.append(moved.sum())
        assert torch.isfinite(found.noise).all()
        assert found.noise.max() < 0.02
    true, seen = np.concatenate(true_), np.concatenate(found_)
    assert (seen == true).mean() > 0.98
    if missed != 1.0:
        assert torch.stack(known).sum() > 0
        assert torch.cat(covered).double().mean() > 0.8


@pytest.mark.parametrize("missed", [0.5, 0.8, 0.95])
def test_missed_segments_do_not_widen_the_range_of_delays(missed: float) -> None:
    for seed in range(3):
        context, _, outputs = record(missed, seed)
        low, high = plausible_delays(context, outputs, torch.ones(outputs.shape).bool())
        assert -10 <= low < 4 < high <= 20


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_range_much_too_wide_for_a_machine_that_hardly_moves(seed: int) -> None:
    """Delays of segments that were missed have no likelihood; steps along them end anywhere."""
    context, _, outputs = record(0.95, seed)
    found = rt.CommandSpace((-6.0, 6.0)).infer(context, outputs, torch.ones(outputs.shape).bool())
    for each in (found.z, found.covariance, found.noise):
        assert torch.isfinite(each).all()
