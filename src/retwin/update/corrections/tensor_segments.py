"""`TensorSegments`: segments for exported graphs and for devices other than the processor."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from retwin.data.segments import Segments


@dataclass(frozen=True, eq=False)
class TensorSegments:
    """`Segments` with tensors for times, and without its checks, which a graph cannot hold.

    Attributes
    ----------
    start, settle, stop, valid : Tensor
        (n, M), see `Segments`.
    steps : int
        Samples per trajectory.
    max_count : int
        M.

    """

    start: Tensor
    settle: Tensor
    stop: Tensor
    valid: Tensor
    steps: int
    max_count: int

    @classmethod
    def on(cls, device: torch.device, segments: Segments) -> TensorSegments:
        """The same segments on a device."""
        times = (segments.start, segments.settle, segments.stop, segments.valid)
        start, settle, stop, valid = (torch.from_numpy(each).to(device) for each in times)
        return cls(start, settle, stop, valid, segments.steps, segments.max_count)
