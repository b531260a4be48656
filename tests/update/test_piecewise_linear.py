"""Interpolation along linear pieces equals evaluation sample by sample, at less cost."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from retwin.twins.commands.samplers import HoldSampler, MultisineSampler, RampSampler
from retwin.update.piecewise_linear import evaluate_piecewise_linear

pytestmark = pytest.mark.numerical

LOW, HIGH = (100.0, -3.0), (900.0, 2.0)
TIMES = (100.0, 10.0)
"""Rate in Hz and duration in s of commands."""
SMALL = 5e-6
"""For outputs of size 1: a few roundings of commands and outputs in single precision."""


def smooth(rows: Tensor) -> Tensor:
    """A function like that of an arm: from two angles to a position."""
    a, b = rows[:, 0] / 250.0, rows[:, 1]
    return torch.stack([a.cos() + (a + b).cos(), a.sin() * b.sin(), torch.tanh(a - b)], dim=1)


class Counted:
    """Counts evaluations."""

    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        self.function, self.evaluations = function, 0

    def __call__(self, rows: Tensor) -> Tensor:
        self.evaluations += len(rows)
        return self.function(rows)


def both(
    function: Callable[[Tensor], Tensor], commands: np.ndarray | Tensor
) -> tuple[float, float]:
    """Largest difference from evaluation at each sample, and evaluations per sample."""
    commands = torch.as_tensor(commands)
    counted = Counted(function)
    found = evaluate_piecewise_linear(counted, commands)
    one_by_one = function(commands.flatten(0, 1)).view(*commands.shape[:2], -1)
    assert found.shape == one_by_one.shape
    return float((found - one_by_one).abs().max()), counted.evaluations / commands[..., 0].numel()


@pytest.mark.parametrize("jitter", [False, True])
def test_ramps_take_a_part_of_the_evaluations(jitter: bool) -> None:
    rng = np.random.default_rng(0)
    onsets = np.sort(rng.uniform(0, 9, (20, 5)), axis=1) if jitter else None
    commands = RampSampler(LOW, HIGH, *TIMES, 5).sample(50, rng=rng, onsets=onsets)
    error, share = both(smooth, commands)
    assert error < SMALL
    assert share < 0.2


def test_a_hold_takes_one_evaluation() -> None:
    commands = HoldSampler(LOW, HIGH, *TIMES, (0.5, 2.0)).sample(20, rng=np.random.default_rng(0))
    error, share = both(smooth, commands)
    assert error < SMALL
    assert share < 0.1


def test_curves_are_evaluated_sample_by_sample() -> None:
    commands = MultisineSampler(LOW, HIGH, *TIMES, (0.1, 6.0), 2.0).sample(
        5, rng=np.random.default_rng(0)
    )
    error, share = both(smooth, commands)
    assert error < SMALL
    assert share == pytest.approx(1, abs=0.1)


def test_a_curve_so_slow_that_no_single_sample_shows_it() -> None:
    time = torch.linspace(0, 1, 4000)[None, :, None]
    commands = (700 + 0.05 * time * (1 - time)).expand(-1, -1, 2).float()
    turn = commands.diff(dim=1).diff(dim=1).abs().max()
    assert turn < 4 * torch.finfo(torch.float32).eps * 700, "each sample alone looks straight"
    ends = commands[:, [0, -1]]
    assert torch.equal(ends[:, 0], ends[:, 1]), "as if held"

    def steep(rows: Tensor) -> Tensor:
        return 100 * (rows - 700)

    error, share = both(steep, commands)
    assert error == 0
    assert share > 0.99


def test_a_function_with_a_corner_is_evaluated_sample_by_sample() -> None:
    commands = RampSampler(LOW, HIGH, *TIMES, 5).sample(20, rng=np.random.default_rng(0))

    def corner(rows: Tensor) -> Tensor:
        return (rows[:, :1] / 400 - 1.2).abs() + (rows[:, 1:] > 0)

    error, share = both(corner, commands)
    assert error < 1e-5  # the last two coefficients show a corner unless it is tiny
    assert 0.2 < share < 1


def test_what_is_not_finite_stays_where_it_is() -> None:
    commands = torch.full((3, 50, 2), 5.0)
    commands[1, 20, 0] = torch.nan
    commands[2, 30, 1] = torch.inf
    found = evaluate_piecewise_linear(lambda rows: rows.sum(dim=1, keepdim=True), commands)
    assert torch.equal(found.isfinite()[..., 0], commands.isfinite().all(dim=-1))


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_short(steps: int) -> None:
    commands = torch.arange(4.0 * steps).view(2, steps, 2)
    assert both(smooth, commands)[0] < SMALL


def test_each_trajectory_for_itself() -> None:
    commands = RampSampler(LOW, HIGH, *TIMES, 5).sample(8, rng=np.random.default_rng(1))
    commands[3:] *= 1e3  # others of another size must not change what counts as straight
    together = evaluate_piecewise_linear(smooth, torch.as_tensor(commands))
    apart = torch.cat(
        [evaluate_piecewise_linear(smooth, torch.as_tensor(each[None])) for each in commands]
    )
    torch.testing.assert_close(together[:3], apart[:3], rtol=0, atol=SMALL)


@given(
    levels=st.lists(
        st.tuples(st.floats(-900, 900, width=32), st.integers(1, 90)), min_size=1, max_size=12
    ),
    double=st.booleans(),
)
def test_any_polyline(levels: list[tuple[float, int]], double: bool) -> None:
    ends = np.cumsum([0] + [span for _, span in levels])
    path = np.interp(np.arange(ends[-1] + 1), ends, [0.0] + [level for level, _ in levels])
    commands = np.stack([path, path[::-1] / 300], axis=1)[None]
    error, _ = both(smooth, commands if double else commands.astype(np.float32))
    assert error < SMALL
