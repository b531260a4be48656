"""`Residual`: what residual models with one z per segment and with one z per sample share."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.catalog import CORRECTIONS, DENSITIES, NETWORKS, classes
from retwin.checks import finite, one_of, require
from retwin.data.segments import Segments
from retwin.data.trajectories import Channels
from retwin.nets.mixtures import Blocks
from retwin.nets.training import Fit
from retwin.serialisation.configs import from_config, to_config
from retwin.serialisation.models import read_model, save_model
from retwin.update.corrections import Context, Correction
from retwin.update.corrections.commands.machines import Learned
from retwin.update.surrogate import Surrogate

D = TypeVar("D")
SMALLEST = 1e-12
"""Smallest value taken for the largest |z*|: a millionth of it still has a square in float32."""
BOUND_MARGIN = 1.25
"""Default bound b of Eq. 9, over the largest |z*|."""


class Residual(nn.Module, ABC, Generic[D]):
    """The distribution of z given a `Context`: call it to get a torch distribution.

    Parameters
    ----------
    correction : Correction
        The operator g, which defines z.
    density : Density or SequenceMixture
        Settings of the distribution.
    inputs, outputs : Channels
        Channels of the commands and of the outputs.
    segmentation : str
        Rule by which segments are found, see `segment`.

    Attributes
    ----------
    latent : Channels
        Names and units of the components of z.
    sizes : list of int
        Widths of the blocks of z.
    bounds, shift, scale : Tensor
        (d_z,), b of Eq. 9, and the origin and unit of z.
    persistence : Tensor
        (d_z,), correlation of the normal scores of z, between the segments of a trajectory or from
        one sample to the next.
    degrees : list of float
        Degrees of freedom of the width of each block of z, see `Student`; infinite if it is known.
    emulated : bool
        Whether it was fitted to an emulated system instead of the real one.
    timing : NDArray
        (k, M) onsets, in samples, of the segments of the calibration trajectories.
    fitted : Fit or None
        Record of the training.
    learned : dict or None
        What the machine has shown to others of its kind, see `corrections.machines`; None where the
        correction learns nothing of that kind.

    """

    kind: ClassVar[str]
    """Kind of the saved model."""
    resolution: ClassVar[str] = "step"
    """That of the operators whose z it can have: with a z per sample, none of it is an event."""
    wanted: ClassVar[str] = "an operator with one z per sample, none of it an event"
    remedy: ClassVar[str] = "use Additive, or a density such as Mixture for one z per segment"
    spread: Tensor

    def __init__(
        self,
        correction: Correction,
        density: D,
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
        suits = getattr(correction, "resolution", "") == self.resolution
        if suits and self.resolution == "step":
            suits = all(each.kind == "mixture" for each in correction.heads(inputs, outputs))
        expected = self.wanted
        require(suits, "correction", expected=expected, got=repr(correction), remedy=self.remedy)
        self.latent = correction.latent(inputs, outputs)
        self.sizes = [head.width for head in correction.heads(inputs, outputs)]
        self.degrees = [math.inf] * len(self.sizes)
        self.emulated = False
        self.timing: NDArray = np.empty((0, 0))
        self.fitted: Fit | None = None
        self.learned: Learned | None = None
        self.bounds = nn.Buffer(torch.ones(len(self.latent)))
        self.shift = nn.Buffer(torch.ones(len(self.latent)))
        self.scale = nn.Buffer(torch.ones(len(self.latent)))
        self.persistence = nn.Buffer(torch.zeros(len(self.latent)))
        self._build()

    @abstractmethod
    def _build(self) -> None:
        """Make the networks, with random initial weights, and further buffers."""

    def context(
        self, surrogate: Surrogate, commands: NDArray, segments: Segments | None = None, **more: Any
    ) -> Context:
        """The context of commands (n, T, d_u), with segments by this model's rule unless given.

        `faulty_commands` and `frozen` are those of `Context.of`.
        """
        if segments is None or self.segmentation == "path":
            nominal = surrogate.predict(commands) if self.segmentation == "path" else commands
            segments = segment(commands, nominal, self.segmentation)
        return Context.of(surrogate, commands, segments, rate=surrogate.rate, **more)

    @abstractmethod
    def forward(self, context: Context) -> Blocks:
        """The distribution q_ψ of each z, in physical units."""

    @torch.no_grad()
    def mean(self, context: Context) -> Tensor:
        """The mean z̄ (n, M, d_z) of Eq. 8, clipped at b."""
        return self(context).mean.clamp(-self.bounds, self.bounds)

    def penalise(self, mean: Tensor, valid: Tensor) -> Tensor:
        """λ_s times the mean square step of z̄, plus λ_b times that of its excess over b (Eq. 9).

        Steps and excess are in units of `scale`; `density` holds λ_s and λ_b.

        Parameters
        ----------
        mean : Tensor
            (..., n, M, d_z), z̄ over M segments or samples.
        valid : Tensor
            (..., n, M) bool, what is averaged over.

        Returns
        -------
        Tensor
            (...).

        """
        density: Any = self.density
        step = (mean[..., 1:, :] - mean[..., :-1, :]) / self.scale
        beyond = torch.relu(mean.abs() - self.bounds) / self.scale
        roughness = mean_where(step.square().sum(-1), valid[..., 1:] & valid[..., :-1])
        excess = mean_where(beyond.square().sum(-1), valid)
        return density.smoothness * roughness + density.boundedness * excess

    def take_bounds(self, bounds: NDArray | None) -> None:
        """Take the bounds b (d_z,) of a user, if any; InputError unless all are positive."""
        if bounds is None:
            return
        fits = np.shape(bounds) == self.bounds.shape and (np.asarray(bounds) > 0).all()
        expected = f"one positive bound for each of {', '.join(self.latent.names)}"
        remedy = "leave bounds out to take them from the data"
        require(fits, "bounds", expected=expected, got=repr(bounds), remedy=remedy)
        self.bounds.copy_(torch.as_tensor(bounds, dtype=torch.float32))

    @abstractmethod
    def sample(self, context: Context, *, generator: torch.Generator) -> Tensor:
        """Draws of z (n, M, d_z), clipped at b."""

    def sampler(self, context: Context) -> Callable[[torch.Generator], Tensor]:
        """`sample` as a function of the generator, after what is not random."""
        return lambda generator: self.sample(context, generator=generator)

    def save(self, folder: str | Path) -> None:
        """Write the weights and the description, see `retwin.serialisation.models`."""
        about = {
            "correction": to_config(self.correction, classes(CORRECTIONS)),
            "density": to_config(self.density, _densities()),
            "inputs": vars(self.inputs),
            "outputs": vars(self.outputs),
            "segmentation": self.segmentation,
            "degrees": [None if math.isinf(each) else each for each in self.degrees],
            "emulated": self.emulated,
            "timing": [[None if np.isnan(t) else t for t in row] for row in self.timing],
            "fitted": None if self.fitted is None else asdict(self.fitted),
            "learned": self.learned,
        }
        save_model(folder, self.kind, about, self.state_dict())

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Read what `save` wrote.

        Raises InputError if the folder holds no such residual model or is damaged.
        """
        about, weights = read_model(folder, cls.kind)
        correction = from_config(about["correction"], classes(CORRECTIONS))
        density = from_config(about["density"], _densities())
        channels = {name: Channels.of(about[name]) for name in ("inputs", "outputs")}
        model = cls(correction, density, **channels, segmentation=about["segmentation"])
        model.load_state_dict(weights)
        model.degrees = [
            math.inf if each is None else finite("degrees", each, at_least=1)
            for each, _ in zip(about["degrees"], model.sizes, strict=True)
        ]
        model.emulated = about["emulated"]
        model.timing = np.atleast_2d(np.array(about["timing"], dtype=float))
        model.fitted = Fit.of(about["fitted"])
        model.learned = about.get("learned")
        return model.eval()


def mean_where(values: Tensor, valid: Tensor) -> Tensor:
    """The mean (...) of values (..., n, M) that are valid."""
    return torch.where(valid, values, 0.0).sum((-2, -1)) / valid.sum((-2, -1)).clamp_min(1)


def _densities() -> tuple[type, ...]:
    """The kinds that the description of a density may name."""
    return (*classes(DENSITIES), *classes(NETWORKS))


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
