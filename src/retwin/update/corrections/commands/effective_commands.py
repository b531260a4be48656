"""T_z(u) of `CommandSpace`: the effective commands, those that the actuators executed."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from retwin.data.segments import Segments
from retwin.update.corrections.delays import Knots, gather_samples, interpolate
from retwin.update.kernels.generation import effective_commands_at

STILL = 1e-6
"""Largest change of a command, relative to its size, that counts as no change: rounding."""


def effective_commands(
    reference: Tensor,
    segments: Segments,
    z: Tensor,
    times: Tensor,
    frozen: Tensor | None = None,
    own_delays: Tensor | None = None,
) -> Tensor:
    """The effective commands T_z(u) at some times.

    Parameters
    ----------
    reference : Tensor
        (n, T, d_u), the commands that were sent, faults on them included; or (n / r, T, d_u), where
        each row serves r successive rows of the other arguments.
    segments : Segments
        M at most.
    z : Tensor
        (n, M, 1 + 2 d_u): delay in samples, offset of every actuator in its command's unit, missed
        for every actuator, which may lie between 0 and 1.
    times : Tensor
        (S,) or (n, S), in samples, fractions allowed.
    frozen : Tensor, optional
        (n, d_u), the sample from which a fault holds an actuator; by default it holds none.
    own_delays : Tensor, optional
        (n, M, d_u), delay of every actuator besides the common one, in samples; by default none.

    Returns
    -------
    Tensor
        (n, S, d_u), differentiable in z.

    """
    times = times.to(z.dtype).expand(len(z), -1)
    if own_delays is not None:
        # No actuator's command depends on another's: each is computed as a system of one actuator.
        width = own_delays.shape[-1]
        delay, offset, missed = z.split([1, width, width], dim=-1)
        parts = torch.stack([delay + own_delays, offset, missed], dim=-1)
        columns = []
        for i, one in ((i, slice(i, i + 1)) for i in range(width)):
            held = None if frozen is None else frozen[:, one]
            given = reference[..., one], segments, parts[:, :, i], times, held
            columns.append(effective_commands(*given))
        return torch.cat(columns, dim=-1)
    if frozen is None:
        return _moving(reference, segments, z, times)
    made = effective_commands_at(reference, segments, z, times, frozen)
    if made is not None:
        return made
    since = frozen.to(z.dtype)
    moving = _moving(reference, segments, z, torch.cat([times, since], dim=1))
    free, stopped = moving.split([times.shape[1], reference.shape[2]], dim=1)
    held = stopped.diagonal(dim1=1, dim2=2)
    return torch.where(times[..., None] < since[:, None], free, held[:, None])


def command_jacobians(
    executed: Callable[[Tensor, Tensor], Tensor], x: Tensor, actuators: int, step: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Effective commands and their Jacobians by delays and by offsets, by differences of `step`.

    An actuator's command depends on its own offset only, so all are moved at once.

    Parameters
    ----------
    executed : callable
        From latent variables (k, M, size) and their trajectories (k,), in order, to commands
        (k, S, d_u).
    x : Tensor, shape (n, M, size)
        Delay and offsets first.
    actuators : int
        d_u.
    step : float
        Of delays in samples, of offsets in the unit of the commands.

    Returns
    -------
    Tensor, shape (n, S, d_u)
        The commands.
    Tensor, Tensor, shape (n, M, S, d_u)
        Their Jacobians by the delay and by the own offset of each segment.

    """
    n, segments, size = x.shape
    moved = torch.zeros(2, segments, segments, size, dtype=x.dtype)
    index = torch.arange(segments)
    moved[0, index, index, 0] = step
    moved[1, index, index, 1 : 1 + actuators] = step
    moves = torch.cat([torch.zeros_like(moved[0, :1]), moved.flatten(0, 1)])
    rows = torch.arange(n).repeat_interleave(len(moves))
    commands = executed((x[:, None] + moves).flatten(0, 1), rows).unflatten(0, (n, len(moves)))
    delay, offset = ((commands[:, 1:] - commands[:, :1]) / step).split(segments, dim=1)
    return commands[:, 0], delay, offset


def _moving(reference: Tensor, segments: Segments, z: Tensor, times: Tensor) -> Tensor:
    """The effective commands of actuators that no fault holds, at `times` (n, S)."""
    width = reference.shape[2]
    if not z.shape[1]:
        return _repeated(reference, times)
    delay, offset, missed = z.split([1, width, width], dim=-1)
    start, settle = (torch.as_tensor(t, dtype=z.dtype) for t in (segments.start, segments.settle))
    count = torch.as_tensor(segments.valid).sum(dim=1, keepdim=True)
    first, last = _repeated(reference, start), _repeated(reference, settle)  # (n, M, d_u)
    # The error of every actuator after each segment; before the first one there is none.
    error = [torch.zeros_like(offset[:, 0])]
    for m in range(z.shape[1]):
        stays = first[:, m] + error[-1] - last[:, m]
        error.append(offset[:, m] + missed[:, m] * (stays - offset[:, m]))
    errors = torch.stack(error, dim=1)  # (n, 1 + M, d_u)
    source = Knots.of(segments, delay[..., 0], times).source_time()
    undelayed = _repeated(reference, source)
    index = torch.searchsorted(start, source.detach().contiguous(), right=True).minimum(count)
    segment = (index - 1).clamp_min(0)
    a, b = gather_samples(first, segment), gather_samples(last, segment)
    begin, end = (each.gather(1, segment)[..., None] for each in (start, settle))
    # The error grows with the distance covered; of an actuator without a command, with time.
    size = reference.abs().amax(dim=0).amax(dim=0).clamp_min(1e-12)
    moves = (b - a).abs() > STILL * size
    covered = (undelayed - a) / torch.where(moves, b - a, torch.ones_like(a))
    source = source[..., None]
    passed = (source - begin) / (end - begin).clamp_min(1e-9)
    share = torch.where(moves, covered, passed).clamp(0, 1)
    share = torch.where(source >= end, torch.ones_like(share), share)
    before, after = gather_samples(errors, segment), gather_samples(errors, segment + 1)
    current = before + share * (after - before)
    return undelayed + torch.where(index[..., None] > 0, current, torch.zeros_like(current))


def _repeated(reference: Tensor, times: Tensor) -> Tensor:
    """The reference (n / r, T, d_u) at `times` (n, S): (n, S, d_u), without r copies of it."""
    if len(reference) == len(times):
        return interpolate(reference, times)
    rows = times.reshape(len(reference), -1)
    return interpolate(reference, rows).reshape(*times.shape, -1)
