"""T_z(u) of `CommandSpace`: what the actuators are effectively told."""

from __future__ import annotations

import torch
from torch import Tensor

from retwin.corrections.warp import Knots, read
from retwin.segments import Segments

__all__ = ["effective"]

STILL = 1e-6
"""Change of a command, relative to its size, that is no movement."""


def effective(told: Tensor, segments: Segments, z: Tensor, when: Tensor) -> Tensor:
    """T_z(u): what the actuators are effectively told.

    Parameters
    ----------
    told: (n, T, d_u), the reference.
    segments: the movements, M at most.
    z: (n, M, 1 + 2 d_u), delay, offsets, missed; missed may lie between 0 and 1.
    when: (n, S, d_u), the samples to be told at, fractions allowed.

    Returns (n, S, d_u).

    """
    width = told.shape[2]
    if not z.shape[1]:
        columns = [
            read(told[..., j : j + 1], when[..., j].expand(len(told), -1)) for j in range(width)
        ]
        return torch.cat(columns, dim=-1)
    delay, offset, missed = z.split([1, width, width], dim=-1)
    start, settle = (torch.as_tensor(t, dtype=z.dtype) for t in (segments.start, segments.settle))
    count = torch.as_tensor(segments.valid).sum(dim=1, keepdim=True)
    first, last = read(told, start), read(told, settle)  # (n, M, d_u)
    # How far off the reference every movement leaves an actuator.
    error = [torch.zeros_like(told[:, 0])]
    for m in range(z.shape[1]):
        stays = first[:, m] + error[-1] - last[:, m]
        error.append(offset[:, m] + missed[:, m] * (stays - offset[:, m]))
    errors = torch.stack(error, dim=1)  # (n, 1 + M, d_u)
    columns = []
    for j in range(width):
        at = when[..., j].expand(len(told), -1)
        source = Knots.of(segments, delay[..., 0], at).source_time()
        here = read(told[..., j : j + 1], source)[..., 0]
        index = torch.searchsorted(start, source.detach().contiguous(), right=True).minimum(count)
        which = (index - 1).clamp_min(0)
        a, b = first[..., j].gather(1, which), last[..., j].gather(1, which)
        begin, end = start.gather(1, which), settle.gather(1, which)
        # An actuator errs as far as it has moved; one that is told nothing, as time has passed.
        moves = (b - a).abs() > STILL * told[..., j].abs().amax().clamp_min(1e-12)
        along = (here - a) / torch.where(moves, b - a, torch.ones_like(a))
        passed = (source - begin) / (end - begin).clamp_min(1e-9)
        share = torch.where(moves, along, passed).clamp(0, 1)
        share = torch.where(source >= end, torch.ones_like(share), share)
        before = errors[..., j].gather(1, which)
        after = errors[..., j].gather(1, which + 1)
        wrong = torch.where(index > 0, before + share * (after - before), torch.zeros_like(share))
        columns.append(here + wrong)
    return torch.stack(columns, dim=-1)
