"""`SequenceResidual`: the Residual Generator with one z per sample (Eq. 6 over t).

It is an ensemble of causal networks, each trained without another part of the data, which predict
the distribution of z_t from the past of u and ŷ. Over time, the normal scores of z_t are an
autoregression: z is correlated in time while each z_t keeps its predicted distribution, and no
network is trained with a past z that it does not have in simulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.signal import lfilter
from torch import Tensor, nn

from retwin.checks import require
from retwin.nets.mixtures import Blocks, GaussianMixture, MixtureHead
from retwin.nets.networks import LSTM, Network, Standardise
from retwin.nets.training import Training
from retwin.update.corrections import Context
from retwin.update.residual.residual import Residual


@dataclass(frozen=True, kw_only=True)
class SequenceMixture:
    """A mixture of Gaussians at each sample, conditioned on the past.

    Parameters
    ----------
    network : Network
        Causal sequence network, `LSTM` or `TCN`, that encodes the past of u and ŷ.
    features : int
        Width of the encoding, at least 1.
    components : int
        K of Eq. 6 for each member, at least 1.
    dropout : float
        Dropout of the encoding, from 0 to below 1.
    smoothness, boundedness : float
        λ_s and λ_b of Eq. 10, on z̄ in standard units (Eq. 9 over t).
    members : int
        Networks of the ensemble, at least 2; each holds out another part of the data.
    block, margin : int
        Samples of a held-out part of a record, and samples on either side of it that are not
        trained on either, since they correlate with it. With at least as many records as members,
        whole records are held out.
    window, burn_in : int
        Samples of a training window, and those at its start that are not in the loss, since the
        state of the network has not settled, except at the start of a record.
    moderation : float
        β of β-NLL, from 0, the likelihood, to 1, at which the gradient of the mean is that of
        least squares.
    refit : bool
        Whether the members are trained anew on all data after the calibration on held-out parts.
    persistent : bool
        Whether z_t is drawn given z_{t-1}; otherwise draws are independent in time.
    training : Training
        Settings of the training of each member, without early stopping; `batch_size` counts
        windows.
    max_steps : int
        Steps of the optimiser, at least 1: long records are trained on for fewer epochs.

    Raises
    ------
    InputError
        A setting out of its range.

    References
    ----------
    Seitzer et al., "On the pitfalls of heteroscedastic uncertainty estimation with probabilistic
    neural networks", ICLR 2022.

    """

    network: Network = LSTM(32)  # noqa: RUF009 - frozen
    features: int = 16
    components: int = 2
    dropout: float = 0.1
    smoothness: float = 0.01
    boundedness: float = 1.0
    members: int = 8
    block: int = 32
    margin: int = 8
    window: int = 192
    burn_in: int = 64
    moderation: float = 0.5
    refit: bool = True
    persistent: bool = True
    training: Training = Training(  # noqa: RUF009 - frozen
        max_epochs=80, batch_size=6, learning_rate=5e-3, weight_decay=0.1
    )
    max_steps: int = 2000

    def __post_init__(self) -> None:
        counts = (self.features, self.components, self.block, self.max_steps)
        sound = (
            min(counts) >= 1
            and self.members >= 2
            and self.margin >= 0
            and 0 <= self.burn_in < self.window
            and 0 <= self.dropout < 1
            and 0 <= self.moderation <= 1
        )
        expected = "members of at least 2, features, components, block, max_steps of at least 1, "
        expected += "burn_in below window, dropout and moderation from 0 to 1"
        remedy = "leave out what you do not need to change"
        require(sound, "density", expected=expected, got=repr(self), remedy=remedy)


class Member(nn.Module):
    """One network of the ensemble, from the standardised past to distributions of z_t.

    Parameters
    ----------
    density : SequenceMixture
        Settings.
    inputs : int
        Channels of u and ŷ together.
    widths : sequence of int
        Number of components of each block of z.

    """

    def __init__(self, density: SequenceMixture, inputs: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.encoder = nn.Sequential(
            density.network.build(inputs, density.features), nn.SiLU(), nn.Dropout(density.dropout)
        )
        self.heads = nn.ModuleList(
            MixtureHead(density.features, width, density.components) for width in widths
        )


class SequenceResidual(Residual[SequenceMixture]):
    """The distribution of z (n, T, d_z) given a `Context`: call it to get a torch distribution.

    Parameters
    ----------
    correction : Correction
        The operator g, with one z per sample.
    density : SequenceMixture
        Settings.
    inputs, outputs, segmentation
        See `Residual`, also for the attributes that are not named here.

    Attributes
    ----------
    trust : Tensor
        (d_z,), factor from 0 to 1 by which means are shrunk towards `shift`.
    spread : Tensor
        (d_z,), factor by which standard deviations are multiplied.

    Raises
    ------
    InputError
        The operator has no z per sample, or an event among its components.

    """

    kind = "sequence residual"

    def _build(self) -> None:
        self.before = Standardise(len(self.inputs) + len(self.outputs))
        self.members = self.fresh()
        self.trust = nn.Buffer(torch.ones(len(self.latent)))
        self.spread = nn.Buffer(torch.ones(len(self.latent)))

    def fresh(self) -> nn.ModuleList:
        """Members with random initial weights."""
        width = len(self.inputs) + len(self.outputs)
        return nn.ModuleList(
            Member(self.density, width, self.sizes) for _ in range(self.density.members)
        )

    def forward(self, context: Context) -> Blocks:
        """The distribution q_ψ(z_t | past of u and ŷ), members with equal weights."""
        return Blocks([pool(block) for block in self.distributions(past(context))])

    def distributions(self, features: Tensor) -> list[GaussianMixture]:
        """The calibrated distribution (K, n, T) of each block for the past (n, T, F), by member."""
        units = (self.shift, self.trust, self.spread)
        shift, trust, spread = (each.split(self.sizes) for each in units)
        return scale_deviations(shrunk(self.predict(features), shift, trust), spread)

    def predict(self, features: Tensor) -> list[GaussianMixture]:
        """What K members predict for each block, (K, n, T), before calibration.

        Only the encoders run one after another: for networks this small, the time of everything
        else is that of calls, whatever the size of the arrays.
        """
        members: Any = self.members
        standard = self.before(features)
        encoded = [member.encoder(standard) for member in members]
        made = []
        units = zip(self.shift.split(self.sizes), self.scale.split(self.sizes), strict=True)
        for block, unit in enumerate(units):
            heads = [member.heads[block] for member in members]
            raw = [head.linear(each) for head, each in zip(heads, encoded, strict=True)]
            made.append(heads[0].mixture(torch.stack(raw), *unit))
        return made

    @torch.no_grad()
    def sample(self, context: Context, *, generator: torch.Generator) -> Tensor:
        """Draws of z (n, T, d_z), clipped at b, each trajectory from one member.

        The normal noise that selects the component, and that within it, is autoregressive with
        `persistence`, so each z_t has the predicted marginal distribution.
        """
        blocks = self.distributions(past(context))
        members, n, steps = blocks[0].batch_shape
        made: Any = {"generator": generator, "device": generator.device}
        chosen = torch.randint(members, (n,), **made)
        drawn_from = Blocks([pick(block, chosen) for block in blocks])
        first = torch.stack([part[0] for part in self.persistence.split(self.sizes)])
        of_components = autoregressive(torch.randn(n, steps, len(first), **made), first)
        noise = torch.randn(n, steps, len(self.latent), **made)
        of_values = autoregressive(noise, self.persistence)
        z = drawn_from.from_noise(torch.special.ndtr(of_components), of_values)
        return z.clamp(-self.bounds, self.bounds)


def past(context: Context) -> Tensor:
    """The features (n, T, d_u + d_y): commands without faults, and nominal outputs."""
    return torch.cat([context.commands.to(context.nominal), context.nominal], dim=-1)


def shrunk(
    blocks: Sequence[GaussianMixture], shift: Sequence[Tensor], trust: Sequence[Tensor]
) -> list[GaussianMixture]:
    """The mixtures with their means moved to `shift` plus `trust` (d,) times their distance."""
    moved = []
    for block, middle, factor in zip(blocks, shift, trust, strict=True):
        means = block.means - ((1 - factor) * (block.mean - middle)).unsqueeze(-2)
        moved.append(GaussianMixture(block.parts[0], means, block.factor))
    return moved


def scale_deviations(
    blocks: Sequence[GaussianMixture], spread: Sequence[Tensor]
) -> list[GaussianMixture]:
    """The mixtures with the standard deviations of all components multiplied by `spread` (d,)."""
    pairs = zip(blocks, spread, strict=True)
    return [GaussianMixture(*own.parts[:2], factor[:, None] * own.factor) for own, factor in pairs]


def pool(members: GaussianMixture) -> GaussianMixture:
    """The mixture (...) of K mixtures (K, ...) with equal weights."""
    logits, *others = members.parts
    parts = enumerate((logits.log_softmax(dim=-1), *others), start=2)
    return GaussianMixture(*(each.movedim(0, -d).flatten(-d, 1 - d) for d, each in parts))


def pick(members: GaussianMixture, chosen: Tensor) -> GaussianMixture:
    """For each trajectory the mixture (n, T) of the member `chosen` (n,) of K, (K, n, T)."""
    row = torch.arange(len(chosen), device=chosen.device)
    return GaussianMixture(*(part[chosen, row] for part in members.parts))


def autoregressive(noise: Tensor, coefficients: Tensor) -> Tensor:
    """A stationary first-order autoregression of unit variance from white noise (n, T, d)."""
    made = noise.cpu().numpy().astype(np.float64)
    for component, coefficient in enumerate(coefficients.double().tolist()):
        made[:, 1:, component] *= np.sqrt(1 - coefficient**2)
        made[..., component] = lfilter([1.0], [1.0, -coefficient], made[..., component], axis=1)
    return torch.from_numpy(made).to(noise)
