"""`ResidualModel`: the Residual Generator (RG), Eq. 6–8, with one z per segment."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.catalog import DENSITIES, classes
from retwin.checks import one_of, require
from retwin.data.segments import Segments
from retwin.data.trajectories import Channels
from retwin.nets.mixtures import BernoulliHead, Blocks
from retwin.nets.networks import Standardise
from retwin.nets.training import Fit
from retwin.serialisation.configs import from_config, to_config
from retwin.serialisation.models import read_model, write_model
from retwin.update.corrections import Context, Correction
from retwin.update.residual.former import read_correction, written_correction
from retwin.update.residual.settings import Density
from retwin.update.surrogate import Surrogate

__all__ = ["ResidualModel", "describe", "segment"]


class ResidualModel(nn.Module):
    """The distribution of z (n, M, d_z) given a `Context`: call it to get a torch distribution.

    Parameters
    ----------
    correction : Correction
        The operator g, with one z per segment.
    density : Density
        Settings of the distribution and of its encoder.
    inputs, outputs : Channels
        Channels of the commands and of the outputs.
    segmentation : str
        Rule by which segments are found, see `segment`.

    Attributes
    ----------
    latent : Channels
        Names and units of the components of z.
    emulated, timing, fitted
        See `Residual`.

    Raises
    ------
    InputError
        The operator has no z per segment.

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
        require(
            getattr(correction, "resolution", "") == "segment",
            "correction",
            expected="an operator with one z per segment",
            got=repr(correction),
            remedy="use DelayOffset, CommandSpace, or a Chain of one with a SampledSensor; or, for "
            "one z per sample, a SequenceMixture as the density",
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
        """The context of commands (n, T, d_u), with segments by this model's rule unless given."""
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
        """The distribution q_ψ(z | u, ŷ), in physical units."""
        return self.distribution(describe(context))

    def parts(self) -> Iterator[tuple[Any, slice]]:
        """Each head, and the slice of z that its block is."""
        begin = 0
        for head, size in zip(self.heads, self.sizes, strict=True):
            yield head, slice(begin, begin + size)
            begin += size

    def distribution(self, features: Tensor) -> Blocks:
        """The distribution q_ψ for features (..., F) of segments, see `describe`."""
        encoded = self.encoder(self.before(features))
        parts = zip(
            self.heads, self.shift.split(self.sizes), self.scale.split(self.sizes), strict=True
        )
        return Blocks([head(encoded, shift, scale) for head, shift, scale in parts])

    @torch.no_grad()
    def mean(self, context: Context) -> Tensor:
        """The mean z̄ (n, M, d_z) of Eq. 8, clipped at b."""
        return self(context).mean.clamp(-self.bounds, self.bounds)

    @torch.no_grad()
    def sample(self, context: Context, *, generator: torch.Generator) -> Tensor:
        """Draws of z (n, M, d_z), see `drawn`."""
        return self.drawn(self(context), generator=generator)

    def drawn(self, distribution: Blocks, *, generator: torch.Generator) -> Tensor:
        """Draws of z (n, M, d_z), clipped at b, since the penalty on z̄ does not bound samples.

        The noise of the segments of a trajectory has a common part, so that the normal scores of z
        correlate by `persistence`. The marginal distribution of each segment's z is unchanged.
        Draws are differentiable.
        """
        shape = distribution.batch_shape
        uniform = torch.rand(*shape, len(distribution.blocks), generator=generator).to(self.bounds)
        own = torch.randn(*shape, len(self.latent), generator=generator).to(self.bounds)
        if self.persistence.any():
            common = torch.randn(shape[0], 1, len(self.latent), generator=generator).to(own)
            own = self.persistence.sqrt() * common + (1 - self.persistence).sqrt() * own
        return distribution.from_noise(uniform, own).clamp(-self.bounds, self.bounds)

    def save(self, folder: str | Path) -> None:
        """Write the weights and the description, see `retwin.serialisation.models`."""
        about = {
            **written_correction(self.correction),
            "density": to_config(self.density, classes(DENSITIES, Density)),
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
    def load(cls, folder: str | Path, rate: float | None = None) -> ResidualModel:
        """Read what `save` wrote; `rate` in Hz is for files from before version 0.1.0 only.

        Raises InputError if the folder holds no residual model or is damaged.
        """
        about, weights = read_model(folder, "residual")
        model = cls(
            read_correction(about, rate),
            from_config(about["density"], classes(DENSITIES, Density)),
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
    """The features (n, M, F) of each segment that the residual model is conditioned on.

    These are commands and nominal outputs at the start, the middle and the end of the motion, and
    the durations of the motion and of the steady part in s, all of the commands without faults.
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
    """The segments of trajectories.

    Parameters
    ----------
    commands, nominal : NDArray
        (n, T, d_u) and (n, T, d_y).
    rule : str
        "commands" finds them from command events, "path" from the speed of the nominal output.

    Returns
    -------
    Segments
        One row per trajectory.

    Raises
    ------
    InputError
        An unknown rule.

    """
    one_of("segments", rule, ("commands", "path"), remedy="use 'path' without command events")
    return Segments.from_commands(commands) if rule == "commands" else Segments.from_path(nominal)
