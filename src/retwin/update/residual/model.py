"""`ResidualModel`: the Residual Generator (RG), Eq. 6–8: what was commanded in, a law of z out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.data.segments import Segments
from retwin.data.trajectories import Channels
from retwin.errors import InputError
from retwin.nets.mixtures import BernoulliHead, Blocks
from retwin.nets.networks import Standardise
from retwin.nets.training import Fit
from retwin.serialisation.configs import from_config, to_config
from retwin.serialisation.models import read_model, write_model
from retwin.update.corrections import OPERATORS, Context, Correction
from retwin.update.residual.settings import DENSITIES, Density
from retwin.update.surrogate import Surrogate

__all__ = ["ResidualModel", "describe", "segment"]


class ResidualModel(nn.Module):
    """Call it on a `Context`: out comes a torch `Distribution` over z (n, M, d_z).

    Holds its correction operator, so that it knows what z means.
    """

    bounds: Tensor
    shift: Tensor
    scale: Tensor
    persistence: Tensor

    def __init__(
        self,
        correction: Correction,
        density: Density,
        *,
        inputs: Channels,
        outputs: Channels,
        segmentation: str = "commands",
    ) -> None:
        super().__init__()
        self.correction = correction
        self.density = density
        self.inputs = inputs
        self.outputs = outputs
        self.segmentation = segmentation
        if getattr(correction, "resolution", "") != "segment":
            raise InputError(
                "correction",
                expected="an operator with one z per movement",
                got=repr(correction),
                remedy="use DelayOffset, CommandSpace, or a Chain of one with a SampledSensor; or, "
                "for one z per sample, a SequenceMixture as the density",
            )
        self.latent = correction.latent(inputs, outputs)
        self.emulated = False
        self.timing: NDArray = np.empty((0, 0))
        self.fitted: Fit | None = None
        features = 3 * (len(inputs) + len(outputs)) + 2
        self.before = Standardise(features)
        layers: list[nn.Module] = []
        width = features
        for following in density.hidden:
            layers += [nn.Linear(width, following), nn.SiLU(), nn.Dropout(density.dropout)]
            width = following
        self.encoder = nn.Sequential(*layers)
        blocks = correction.heads(inputs, outputs)
        self.heads = nn.ModuleList(
            density.head(width, block.width)
            if block.kind == "mixture"
            else BernoulliHead(width, block.width)
            for block in blocks
        )
        self.sizes = [block.width for block in blocks]
        for name in ("bounds", "shift", "scale"):
            self.register_buffer(name, torch.ones(len(self.latent)))
        self.register_buffer("persistence", torch.zeros(len(self.latent)))

    def context(
        self,
        surrogate: Surrogate,
        commands: NDArray,
        segments: Segments | None = None,
        *,
        faulty_commands: NDArray | None = None,
        frozen: NDArray | None = None,
    ) -> Context:
        """What this model is called on, for commands (n, T, d_u), movements found by its rule."""
        if segments is None or self.segmentation == "path":
            nominal = surrogate.predict(commands) if self.segmentation == "path" else commands
            segments = segment(commands, nominal, self.segmentation)
        return Context.of(
            surrogate,
            commands,
            segments,
            rate=surrogate.rate,
            faulty_commands=faulty_commands,
            frozen=frozen,
        )

    def forward(self, context: Context) -> Blocks:
        """q_ψ(z | u, ŷ), in physical units."""
        return self.distribution(describe(context))

    def parts(self) -> Iterator[tuple[Any, slice]]:
        """Every head, and where in z its block lies."""
        begin = 0
        for head, size in zip(self.heads, self.sizes, strict=True):
            yield head, slice(begin, begin + size)
            begin += size

    def distribution(self, features: Tensor) -> Blocks:
        """q_ψ for described movements (..., F), see `describe`."""
        encoded = self.encoder(self.before(features))
        parts = zip(
            self.heads, self.shift.split(self.sizes), self.scale.split(self.sizes), strict=True
        )
        return Blocks([head(encoded, shift, scale) for head, shift, scale in parts])

    @torch.no_grad()
    def mean(self, context: Context) -> Tensor:
        """The mean z̄ (n, M, d_z) of Eq. 8, within b."""
        return self(context).mean.clamp(-self.bounds, self.bounds)

    @torch.no_grad()
    def sample(self, context: Context, *, generator: torch.Generator) -> Tensor:
        """Draws of z (n, M, d_z), see `drawn`."""
        return self.drawn(self(context), generator=generator)

    def drawn(self, law: Blocks, *, generator: torch.Generator) -> Tensor:
        """Draws of z (n, M, d_z) clipped at b, differentiable: regularising z̄ bounds no samples.

        Errors persist within a trajectory: the noise of its movements has a part in common, such
        that normal scores of z correlate by `persistence`. What each movement's z is distributed
        like does not change by that.
        """
        shape = law.batch_shape
        uniform = torch.rand(*shape, len(law.blocks), generator=generator).to(self.bounds)
        own = torch.randn(*shape, len(self.latent), generator=generator).to(self.bounds)
        if self.persistence.any():
            common = torch.randn(shape[0], 1, len(self.latent), generator=generator).to(own)
            own = self.persistence.sqrt() * common + (1 - self.persistence).sqrt() * own
        return law.from_noise(uniform, own).clamp(-self.bounds, self.bounds)

    def save(self, folder: str | Path) -> None:
        """Write weights and description, see `retwin.serialisation.models`."""
        about = {
            "correction": to_config(self.correction, OPERATORS),
            "density": to_config(self.density, DENSITIES),
            "inputs": vars(self.inputs),
            "outputs": vars(self.outputs),
            "segmentation": self.segmentation,
            "emulated": self.emulated,
            "timing": [[None if np.isnan(t) else t for t in row] for row in self.timing],
            "fitted": None if self.fitted is None else asdict(self.fitted),
        }
        with write_model(folder, "residual", about, self.state_dict()):
            pass

    @classmethod
    def load(cls, folder: str | Path) -> ResidualModel:
        """Read what `save` wrote; InputError when it is not a residual model or damaged."""
        about, weights = read_model(folder, "residual")
        model = cls(
            from_config(about["correction"], OPERATORS),
            from_config(about["density"], DENSITIES),
            inputs=Channels.of(about["inputs"]),
            outputs=Channels.of(about["outputs"]),
            segmentation=about["segmentation"],
        )
        model.load_state_dict(weights)
        model.emulated = about["emulated"]
        model.timing = np.array(about["timing"], dtype=float)
        model.fitted = Fit.of(about["fitted"])
        return model.eval()


def describe(context: Context) -> Tensor:
    """What the RG may know of each movement, (n, M, F).

    Commands and nominal output before, amid and after the motion; length of the motion and of the
    steady part in s. Always of the clean commands: the RG is not told of faults.
    """
    segments = context.segments
    start, settle, stop = (
        torch.as_tensor(times) for times in (segments.start, segments.settle, segments.stop)
    )
    last = segments.steps - 1
    columns = []
    for when in (start, (start + settle) / 2, settle):
        index = when.round().long().clamp(0, last)[..., None]
        for values in (context.commands, context.nominal):
            columns.append(values.gather(1, index.expand(-1, -1, values.shape[2])))
    lengths = torch.stack([settle - start, stop - settle], dim=-1) / context.rate
    return torch.cat([*columns, lengths.to(context.nominal)], dim=-1)


def segment(commands: NDArray, nominal: NDArray, rule: str = "commands") -> Segments:
    """Movements by `rule`: "commands" from command events, "path" from the nominal path's speed."""
    if rule not in ("commands", "path"):
        raise InputError(
            "segments",
            expected="'commands' or 'path'",
            got=repr(rule),
            remedy="use 'path' for a twin without command events",
        )
    return Segments.from_commands(commands) if rule == "commands" else Segments.from_path(nominal)
