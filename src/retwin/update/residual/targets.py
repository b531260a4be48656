"""What the RG learns from: z* of every movement, or draws from its posterior."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from retwin.nets.mixtures import BernoulliHead
from retwin.update.corrections import Context, Discrepancy
from retwin.update.residual.model import ResidualModel, describe

__all__ = ["Targets"]

DRAWS = 20
"""Draws of z per trajectory from its posterior: together they tell what the outputs do not."""


@dataclass(frozen=True, eq=False)
class Targets:
    """Features and z of n trajectories of M movements, R draws of each.

    Attributes
    ----------
    features: (n, M, F), see `describe`.
    z: (R, n, M, d_z).
    told: (n, M, d_z) bool, what may be learned from.
    valid: (n, M) bool, movements that exist.
    posterior: whether z are draws from a posterior.

    """

    features: Tensor
    z: Tensor
    told: Tensor
    valid: Tensor
    posterior: bool

    @classmethod
    def of(
        cls, model: ResidualModel, context: Context, found: Discrepancy, *, seed: int
    ) -> Targets:
        """Those of inferred discrepancies."""
        valid = torch.as_tensor(context.segments.valid)
        if not found.posterior:
            return cls(describe(context), found.z.float()[None], found.identified, valid, False)
        generator = torch.Generator().manual_seed(seed)
        values, vectors = torch.linalg.eigh(found.covariance)
        root = vectors * values.clamp_min(0).sqrt()[..., None, :]
        noise = torch.randn(DRAWS, *found.z.shape, generator=generator, dtype=found.z.dtype)
        drawn = found.z + torch.einsum("nmij,rnmj->rnmi", root, noise)
        for head, part in model.parts():
            # What is decided, one way or the other, has no width to draw from.
            if isinstance(head, BernoulliHead):
                drawn[..., part] = found.z[..., part]
        told = valid[..., None].expand_as(found.z)
        return cls(describe(context), (drawn * valid[..., None]).float(), told, valid, True)

    def examples(self, model: ResidualModel, rows: Tensor) -> tuple[Tensor, ...]:
        """Features, z, known (…, heads) and valid of some trajectories, every draw an example."""
        parts = self.told[rows].split(model.sizes, dim=-1)
        known = torch.stack([part.all(dim=-1) for part in parts], dim=-1)
        repeated = [
            each.expand(len(self.z), *each.shape).flatten(0, 1)
            for each in (self.features[rows], known, self.valid[rows])
        ]
        return repeated[0], self.z[:, rows].flatten(0, 1), *repeated[1:]

    @torch.no_grad()
    def persistence(self, model: ResidualModel) -> Tensor:
        """How alike the movements of a trajectory err (d_z,): correlation of their normal scores.

        One-way analysis of variance, averaged over draws; shrunk where trajectories are few.
        """
        scores = model.distribution(self.features).normal_scores(self.z)
        score = torch.where(self.valid[..., None], scores, torch.nan).mean(dim=0)
        enough = self.valid.sum(dim=1) > 1
        if enough.sum() < 3:
            return torch.zeros(len(model.latent))
        score, count = score[enough], self.valid.sum(dim=1)[enough][:, None]
        own = score.nanmean(dim=1)
        within = torch.nansum((score - own[:, None]).square(), dim=(0, 1)) / (count - 1).sum()
        between = (count * (own - own.mean(dim=0)).square()).sum(dim=0) / (len(own) - 1)
        size = count.float().mean()
        alike = (between - within) / (between + (size - 1) * within).clamp_min(1e-9)
        return (alike * (len(own) - 1) / (len(own) + 3)).nan_to_num(0.0).clamp(0.0, 0.9)
