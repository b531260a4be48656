"""Training data of the residual model: z* of each segment, or draws from its posterior."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from retwin.nets.mixtures import BernoulliHead
from retwin.update.corrections import Context, Discrepancy
from retwin.update.residual.model import ResidualModel, describe

__all__ = ["Targets"]

DRAWS = 20
"""Draws of z per trajectory from its posterior. They represent the uncertainty that outputs leave;
with twenty the error of a mean is below a quarter of a standard deviation."""
MAX_PERSISTENCE = 0.9
"""Largest persistence, since a few trajectories cannot distinguish a larger one from 1."""


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
    posterior : bool
        Whether z are draws from a posterior.

    """

    features: Tensor
    z: Tensor
    identified: Tensor
    valid: Tensor
    posterior: bool

    @classmethod
    def of(
        cls, model: ResidualModel, context: Context, found: Discrepancy, *, seed: int
    ) -> Targets:
        """The training data from inferred discrepancies `found`."""
        valid = torch.as_tensor(context.segments.valid)
        if not found.posterior:
            return cls(describe(context), found.z.float()[None], found.identified, valid, False)
        generator = torch.Generator().manual_seed(seed)
        values, vectors = torch.linalg.eigh(found.covariance)
        root = vectors * values.clamp_min(0).sqrt()[..., None, :]
        noise = torch.randn(DRAWS, *found.z.shape, generator=generator, dtype=found.z.dtype)
        drawn = found.z + torch.einsum("nmij,rnmj->rnmi", root, noise)
        for head, part in model.parts():
            # An event is decided; it has no variance.
            if isinstance(head, BernoulliHead):
                drawn[..., part] = found.z[..., part]
        all_valid = valid[..., None].expand_as(found.z)
        return cls(describe(context), (drawn * valid[..., None]).float(), all_valid, valid, True)

    def examples(self, model: ResidualModel, rows: Tensor) -> tuple[Tensor, ...]:
        """Features, z, identified (..., heads) and valid; each draw of z is an example."""
        parts = self.identified[rows].split(model.sizes, dim=-1)
        identified = torch.stack([part.all(dim=-1) for part in parts], dim=-1)
        repeated = [
            each.expand(len(self.z), *each.shape).flatten(0, 1)
            for each in (self.features[rows], identified, self.valid[rows])
        ]
        return repeated[0], self.z[:, rows].flatten(0, 1), *repeated[1:]

    @torch.no_grad()
    def persistence(self, model: ResidualModel) -> Tensor:
        """Intraclass correlation (d_z,) of normal scores between the segments of a trajectory.

        By one-way analysis of variance, shrunk towards 0 where trajectories are few.
        """
        scores = model.distribution(self.features).normal_scores(self.z)
        score = torch.where(self.valid[..., None], scores, torch.nan).mean(dim=0)
        several = self.valid.sum(dim=1) > 1
        if several.sum() < 3:
            return torch.zeros(len(model.latent))
        score, count = score[several], self.valid.sum(dim=1)[several][:, None]
        mean = score.nanmean(dim=1)
        within = torch.nansum((score - mean[:, None]).square(), dim=(0, 1)) / (count - 1).sum()
        between = (count * (mean - mean.mean(dim=0)).square()).sum(dim=0) / (len(mean) - 1)
        size = count.float().mean()
        correlation = (between - within) / (between + (size - 1) * within).clamp_min(1e-9)
        shrunk = correlation * (len(mean) - 1) / (len(mean) + 3)
        return shrunk.nan_to_num(0.0).clamp(0.0, MAX_PERSISTENCE)
