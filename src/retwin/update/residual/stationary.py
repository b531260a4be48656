"""`StationaryResidual`: errors of a twin as stationary noise, whatever the commands are."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from retwin.nets.mixtures import Blocks, GaussianMixture
from retwin.nets.training import Fit
from retwin.update.corrections import Context
from retwin.update.residual.residual import SMALLEST, Residual
from retwin.update.residual.sequence import autoregressive
from retwin.update.residual.sequence_fitting import MAX_PERSISTENCE
from retwin.update.residual.targets import ResidualTask


@dataclass(frozen=True)
class StationaryNoise:
    """Gaussian errors with mean 0 that an autoregression of first order correlates in time.

    It corrects nothing: it states how far the outputs of a twin are from measured ones.
    """


class StationaryResidual(Residual[StationaryNoise]):
    """The distribution of z (n, T, d_z), which depends on no command.

    Parameters
    ----------
    correction : Correction
        The operator g, with one z per sample.
    density : StationaryNoise
        It has no settings.
    inputs, outputs, segmentation
        See `Residual`.

    Raises
    ------
    InputError
        The operator has no z per sample, or an event among its components.

    """

    kind = "stationary residual"

    def _build(self) -> None:
        self.spread = nn.Buffer(torch.ones(len(self.latent)))

    def forward(self, context: Context) -> Blocks:
        """The same Gaussian distribution at every sample."""
        shape, blocks = context.nominal.shape[:2], []
        for scale in (self.spread * self.scale).split(self.sizes):
            mean = scale.new_zeros(*shape, 1, len(scale))
            factor = scale.diag().expand(*shape, 1, -1, -1)
            blocks.append(GaussianMixture(scale.new_zeros(*shape, 1), mean, factor))
        return Blocks(blocks)

    @torch.no_grad()
    def sample(self, context: Context, *, generator: torch.Generator) -> Tensor:
        """Draws of z (n, T, d_z)."""
        shape = (*context.nominal.shape[:2], len(self.latent))
        noise = torch.randn(*shape, generator=generator, device=generator.device)
        return self.spread * self.scale * autoregressive(noise, self.persistence)


def fit_stationary(task: ResidualTask, density: StationaryNoise) -> StationaryResidual:
    """The noise of measured records, given their discrepancies; it is not random."""
    used, found = task.used, task.found
    model = StationaryResidual(task.correction, density, inputs=used.inputs, outputs=used.outputs)
    seen, z = found.identified, torch.where(found.identified, found.z, 0.0).double()
    power = z.square().sum(dim=(0, 1)) / seen.sum(dim=(0, 1)).clamp_min(1)
    both = seen[:, 1:] & seen[:, :-1]
    later, now = z[:, 1:] * both, z[:, :-1] * both
    size = 0.5 * (later.square() + now.square()).sum(dim=(0, 1))
    persistence = (later * now).sum(dim=(0, 1)) / size.clamp_min(1e-300)
    model.scale.copy_(power.sqrt().clamp_min(SMALLEST))
    model.persistence.copy_(persistence.clamp(0.0, MAX_PERSISTENCE))
    model.bounds.fill_(torch.inf)
    pairs = zip(model.latent.names, power.sqrt().tolist(), strict=True)
    figures = {f"rmse_{name}": value for name, value in pairs} | {"samples": float(seen.sum())}
    model.fitted = Fit(figures, {}, 0, "errors of the twin as noise")
    return model
