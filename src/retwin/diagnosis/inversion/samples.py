"""`DiagnosisInputs`: what a diagnosis by inversion takes from trajectories."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from retwin.checks import agree
from retwin.data.trajectories import Trajectories
from retwin.update.corrections import Context, sample_mask
from retwin.update.residual import ResidualModel
from retwin.update.surrogate import Surrogate


class Precise:
    """A surrogate in double precision: no output depends on the batch that it is computed in."""

    def __init__(self, surrogate: Surrogate) -> None:
        self.memoryless = surrogate.memoryless
        self.predict = surrogate.predict
        self.single = surrogate  # its derivatives need no double precision
        self.model = copy.deepcopy(surrogate).double()

    def __call__(self, commands: Tensor) -> Tensor:
        """Outputs (n, T, d_y), computed in double precision and then rounded."""
        return self.model(commands.double()).to(commands.dtype)


@dataclass(frozen=True, eq=False)
class DiagnosisInputs:
    """The inputs of a diagnosis: the commands' context, and outputs where they were sampled."""

    context: Context
    observed: Tensor
    mask: Tensor

    @classmethod
    def of(
        cls, surrogate: Surrogate, residual: ResidualModel, trajectories: Trajectories
    ) -> DiagnosisInputs:
        """Those of `trajectories`, which must have the channels and the rate of the surrogate."""
        remedy = "resample or rename, or load the file with its case"
        whose = "what the surrogate was trained on"
        agree("trajectories", trajectories, surrogate, whose, remedy=remedy)
        context = residual.context(surrogate, np.ascontiguousarray(trajectories.commands))
        observed = torch.as_tensor(trajectories.observed.astype(np.float64))
        mask = torch.as_tensor(trajectories.mask.copy())
        # One by one: the timing of a trajectory's samples must not depend on the others.
        rate, pairs = trajectories.rate, zip(observed.split(1), mask.split(1), strict=True)
        sampled = [sample_mask(residual.correction, *each, rate) for each in pairs]
        if isinstance(surrogate, nn.Module):
            context = replace(context, surrogate=Precise(surrogate))
        return cls(context, observed, torch.cat(sampled))

    def with_error(self, variance: Tensor) -> DiagnosisInputs:
        """The same for a surrogate whose error has this variance (d_y,) in every segment."""
        if not variance.any():
            return self
        shape = (*self.context.segments.valid.shape, len(variance))
        every = variance.double().expand(shape)
        return replace(self, context=replace(self.context, surrogate_variance=every))

    def __getitem__(self, rows: slice) -> tuple[Context, Tensor, Tensor]:
        return self.context[rows], self.observed[rows], self.mask[rows]
