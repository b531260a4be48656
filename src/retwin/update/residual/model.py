"""`ResidualModel`: the Residual Generator (RG), Eq. 6–8, with one z per segment."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor, nn

from retwin.nets.mixtures import BernoulliHead, Blocks
from retwin.nets.networks import Standardise
from retwin.nets.student import Student, shared_factor
from retwin.update.corrections import Context
from retwin.update.corrections.delays import gather_samples
from retwin.update.residual.residual import Residual
from retwin.update.residual.settings import Density


class ResidualModel(Residual[Density]):
    """The distribution of z (n, M, d_z) given a `Context`: call it to get a torch distribution.

    Parameters
    ----------
    correction : Correction
        The operator g, with one z per segment.
    density : Density
        Settings of the distribution and of its encoder.
    inputs, outputs, segmentation
        See `Residual`, also for the attributes that are not named here.

    Attributes
    ----------
    spread : Tensor
        (d_z,), factor by which deviations from the mean are multiplied, 1 for events.

    Raises
    ------
    InputError
        The operator has no z per segment.

    """

    kind = "residual"
    resolution = "segment"
    wanted = "an operator with one z per segment"
    remedy = (
        "use DelayOffset, CommandSpace, or a Chain of one with a SampledSensor; or, for one z per "
        "sample, a SequenceMixture as the density"
    )

    def _build(self) -> None:
        features, density = 3 * (len(self.inputs) + len(self.outputs)) + 2, self.density
        self.before = Standardise(features)
        layers: list[nn.Module] = []
        width = features
        for following in density.hidden:
            layers += [nn.Linear(width, following), nn.SiLU(), nn.Dropout(density.dropout)]
            width = following
        self.encoder = nn.Sequential(*layers)
        self.heads = nn.ModuleList(
            density.head(width, block.width)
            if block.kind == "mixture"
            else BernoulliHead(width, block.width)
            for block in self.correction.heads(self.inputs, self.outputs)
        )
        self.spread = nn.Buffer(torch.ones(len(self.latent)))

    def forward(self, context: Context) -> Blocks:
        """The distribution q_ψ(z | u, ŷ), in physical units."""
        return self.distribution(describe(context))

    def parts(self) -> Iterator[tuple[Any, slice]]:
        """Each head, and the slice of z that its block is."""
        begin = 0
        for head, size in zip(self.heads, self.sizes, strict=True):
            yield head, slice(begin, begin + size)
            begin += size

    @property
    def events(self) -> Tensor:
        """(d_z,) bool, the components of z that are 0 or 1."""
        kinds = [isinstance(head, BernoulliHead) for head in self.heads]
        return torch.tensor(kinds).repeat_interleave(torch.tensor(self.sizes))

    @property
    def heavy_tailed(self) -> bool:
        """Whether the width of a block is uncertain, see `Student`."""
        return not all(map(math.isinf, self.degrees))

    def distribution(self, features: Tensor) -> Blocks:
        """The distribution q_ψ for features (..., F) of segments, see `describe`."""
        predicted = self.predict(features)
        # A graph that is exported has no branches that depend on values.
        if torch.compiler.is_compiling() or bool((self.spread != 1).any()):
            predicted = predicted.widened(self.spread)
        pairs = zip(predicted.blocks, self.degrees, strict=True)
        return Blocks([own if math.isinf(free) else Student(own, free) for own, free in pairs])

    def predict(self, features: Tensor) -> Blocks:
        """The distribution that the network predicts, before its calibration."""
        encoded = self.encoder(self.before(features))
        units = (each.split(self.sizes) for each in (self.shift, self.scale))
        parts = zip(self.heads, *units, strict=True)
        return Blocks([head(encoded, shift, scale) for head, shift, scale in parts])

    @torch.no_grad()
    def sample(self, context: Context, *, generator: torch.Generator) -> Tensor:
        """Draws of z (n, M, d_z), see `drawn`."""
        return self.drawn(self(context), generator=generator)

    def sampler(self, context: Context) -> Callable[[torch.Generator], Tensor]:
        """`sample` as a function of the generator: the distribution is not random."""
        distribution = self(context)
        return lambda generator: self.drawn(distribution, generator=generator)

    def drawn(self, distribution: Blocks, *, generator: torch.Generator) -> Tensor:
        """Draws of z (n, M, d_z), clipped at b, since the penalty on z̄ does not bound samples.

        The noise of the segments of a trajectory has a common part, so that the normal scores of z
        correlate by `persistence`, and they share the factor of `Student`. The marginal
        distribution of each segment's z is unchanged. Draws are differentiable.
        """
        (count, segments), blocks = distribution.batch_shape, len(distribution.blocks)
        made: Any = {"generator": generator, "device": generator.device}
        uniform = torch.rand(count, segments, blocks, **made).to(self.bounds)
        own = torch.randn(count, segments, len(self.latent), **made).to(self.bounds)
        if self.persistence.any():
            common = torch.randn(count, 1, len(self.latent), **made).to(own)
            own = self.persistence.sqrt() * common + (1 - self.persistence).sqrt() * own
        if self.heavy_tailed:
            uniform = shared_factor(torch.rand(count, 1, blocks, **made).to(own), uniform)
        return distribution.from_noise(uniform, own).clamp(-self.bounds, self.bounds)


def describe(context: Context) -> Tensor:
    """The features (n, M, F) of each segment that the residual model is conditioned on.

    These are commands and nominal outputs at the start, the middle and the end of the motion, and
    the durations of the motion and of the steady part in s, all of the commands without faults.
    """
    segments = context.segments
    start, settle, stop = map(torch.as_tensor, (segments.start, segments.settle, segments.stop))
    times = (start, (start + settle) / 2, settle)
    places = [each.round().long().clamp(0, segments.steps - 1) for each in times]
    values = (context.commands, context.nominal)
    columns = [gather_samples(each, place) for place in places for each in values]
    lengths = torch.stack([settle - start, stop - settle], dim=-1) / context.rate
    return torch.cat([*columns, lengths.to(context.nominal)], dim=-1)
