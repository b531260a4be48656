"""What every correction operator g offers: apply z to a path, infer z from a measured one."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, Protocol, runtime_checkable

import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.data.segments import Segments
from retwin.data.trajectories import Channels

__all__ = ["Context", "Correction", "DifferentiableTwin", "Discrepancy", "Head"]


class DifferentiableTwin(Protocol):
    """What a correction needs of a surrogate: a differentiable call, and a fast one without.

    One may also have `memoryless`, whether an output depends on the command of its own sample only,
    and `unit`, what outputs are divided by to be compared with each other.
    """

    def __call__(self, commands: Tensor) -> Tensor:
        """Outputs (n, T, d_y) for commands (n, T, d_u), differentiable."""
        ...

    def predict(self, commands: NDArray) -> NDArray:
        """The same without gradient."""
        ...


@dataclass(frozen=True)
class Head:
    """A block of z that the residual model draws on its own.

    Attributes
    ----------
    name, width: what it is, and how many components of z it has.
    kind: "mixture", a Gaussian mixture with full covariance; or "bernoulli", 0 or 1 each.

    """

    name: str
    width: int
    kind: Literal["mixture", "bernoulli"] = "mixture"


@dataclass(frozen=True, eq=False)
class Context:
    """All that a correction may look at; an operator takes what it needs.

    Attributes
    ----------
    surrogate: commands (n, T, d_u) to outputs (n, T, d_y), differentiable.
    commands: (n, T, d_u), clean.
    faulty_commands: (n, T, d_u), the commands with the effect of the faults on the reference.
    frozen: (n, d_u), the sample from which a fault holds an actuator's response; T for never.
    nominal: (n, T, d_y), the surrogate's output for the clean commands.
    segments: movements of the clean commands or of the nominal path.
    rate: samples per second.
    corrected: (n, T, d_y), what operators before this one have left; None for the first.

    """

    surrogate: DifferentiableTwin
    commands: Tensor
    faulty_commands: Tensor
    frozen: Tensor
    nominal: Tensor
    segments: Segments
    rate: float
    corrected: Tensor | None = None
    _found: list[Tensor] = field(default_factory=list, init=False, repr=False)

    def __len__(self) -> int:
        return len(self.commands)

    @property
    def path(self) -> Tensor:
        """(n, T, d_y), what is corrected: what operators before have left, else the surrogate's
        output for what the actuators are told, held where they are frozen.

        Asked of the surrogate when it is first needed: an operator on commands needs it not.
        """
        if self.corrected is not None:
            return self.corrected
        if not self._found:
            time = torch.arange(self.faulty_commands.shape[1])[:, None]
            held = self.faulty_commands.gather(1, torch.minimum(time, self.frozen[:, None]))
            clean = held.equal(self.commands)
            said = self.nominal if clean else torch.as_tensor(self.surrogate.predict(held.numpy()))
            self._found.append(said)
        return self._found[0]

    @property
    def unit(self) -> Tensor:
        """(d_y,) what outputs are divided by to be compared with each other; 1 if not known."""
        return getattr(self.surrogate, "unit", self.nominal.new_ones(self.nominal.shape[2]))

    def __getitem__(self, index: slice | NDArray) -> Context:
        """The context of some of the trajectories."""
        return replace(
            self,
            commands=self.commands[index],
            faulty_commands=self.faulty_commands[index],
            frozen=self.frozen[index],
            nominal=self.nominal[index],
            segments=self.segments[index],
            corrected=self.path[index],
        )

    @classmethod
    def of(
        cls,
        surrogate: DifferentiableTwin,
        commands: NDArray,
        segments: Segments,
        *,
        rate: float,
        faulty_commands: NDArray | None = None,
        frozen: NDArray | None = None,
    ) -> Context:
        """The context of those commands, without faults by default."""
        clean = torch.tensor(commands, dtype=torch.float32)
        return cls(
            surrogate,
            commands=clean,
            faulty_commands=clean
            if faulty_commands is None
            else torch.tensor(faulty_commands, dtype=torch.float32),
            frozen=torch.full((len(clean), clean.shape[2]), clean.shape[1])
            if frozen is None
            else torch.as_tensor(frozen),
            nominal=torch.as_tensor(surrogate.predict(commands)),
            segments=segments,
            rate=rate,
        )


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """The z that explains a measured output best, and how well it is known.

    Attributes
    ----------
    z: (n, M, d_z), 0 where a movement does not exist.
    covariance: (n, M, d_z, d_z), of each movement's z, correlated noise accounted for.
    identified: (n, M, d_z) bool, False where the outputs do not tell that component.
    noise: (n,) scale of what z leaves unexplained, in the output's unit.
    severity: (n, M, d_u), how far a fault left an actuator off its command; None where the operator
        cannot tell.
    posterior: whether z and covariance are a whole posterior: what the outputs do not tell is then
        as wide as what is believed of it beforehand, and draws stand for z everywhere.

    """

    z: Tensor
    covariance: Tensor
    identified: Tensor
    noise: Tensor
    severity: Tensor | None = None
    posterior: bool = False


@runtime_checkable
class Correction(Protocol):
    """An operator g with its inverse; holds settings, no data.

    One may also have `pools`, true if what it infers of a trajectory leans on those beside it;
    `severities`, true if it tells how severe a known fault is apart from z; and
    `at(context, z, when)`, what `apply` gives at some samples (n, S) only, if that costs less.
    """

    @property
    def resolution(self) -> str:
        """What z has one value for: "segment" or "step"."""
        ...

    def latent(self, inputs: Channels, outputs: Channels) -> Channels:
        """Names and units of the components of z for a system with these channels."""
        ...

    def heads(self, inputs: Channels, outputs: Channels) -> tuple[Head, ...]:
        """Blocks of z, in order, that the residual model draws independently of each other."""
        ...

    def apply(self, context: Context, z: Tensor) -> Tensor:
        """The corrected output (n, T, d_y): `context.path` when z (n, M, d_z) is 0."""
        ...

    def infer(self, context: Context, observed: Tensor, mask: Tensor) -> Discrepancy:
        """The z for which `apply` comes closest to `observed` (n, T, d_y) where `mask` is True."""
        ...
