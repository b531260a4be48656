"""What every correction operator g offers: apply z to a nominal path, infer z from a measured one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.segments import Segments
from retwin.trajectories import Channels

__all__ = ["Context", "Correction", "Discrepancy", "Head"]

Head = tuple[str, int]
"""A block of z that gets a mixture of its own in the residual model: name and width."""


@dataclass(frozen=True, eq=False)
class Context:
    """All that a correction may look at; an operator takes what it needs.

    Attributes
    ----------
    surrogate: commands (n, T, d_u) to outputs (n, T, d_y), differentiable.
    commands: (n, T, d_u), clean.
    faulty: (n, T, d_u), with faults; the clean ones when there is none.
    nominal: (n, T, d_y), the surrogate's output for the clean commands.
    path: (n, T, d_y), the surrogate's output for the faulty commands: what is corrected.
    segments: movements of the clean commands or of the nominal path.
    rate: samples per second.
    """

    surrogate: Callable[[Tensor], Tensor]
    commands: Tensor
    faulty: Tensor
    nominal: Tensor
    path: Tensor
    segments: Segments
    rate: float

    def __len__(self) -> int:
        return len(self.commands)

    def __getitem__(self, index: slice) -> Context:
        """The context of some of the trajectories."""
        return replace(
            self,
            commands=self.commands[index],
            faulty=self.faulty[index],
            nominal=self.nominal[index],
            path=self.path[index],
            segments=self.segments[index],
        )

    @classmethod
    @torch.no_grad()
    def of(
        cls,
        surrogate: Callable[[Tensor], Tensor],
        commands: NDArray | Tensor,
        segments: Segments,
        *,
        rate: float,
        faulty: NDArray | Tensor | None = None,
    ) -> Context:
        """The context of those commands; the surrogate is asked once, or twice with faults."""
        clean = _own(commands)
        nominal = surrogate(clean)
        if faulty is None:
            return cls(surrogate, clean, clean, nominal, nominal, segments, rate)
        told = _own(faulty)
        return cls(surrogate, clean, told, nominal, surrogate(told), segments, rate)


def _own(values: NDArray | Tensor) -> Tensor:
    """A float32 tensor with memory of its own: arrays of `Trajectories` are read-only."""
    if isinstance(values, Tensor):
        return values.float()
    return torch.tensor(values, dtype=torch.float32)


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """The z that explains a measured output best, and how well it is known.

    Attributes
    ----------
    z: (n, M, d_z), 0 where a movement does not exist.
    covariance: (n, M, d_z, d_z), of each movement's z, correlated noise accounted for.
    identified: (n, M, d_z) bool, False where the outputs do not tell that component.
    noise: (n,) scale of what z leaves unexplained, in the output's unit.
    """

    z: Tensor
    covariance: Tensor
    identified: Tensor
    noise: Tensor


@runtime_checkable
class Correction(Protocol):
    """An operator g with its inverse; holds settings, no data."""

    resolution: str
    """"segment" or "step": what z has one value for."""

    def latent(self, outputs: Channels) -> Channels:
        """Names and units of the components of z for a system with these outputs."""
        ...

    def heads(self, outputs: Channels) -> tuple[Head, ...]:
        """Blocks of z, in order, that the residual model draws independently of each other."""
        ...

    def apply(self, context: Context, z: Tensor) -> Tensor:
        """The corrected output (n, T, d_y): `context.path` with z (n, M, d_z) applied."""
        ...

    def infer(self, context: Context, observed: Tensor, mask: Tensor) -> Discrepancy:
        """The z for which `apply` comes closest to `observed` (n, T, d_y) where `mask` is True."""
        ...
