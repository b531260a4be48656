"""What every correction operator g offers: apply z to a path, infer z from a measured one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.segments import Segments
from retwin.trajectories import Channels

__all__ = ["Context", "Correction", "DifferentiableTwin", "Discrepancy", "Head"]


class DifferentiableTwin(Protocol):
    """What a correction needs of a surrogate: a differentiable call, and a fast one without."""

    def __call__(self, commands: Tensor) -> Tensor:
        """Outputs (n, T, d_y) for commands (n, T, d_u), differentiable."""
        ...

    def predict(self, commands: NDArray) -> NDArray:
        """The same without gradient."""
        ...


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

    surrogate: DifferentiableTwin
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
    def of(
        cls,
        surrogate: DifferentiableTwin,
        commands: NDArray,
        segments: Segments,
        *,
        rate: float,
        faulty: NDArray | None = None,
    ) -> Context:
        """The context of those commands; the surrogate is asked once, or twice with faults."""
        clean = torch.tensor(commands, dtype=torch.float32)
        nominal = torch.as_tensor(surrogate.predict(commands))
        if faulty is None:
            return cls(surrogate, clean, clean, nominal, nominal, segments, rate)
        told = torch.tensor(faulty, dtype=torch.float32)
        path = torch.as_tensor(surrogate.predict(faulty))
        return cls(surrogate, clean, told, nominal, path, segments, rate)


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

    @property
    def resolution(self) -> str:
        """What z has one value for: "segment" or "step"."""
        ...

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
