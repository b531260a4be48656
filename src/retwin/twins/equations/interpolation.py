"""How commands pass from one sample to the next, and how dead times delay them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from math import ceil, sqrt
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # describing a twin needs no torch, which takes seconds to import
    from torch import Tensor


INTERPOLATIONS = ("hold", "linear", "spline")
"""Held until the next sample, as by a digital-to-analogue converter; straight lines; the natural
cubic spline, for a signal that was band-limited before it was sampled."""
TAPS = 24
"""Number of samples on either side on which a spline's slope depends: the weight of the next is
5e-15 of the nearest one's."""
MAX_TRIED = 100
"""Dead times at most that are tried before a search: a linear step at each takes ms."""


def cubic_coefficients(commands: Tensor, interpolation: str, *, causal: bool = False) -> Tensor:
    """Polynomials c0 + c1 s + c2 s² + c3 s³ of the commands from each sample, s = 0, to the next.

    Parameters
    ----------
    commands : Tensor, shape (n, T, d_u)
        Commands in double precision; a single sample is held.
    interpolation : str
        One of `INTERPOLATIONS`.
    causal : bool
        Whether the polynomial to a sample depends on this and earlier samples alone, as while a
        system runs: a spline then ends there.

    Returns
    -------
    Tensor, shape (n, T, 4, d_u)
        The coefficients, differentiable; the last sample is held.

    """
    import torch

    held, zero = commands[:, :-1], torch.zeros_like(commands[:, 1:])
    rise = commands[:, 1:] - held
    parts = [held, zero, zero, zero]
    if interpolation == "linear":
        parts = [held, rise, zero, zero]
    elif interpolation == "spline":
        if causal:
            first, last = _last_slopes(commands)
        else:
            slopes = _slopes(commands)
            first, last = slopes[:, :-1], slopes[:, 1:]
        parts = [held, first, 3 * rise - 2 * first - last, first + last - 2 * rise]
    end = [commands[:, -1:], *[torch.zeros_like(commands[:, -1:])] * 3]
    return torch.cat([torch.stack(parts, 2), torch.stack(end, 2)], dim=1)


def delayed(commands: Tensor, places: Sequence[int], delays: Tensor, period: float) -> Tensor:
    """Commands after dead times, as straight lines in these.

    After m + f samples, 0 <= f < 1, a command u is (1 - f) u[k - m] + f u[k - m - 1]: of a held one
    the mean over each sample of what then acts, of another one a straight line between whole
    delays. So it is continuous in the delay, and linear between whole numbers of samples, which
    gives its derivative. Before the first sample the command is the first one.

    Parameters
    ----------
    commands : Tensor, shape (n, T, d_u)
        Commands in double precision.
    places : sequence of int
        Indices of the D commands that are delayed, each once.
    delays : Tensor, shape (n, D)
        Their delays in s.
    period : float
        Sample period in s.

    Returns
    -------
    Tensor, shape (n, T, d_u + D)
        With a in place of a delayed command, and its b behind all commands: a + b delay acts.

    """
    import torch

    steps = commands.shape[1]
    whole = (delays.detach() / period).floor().clamp(0, steps)
    index = torch.arange(steps)[:, None] - whole[:, None].long()
    own = commands[..., list(places)]
    now, before = (own.gather(1, (index - back).clamp_min(0)) for back in (0, 1))
    made = commands.clone()
    made[..., list(places)] = now - whole[:, None] * (before - now)
    return torch.cat([made, (before - now) / period], dim=2)


def delays_tried(low: float, high: float, rate: float) -> NDArray:
    """Dead times in s between bounds, a sample apart, or further where those would be too many.

    Errors over a dead time have several minima, as far apart as the commands change.
    """
    return np.linspace(low, high, min(ceil((high - low) * rate) + 1, MAX_TRIED))


def _slopes(commands: Tensor) -> Tensor:
    """The slopes (n, T, d_u), per sample, of the natural cubic spline.

    Slopes d solve d[k-1] + 4 d[k] + d[k+1] = 3 (u[k+1] - u[k-1]). The inverse of the left side is
    a filter with weights z^|j| / (2 sqrt 3), z = sqrt 3 - 2. Odd reflection at the ends makes the
    second derivative 0 there.
    """
    import torch

    steps = commands.shape[1]
    if steps == 1:
        return torch.zeros_like(commands)
    wanted = steps + 2 * (TAPS + 1)
    while commands.shape[1] < wanted:
        more = min(commands.shape[1] - 1, (wanted - commands.shape[1] + 1) // 2)
        before = 2 * commands[:, :1] - commands[:, 1 : more + 1].flip(1)
        after = 2 * commands[:, -1:] - commands[:, -more - 1 : -1].flip(1)
        commands = torch.cat([before, commands, after], dim=1)
    rises = 3 * (commands[:, 2:] - commands[:, :-2])
    weight = 1 / (2 * sqrt(3))
    slopes = weight * rises[:, TAPS : TAPS + steps]
    for j in range(1, TAPS + 1):
        weight *= sqrt(3) - 2
        both = (rises[:, TAPS + sign * j : TAPS + sign * j + steps] for sign in (-1, 1))
        slopes = slopes.add(sum(both), alpha=weight)
    return slopes


def _last_slopes(commands: Tensor) -> list[Tensor]:
    """The last two slopes, each (n, T - 1, d_u), of the splines that end at samples 1 to T - 1.

    Before the first sample the command is the first one.
    """
    import torch

    count = commands.shape[1] - 1
    samples = torch.cat([commands[:, :1].expand(-1, TAPS - 1, -1), commands], dim=1)
    windows = [samples[:, j : j + count] for j in range(TAPS + 1)]
    # Added one after the other: the same bytes for a sample in a record of any length.
    return [
        sum((weight * each for weight, each in zip(row, windows, strict=True)), commands[:, 1:] * 0)
        for row in _last_weights()
    ]


@cache
def _last_weights() -> list[list[float]]:
    """By how much each of the last samples counts in a spline's last two slopes."""
    import torch

    return _slopes(torch.eye(TAPS + 1, dtype=torch.float64)[None])[0, -2:].tolist()
