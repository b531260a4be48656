"""The `Correction` protocol: apply z to a path, infer z from a measured one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.data.segments import Segments
from retwin.data.trajectories import Channels
from retwin.inference.problem import Rows
from retwin.update.corrections.commands.machines import Learned, OtherMachines


class DifferentiableTwin(Protocol):
    """The part of a surrogate that corrections use: a call with gradient, and one without.

    Optional attributes are `memoryless`, whether an output depends on the command of its own sample
    only, `unit`, (d_y,), by which outputs are divided to be compared with each other, and `inputs`,
    the channels of the commands, whose units say which actuators are of one kind.
    """

    def __call__(self, commands: Tensor) -> Tensor:
        """Outputs (n, T, d_y) for commands (n, T, d_u), differentiable."""

    def predict(self, commands: NDArray) -> NDArray:
        """The same without gradient."""


@dataclass(frozen=True)
class Head:
    """A block of z that the residual model draws independently of the others.

    Attributes
    ----------
    name : str
        Of the block.
    width : int
        Number of its components of z.
    kind : {"mixture", "bernoulli"}
        A Gaussian mixture with full covariance, or components that are 0 or 1.

    """

    name: str
    width: int
    kind: Literal["mixture", "bernoulli"] = "mixture"


@dataclass(frozen=True, eq=False)
class Context(Rows):
    """The inputs of a correction for n trajectories; an operator takes what it needs.

    Attributes
    ----------
    surrogate : DifferentiableTwin
        Commands (n, T, d_u) to outputs (n, T, d_y).
    commands : Tensor
        (n, T, d_u), without faults.
    faulty_commands : Tensor
        (n, T, d_u), the commands with the effect of the faults on the reference.
    frozen : Tensor
        (n, d_u), the sample from which a fault holds an actuator's response; T for never.
    nominal : Tensor
        (n, T, d_y), the surrogate's output for `commands`.
    segments : Segments
        Of the commands or of the nominal path.
    rate : float
        In Hz.
    corrected : Tensor, optional
        (n, T, d_y), the output of the operators before this one; None for the first.
    surrogate_variance : Tensor, optional
        (n, M, d_y), mean square of the surrogate's own error in each segment, in the outputs' units
        squared; None for a surrogate without error.
    scale : Tensor, optional
        (d_y,), what outputs are divided by to be compared, for a surrogate without `unit`.
    others : OtherMachines, optional
        What other machines of the kind have shown of the discrepancy; None for nothing.

    """

    surrogate: DifferentiableTwin
    commands: Tensor
    faulty_commands: Tensor
    frozen: Tensor
    nominal: Tensor
    segments: Segments
    rate: float
    corrected: Tensor | None = None
    surrogate_variance: Tensor | None = None
    scale: Tensor | None = None
    others: OtherMachines | None = None
    shared = ("surrogate", "rate", "scale", "others")

    def __len__(self) -> int:
        return len(self.commands)

    @property
    def path(self) -> Tensor:
        """The uncorrected outputs (n, T, d_y): those of the operators before, else the surrogate's.

        These are for the faulty commands, held where an actuator is frozen.
        """
        return self._uncorrected if self.corrected is None else self.corrected

    @cached_property
    def _uncorrected(self) -> Tensor:
        """The surrogate's outputs, computed once and only if an operator on outputs needs them."""
        time = torch.arange(self.faulty_commands.shape[1])[:, None]
        held = self.faulty_commands.gather(1, torch.minimum(time, self.frozen[:, None]))
        if held.equal(self.commands):
            return self.nominal
        return torch.as_tensor(self.surrogate.predict(held.numpy()))

    @property
    def unit(self) -> Tensor:
        """Unit (d_y,) by which outputs are divided to be compared; 1 if not known."""
        own = getattr(self.surrogate, "unit", self.scale)
        return self.nominal.new_ones(self.nominal.shape[2]) if own is None else own

    def __getitem__(self, index: slice | NDArray | Tensor) -> Context:
        """The context of some of the trajectories."""
        return Rows.__getitem__(replace(self, corrected=self.path), index)

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
        clean = faulty = torch.tensor(commands, dtype=torch.float32)
        if faulty_commands is not None:
            faulty = torch.tensor(faulty_commands, dtype=torch.float32)
        if frozen is None:
            frozen = np.full((len(clean), clean.shape[2]), clean.shape[1])
        nominal, since = torch.as_tensor(surrogate.predict(commands)), torch.as_tensor(frozen)
        scale = _scale(surrogate, nominal)
        return cls(surrogate, clean, faulty, since, nominal, segments, rate, scale=scale)


def _scale(surrogate: DifferentiableTwin, nominal: Tensor) -> Tensor | None:
    """Divisors (d_y,) of outputs with the standard deviations of nominal ones (n, T, d_y).

    Outputs of one physical unit have the same divisor, as those of a `Surrogate`; that of a
    constant output is 1. None for one that has `unit`, or no `outputs` whose units were known.
    """
    outputs = getattr(surrogate, "outputs", None)
    if hasattr(surrogate, "unit") or not isinstance(outputs, Channels):
        return None
    values = nominal.double().flatten(0, 1)
    # Standard deviation of a constant output, relative to its size: the rounding of numbers.
    tiny = 1e-6 * values.abs().amax(dim=0)
    spread = values.std(dim=0, correction=0)
    spread = torch.where(spread > tiny, spread, 1.0)
    if outputs.comparable:
        spread = spread.mean().expand_as(spread)
    return spread.to(nominal)


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """The most probable z of measured outputs, and its uncertainty.

    Attributes
    ----------
    z : Tensor
        (n, M, d_z), 0 where a segment does not exist.
    covariance : Tensor
        (n, M, d_z, d_z), of each segment's z, correlated noise accounted for.
    identified : Tensor
        (n, M, d_z) bool, False where the outputs do not identify that component.
    noise : Tensor
        (n,), scale of the residual that z leaves unexplained, in the output's unit.
    severity : Tensor, optional
        (n, M, d_u), the error of an actuator by a fault, in its command's unit; None where the
        operator does not estimate it.
    posterior : bool
        Whether z and covariance are a whole posterior: what the outputs do not identify then has
        the variance of its prior, and draws stand for z everywhere.
    at_bound : Tensor, optional
        (n, M) bool, where the delay is at a bound of its range, so that a better one may lie
        beyond; None where no component of z is bounded.
    learned : dict, optional
        What the machine has shown of its hyperparameters, see `corrections.machines`.
    predicted : Tensor, optional
        (J, M, d_z), draws of z in further runs of the first trajectories, in turn, each with its
        own draw of the hyperparameters.

    """

    z: Tensor
    covariance: Tensor
    identified: Tensor
    noise: Tensor
    severity: Tensor | None = None
    posterior: bool = False
    at_bound: Tensor | None = None
    learned: Learned | None = None
    predicted: Tensor | None = None


@runtime_checkable
class Correction(Protocol):
    """An operator g with its inverse; holds settings, no data.

    Optional members are `pools`, true if `infer` learns from all trajectories together;
    `severities`, true if it estimates the severity of a known fault apart from z;
    `at(context, z, when)`, the result of `apply` at some samples (n, S) only, if that costs less;
    and `completed(context, observed, mask)`, the operator with the settings that were left open,
    chosen from measured outputs.
    """

    @property
    def resolution(self) -> str:
        """What has a z of its own: a "segment", or a "step" (a sample)."""

    def latent(self, inputs: Channels, outputs: Channels) -> Channels:
        """Names and units of the components of z for a system with these channels."""

    def heads(self, inputs: Channels, outputs: Channels) -> tuple[Head, ...]:
        """Blocks of z, in order, that the residual model draws independently of each other."""

    def apply(self, context: Context, z: Tensor) -> Tensor:
        """The corrected output (n, T, d_y): `context.path` when z (n, M, d_z) is 0."""

    def infer(self, context: Context, observed: Tensor, mask: Tensor) -> Discrepancy:
        """The z for which `apply` comes closest to `observed` (n, T, d_y) where `mask` is True."""


def block_diagonal(one: Tensor, other: Tensor) -> Tensor:
    """The joint covariance (..., P + Q, P + Q) of independent (..., P, P) and (..., Q, Q)."""
    size, further = one.shape[-1], other.shape[-1]
    joint = one.new_zeros(*one.shape[:-2], size + further, size + further)
    joint[..., :size, :size], joint[..., size:, size:] = one, other
    return joint
