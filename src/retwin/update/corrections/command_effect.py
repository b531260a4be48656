"""T_z(u) of `CommandSpace`: what the actuators are effectively told."""

from __future__ import annotations

import torch
from torch import Tensor

from retwin.data.segments import Segments
from retwin.update.corrections.warp import Knots, gather_samples, read

__all__ = ["effective"]

STILL = 1e-6
"""Change of a command, relative to its size, that is no movement."""


def effective(
    told: Tensor, segments: Segments, z: Tensor, when: Tensor, frozen: Tensor | None = None
) -> Tensor:
    """T_z(u): what the actuators are effectively told.

    Parameters
    ----------
    told: (n, T, d_u), the reference.
    segments: the movements, M at most.
    z: (n, M, 1 + 2 d_u), delay, offsets, missed; missed may lie between 0 and 1.
    when: (S,) or (n, S), the samples to be told at, fractions allowed.
    frozen: (n, d_u), the sample from which an actuator stays as it is; by default none does.

    Returns (n, S, d_u).

    """
    when = when.to(z.dtype).expand(len(told), -1)
    if frozen is None:
        return _free(told, segments, z, when)
    since = frozen.to(z.dtype)
    moving = _free(told, segments, z, torch.cat([when, since], dim=1))
    free, stopped = moving.split([when.shape[1], told.shape[2]], dim=1)
    still = stopped.diagonal(dim1=1, dim2=2)
    return torch.where(when[..., None] < since[:, None], free, still[:, None])


def _free(told: Tensor, segments: Segments, z: Tensor, when: Tensor) -> Tensor:
    """The same of actuators that move, `when` (n, S)."""
    width = told.shape[2]
    if not z.shape[1]:
        return read(told, when)
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
    source = Knots.of(segments, delay[..., 0], when).source_time()
    here = read(told, source)
    index = torch.searchsorted(start, source.detach().contiguous(), right=True).minimum(count)
    which = (index - 1).clamp_min(0)
    a, b = gather_samples(first, which), gather_samples(last, which)
    begin, end = (times.gather(1, which)[..., None] for times in (start, settle))
    # An actuator errs as far as it has moved; one that is told nothing, as time has passed.
    size = told.abs().amax(dim=0).amax(dim=0).clamp_min(1e-12)
    moves = (b - a).abs() > STILL * size
    along = (here - a) / torch.where(moves, b - a, torch.ones_like(a))
    source = source[..., None]
    passed = (source - begin) / (end - begin).clamp_min(1e-9)
    share = torch.where(moves, along, passed).clamp(0, 1)
    share = torch.where(source >= end, torch.ones_like(share), share)
    before, after = gather_samples(errors, which), gather_samples(errors, which + 1)
    wrong = before + share * (after - before)
    return here + torch.where(index[..., None] > 0, wrong, torch.zeros_like(wrong))
