"""Warped time: every movement shifted by its own delay, everything between stretched to fit."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from retwin.data.segments import Segments

__all__ = ["Knots", "gather_samples", "read"]


@dataclass(frozen=True, eq=False)
class Knots:
    """Where the pieces of the warped time join, and for each sample its piece and place in it."""

    source: Tensor  # (n, 2 M), time of each knot in the uncorrected path
    target: Tensor  # (n, 2 M), time of each knot in the corrected path
    last: Tensor  # (n, 1), index of the last knot: those behind it are of no movement
    right: Tensor  # (n, T), index of the knot that follows each sample, one more than the last's
    share: Tensor  # (n, T), place between the knot before (0) and after (1)
    time: Tensor  # (n, T), the samples themselves

    @classmethod
    def of(cls, segments: Segments, delay: Tensor, when: Tensor | None = None) -> Knots:
        """The knots for delays (n, M) in samples, seen at every sample or at `when` (n, T)."""
        source = torch.stack(
            [
                torch.as_tensor(segments.start, dtype=delay.dtype),
                torch.as_tensor(segments.settle, dtype=delay.dtype),
            ],
            -1,
        ).flatten(1)
        valid = torch.as_tensor(segments.valid)
        late = (delay * valid).repeat_interleave(2, dim=1)
        # A movement cannot begin before the last one has ended, however the delays differ.
        target = (source + late).cummax(dim=1).values
        last = (2 * valid.sum(dim=1, keepdim=True) - 1).clamp_min(0)
        time = torch.arange(segments.steps, dtype=delay.dtype) if when is None else when
        time = time.expand(len(target), -1).contiguous()
        right = torch.searchsorted(target.detach(), time.detach(), right=True).minimum(last + 1)
        begin = target.gather(1, (right - 1).clamp_min(0))
        end = target.gather(1, right.minimum(last))
        share = (time - begin) / (end - begin).clamp_min(1e-9)
        return cls(source, target, last, right, share.clamp(0, 1), time)

    def between(self, values: Tensor) -> Tensor:
        """Values (n, 2 M, k) of the knots, linear between them and constant outside: (n, T, k)."""
        before, after = (gather_samples(values, place) for place in self._around)
        return before + self.share[..., None] * (after - before)

    def slope(self, values: Tensor) -> Tensor:
        """Change per sample of `between` (n, T, k)."""
        before, after = self._around
        length = self.target.gather(1, after) - self.target.gather(1, before)
        rise = gather_samples(values, after) - gather_samples(values, before)
        return rise / length.clamp_min(1e-9)[..., None]

    @property
    def _around(self) -> tuple[Tensor, Tensor]:
        """Index (n, T) of the knot before each sample, and after it; the same one outside."""
        return (self.right - 1).clamp_min(0), self.right.minimum(self.last)

    def source_time(self) -> Tensor:
        """When in the uncorrected path each sample (n, T) is read."""
        inner = self.between(self.source[..., None])[..., 0]
        early = (self.time - self.target[:, :1]).clamp_max(0)
        late = (self.time - self.target.gather(1, self.last)).clamp_min(0)
        return inner + early + late

    @staticmethod
    def spread(offset: Tensor) -> Tensor:
        """Offsets (n, M, k) on the knots (n, 2 M, k): the last one's at the start, then its own."""
        before = torch.cat([torch.zeros_like(offset[:, :1]), offset[:, :-1]], dim=1)
        return torch.stack([before, offset], dim=2).flatten(1, 2)


def gather_samples(values: Tensor, place: Tensor) -> Tensor:
    """The values (n, T, d) at whole places (n, S) of their own: (n, S, d)."""
    return values.gather(1, place[..., None].expand(-1, -1, values.shape[2]))


def read(path: Tensor, when: Tensor) -> Tensor:
    """The path (n, T, d) at the fractional samples `when` (n, T), held beyond its ends."""
    when = when.clamp(0, path.shape[1] - 1)
    below = when.detach().floor().long().clamp_max(max(path.shape[1] - 2, 0))
    before, after = gather_samples(path, below), gather_samples(path, below + 1)
    return before + (when - below)[..., None] * (after - before)
