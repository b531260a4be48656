"""`SequenceResidual`: the RG per time step (Eq. 6 over t): past u and ŷ in, a law of z_t out.

Several members, each a causal network that did not see other parts of the data, make one law. In
time, z is autoregressive: the normal score of z_t is drawn given that of z_{t-1}. So trajectories
are coherent while each z_t keeps its law, and nothing learns to copy a z_{t-1} that it will not be
given when it simulates.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.signal import lfilter
from torch import Tensor, nn

from retwin.data.segments import Segments
from retwin.data.trajectories import Channels
from retwin.errors import InputError
from retwin.nets.mixtures import Blocks, GaussianMixture, MixtureHead
from retwin.nets.networks import LSTM, NETWORKS, Network, Standardise
from retwin.nets.training import Fit, Training
from retwin.serialisation.configs import from_config, to_config
from retwin.serialisation.models import read_model, write_model
from retwin.update.corrections import OPERATORS, Context, Correction
from retwin.update.surrogate import Surrogate

__all__ = ["Member", "SequenceMixture", "SequenceResidual", "past", "trusted", "widened"]


@dataclass(frozen=True, kw_only=True)
class SequenceMixture:
    """A mixture of Gaussians at every sample, given the past; how it looks and learns.

    Parameters
    ----------
    network: a causal sequence network, `LSTM` or `TCN`, that sums up the past of u and ŷ.
    features: numbers that it tells the mixture of each sample.
    components: K of Eq. 6, for each member.
    dropout: of those numbers.
    smoothness, boundedness: λ_s and λ_b of Eq. 10, on z̄ in standard units (Eq. 9 over t).
    members: networks; each is judged on another part of the data, which it does not learn from.
    block, gap: samples of a part of a record that is held out, and of those beside it that are not
        learned from either, as they say nearly the same. With as many records as members, whole
        records are held out.
    window, burn_in: samples of a window to learn from; those at its begin that only warm the
        network up, the record's own begin apart.
    moderation: β of β-NLL (Seitzer et al. 2022): at 0 it is the likelihood, which learns least
        where it errs most; at 1 the mean learns as by least squares.
    refit: whether members learn anew from all data once they are judged; else each is kept without
        what it held out.
    persistent: whether z_t is drawn given z_{t-1}; else draws are independent in time.
    training: epochs, rate; a batch is so many windows. None stops early.

    """

    network: Network = LSTM(32)  # noqa: RUF009 - frozen
    features: int = 16
    components: int = 2
    dropout: float = 0.1
    smoothness: float = 0.01
    boundedness: float = 1.0
    members: int = 8
    block: int = 32
    gap: int = 8
    window: int = 192
    burn_in: int = 64
    moderation: float = 0.5
    refit: bool = True
    persistent: bool = True
    training: Training = Training(  # noqa: RUF009 - frozen
        max_epochs=80, batch_size=6, learning_rate=5e-3, weight_decay=0.1
    )

    def __post_init__(self) -> None:
        counts = (self.features, self.components, self.block)
        sound = (
            min(counts) >= 1
            and self.members >= 2
            and self.gap >= 0
            and 0 <= self.burn_in < self.window
            and 0 <= self.dropout < 1
            and 0 <= self.moderation <= 1
        )
        if not sound:
            raise InputError(
                "density",
                expected="members of at least 2, features, components and block of at least 1, "
                "burn_in below window, dropout and moderation from 0 to 1",
                got=repr(self),
                remedy="leave out what you do not need to change",
            )


CONFIGS: tuple[type, ...] = (SequenceMixture, Training, *NETWORKS)
"""Those that a model folder may name."""


class Member(nn.Module):
    """One causal network with its heads: standardised past in, laws of the blocks of z_t out."""

    def __init__(self, density: SequenceMixture, inputs: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.encoder = nn.Sequential(
            density.network.build(inputs, density.features), nn.SiLU(), nn.Dropout(density.dropout)
        )
        self.heads = nn.ModuleList(
            MixtureHead(density.features, width, density.components) for width in widths
        )

    def forward(
        self, past: Tensor, shift: Sequence[Tensor], scale: Sequence[Tensor]
    ) -> list[GaussianMixture]:
        """The law of each block (n, T), in physical units."""
        told = self.encoder(past)
        return [head(told, *unit) for head, *unit in zip(self.heads, shift, scale, strict=True)]


class SequenceResidual(nn.Module):
    """Call it on a `Context`: out comes a torch `Distribution` over z (n, T, d_z), all members'.

    Has what a `ResidualModel` has, for an operator with one z per sample.
    """

    bounds: Tensor
    shift: Tensor
    scale: Tensor
    trust: Tensor
    spread: Tensor
    persistence: Tensor

    def __init__(
        self,
        correction: Correction,
        density: SequenceMixture,
        *,
        inputs: Channels,
        outputs: Channels,
    ) -> None:
        super().__init__()
        blocks = correction.heads(inputs, outputs)
        kinds = {block.kind for block in blocks}
        if correction.resolution != "step" or kinds != {"mixture"}:
            raise InputError(
                "correction",
                expected="an operator with one z per sample, none of it an event",
                got=repr(correction),
                remedy="use Additive, or a density such as Mixture for one z per movement",
            )
        self.correction = correction
        self.density = density
        self.inputs = inputs
        self.outputs = outputs
        self.segmentation = "commands"
        self.latent = correction.latent(inputs, outputs)
        self.sizes = [block.width for block in blocks]
        self.emulated = False
        self.timing: NDArray = np.empty((0, 0))
        self.fitted: Fit | None = None
        self.before = Standardise(len(inputs) + len(outputs))
        self.members = self.fresh()
        for name in ("bounds", "shift", "scale", "trust"):
            self.register_buffer(name, torch.ones(len(self.latent)))
        self.register_buffer("spread", torch.ones(()))
        self.register_buffer("persistence", torch.zeros(len(self.latent)))

    def fresh(self) -> nn.ModuleList:
        """Members that have learned nothing."""
        width = len(self.inputs) + len(self.outputs)
        return nn.ModuleList(
            Member(self.density, width, self.sizes) for _ in range(self.density.members)
        )

    def context(
        self,
        surrogate: Surrogate,
        commands: NDArray,
        segments: Segments | None = None,
        *,
        faulty_commands: NDArray | None = None,
        frozen: NDArray | None = None,
    ) -> Context:
        """What this model is called on, for commands (n, T, d_u)."""
        parts = Segments.from_commands(commands) if segments is None else segments
        return Context.of(
            surrogate,
            commands,
            parts,
            rate=surrogate.rate,
            faulty_commands=faulty_commands,
            frozen=frozen,
        )

    def forward(self, context: Context) -> Blocks:
        """q_ψ(z_t | past of u and ŷ): every member as likely as the others."""
        laws = list(self.laws(past(context)))
        return Blocks([_together([law[block] for law in laws]) for block in range(len(self.sizes))])

    def laws(self, features: Tensor) -> Iterator[list[GaussianMixture]]:
        """What each member says of the past (n, T, F): a law for each block of z.

        Believed as far as members proved right where they had not looked.
        """
        parts = self.shift.split(self.sizes), self.trust.split(self.sizes)
        told = (self.told(member, features) for member in self.members)
        return (widened(trusted(laws, *parts), self.spread) for laws in told)

    def told(self, member: nn.Module, features: Tensor) -> list[GaussianMixture]:
        """What one member says, believed as it is."""
        units = self.shift.split(self.sizes), self.scale.split(self.sizes)
        laws: list[GaussianMixture] = member(self.before(features), *units)
        return laws

    @torch.no_grad()
    def mean(self, context: Context) -> Tensor:
        """The mean z̄ (n, T, d_z) of Eq. 8, within b."""
        return self(context).mean.clamp(-self.bounds, self.bounds)

    @torch.no_grad()
    def sample(self, context: Context, *, generator: torch.Generator) -> Tensor:
        """Draws of z (n, T, d_z), clipped at b: one member for each trajectory, then z_t in turn.

        Which component is drawn, and where in it, has a normal score that is autoregressive with
        `persistence`; so z_t is distributed as the law says, whatever z_{t-1} was.
        """
        laws = list(self.laws(past(context)))
        n, steps = laws[0][0].batch_shape
        who = torch.randint(len(laws), (n,), generator=generator)
        chosen = Blocks(
            [_picked([law[block] for law in laws], who) for block in range(len(self.sizes))]
        )
        first = torch.stack([part[0] for part in self.persistence.split(self.sizes)])
        which = _persisting(torch.randn(n, steps, len(first), generator=generator), first)
        where = _persisting(
            torch.randn(n, steps, len(self.latent), generator=generator), self.persistence
        )
        z = chosen.from_noise(torch.special.ndtr(which), where)
        return z.clamp(-self.bounds, self.bounds)

    def save(self, folder: str | Path) -> None:
        """Write weights and description, see `retwin.serialisation.models`."""
        about = {
            "correction": to_config(self.correction, OPERATORS),
            "density": to_config(self.density, CONFIGS),
            "inputs": vars(self.inputs),
            "outputs": vars(self.outputs),
            "emulated": self.emulated,
            "fitted": None if self.fitted is None else asdict(self.fitted),
        }
        with write_model(folder, "sequence residual", about, self.state_dict()):
            pass

    @classmethod
    def load(cls, folder: str | Path) -> SequenceResidual:
        """Read what `save` wrote; InputError when it is no such model or damaged."""
        about, weights = read_model(folder, "sequence residual")
        model = cls(
            from_config(about["correction"], OPERATORS),
            from_config(about["density"], CONFIGS),
            inputs=Channels.of(about["inputs"]),
            outputs=Channels.of(about["outputs"]),
        )
        model.load_state_dict(weights)
        model.emulated = about["emulated"]
        model.fitted = Fit.of(about["fitted"])
        return model.eval()


def past(context: Context) -> Tensor:
    """What the RG may know of each sample: clean commands and nominal output, (n, T, d_u + d_y)."""
    return torch.cat([context.commands.to(context.nominal), context.nominal], dim=-1)


def trusted(
    laws: Sequence[GaussianMixture], shift: Sequence[Tensor], trust: Sequence[Tensor]
) -> list[GaussianMixture]:
    """The same laws, their means at `shift` plus that share `trust` (d,) of their way from it."""
    moved = []
    for law, middle, share in zip(laws, shift, trust, strict=True):
        back = (1 - share) * (law.mean - middle)
        means = law.means - back.unsqueeze(-2)
        moved.append(GaussianMixture(law.mixture_distribution.logits, means, law.factor))
    return moved


def widened(laws: Sequence[GaussianMixture], spread: Tensor | float) -> list[GaussianMixture]:
    """The same laws, every component `spread` times as wide."""
    return [
        GaussianMixture(law.mixture_distribution.logits, law.means, spread * law.factor)
        for law in laws
    ]


def _together(laws: Sequence[GaussianMixture]) -> GaussianMixture:
    """One mixture of several, each with the same weight."""
    logits = [law.mixture_distribution.logits.log_softmax(dim=-1) for law in laws]
    return GaussianMixture(
        torch.cat(logits, dim=-1),
        torch.cat([law.means for law in laws], dim=-2),
        torch.cat([law.factor for law in laws], dim=-3),
    )


def _picked(laws: Sequence[GaussianMixture], who: Tensor) -> GaussianMixture:
    """For each trajectory the law of one of several, `who` (n,)."""
    row = torch.arange(len(who))
    told: Any = zip(
        *((law.mixture_distribution.logits, law.means, law.factor) for law in laws), strict=True
    )
    return GaussianMixture(*(torch.stack(part)[who, row] for part in told))


def _persisting(noise: Tensor, persistence: Tensor) -> Tensor:
    """White noise (n, T, d) as a stationary autoregression of unit variance, φ (d,)."""
    made = noise.numpy().astype(np.float64)
    for component, share in enumerate(persistence.double().tolist()):
        made[:, 1:, component] *= np.sqrt(1 - share**2)
        made[..., component] = lfilter([1.0], [1.0, -share], made[..., component], axis=1)
    return torch.as_tensor(made).to(noise)
