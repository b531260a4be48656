"""Training data of the residual model: z* of each segment, or draws from its posterior."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.data.trajectories import Trajectories
from retwin.nets.mixtures import BernoulliHead
from retwin.progress import Progress
from retwin.update.corrections import Context, Correction, Discrepancy
from retwin.update.residual.model import ResidualModel, describe

DRAWS = 20
"""Draws of z per trajectory from its posterior. They represent the uncertainty that outputs leave;
with twenty the error of a mean is below a quarter of a standard deviation."""


@dataclass(frozen=True, eq=False)
class ResidualTask:
    """What a residual model is fitted to, and how; see the arguments of `fit_residual`.

    Attributes
    ----------
    used : Trajectories
        The n measured trajectories.
    correction : Correction
        The operator g, whose settings have been fitted to them.
    context : Context
        What g is applied to.
    found : Discrepancy
        Their z*.

    """

    used: Trajectories
    correction: Correction
    context: Context
    found: Discrepancy
    bounds: NDArray | None
    seed: int
    progress: Progress | None


@dataclass(frozen=True, eq=False)
class Targets:
    """Features and z of n trajectories of M segments, R draws of each.

    Attributes
    ----------
    features : Tensor
        (n, M, F), see `describe`.
    z : Tensor
        (R, n, M, d_z).
    identified : Tensor
        (n, M, d_z) bool, the components of z to train on.
    valid : Tensor
        (n, M) bool, the segments that exist.

    """

    features: Tensor
    z: Tensor
    identified: Tensor
    valid: Tensor

    @classmethod
    def of(
        cls, model: ResidualModel, context: Context, found: Discrepancy, *, seed: int
    ) -> Targets:
        """The training data from inferred discrepancies `found`."""
        valid = torch.as_tensor(context.segments.valid)
        if not found.posterior:
            return cls(describe(context), found.z.float()[None], found.identified, valid)
        generator = torch.Generator().manual_seed(seed)
        values, vectors = torch.linalg.eigh(found.covariance)
        root = vectors * values.clamp_min(0).sqrt()[..., None, :]
        noise = torch.randn(DRAWS, *found.z.shape, generator=generator, dtype=found.z.dtype)
        drawn = found.z + torch.einsum("nmij,rnmj->rnmi", root, noise)
        for head, part in model.parts():
            # An event is decided; it has no variance.
            if isinstance(head, BernoulliHead):
                drawn[..., part] = found.z[..., part]
        features = describe(context)
        if found.predicted is not None:
            # One z of each further run: how uncertain it is, is how much the runs differ.
            again = torch.arange(len(found.predicted)) % len(valid)
            drawn = torch.cat([drawn, found.predicted.expand(DRAWS, *found.predicted.shape)], dim=1)
            features, valid = (torch.cat([each, each[again]]) for each in (features, valid))
        all_valid = valid[..., None].expand(drawn.shape[1:])
        return cls(features, (drawn * valid[..., None]).float(), all_valid, valid)

    def __getitem__(self, rows: Tensor) -> Targets:
        """Those of some trajectories."""
        parts = (self.features, self.identified, self.valid)
        features, identified, valid = (each[rows] for each in parts)
        return Targets(features, self.z[:, rows], identified, valid)

    @property
    def used(self) -> Tensor:
        """(n, M, d_z) bool, the components of z of the segments that exist."""
        return self.identified & self.valid[..., None]

    def halved(self) -> Targets:
        """A single trajectory twice, with the earlier and with the later half of its segments."""
        twice = self[torch.zeros(2, dtype=torch.long)]
        place = self.valid.cumsum(dim=1)
        earlier = 2 * place <= place[:, -1:] + 1
        # A single segment is in both.
        later = ~earlier | (place[:, -1:] == 1)
        return replace(twice, valid=twice.valid & torch.cat([earlier, later]))

    def examples(self, model: ResidualModel) -> tuple[Tensor, ...]:
        """Features, z, identified (..., heads) and valid; each draw of z is an example."""
        parts = self.used.split(model.sizes, dim=-1)
        identified = torch.stack([part.all(dim=-1) for part in parts], dim=-1)
        repeated = [
            each.expand(len(self.z), *each.shape).flatten(0, 1)
            for each in (self.features, identified, self.valid)
        ]
        return repeated[0], self.z.flatten(0, 1), *repeated[1:]
