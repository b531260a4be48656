"""The exported modules: each part of a bundle as a function of tensors, noise included."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor, nn

from retwin.data.segments import Segments
from retwin.diagnosis import NetworkDiagnoser
from retwin.diagnosis.trained.features import Features
from retwin.nets.student import shared_factor
from retwin.update.corrections import Context, Correction, SampledSensor, sensor_of
from retwin.update.corrections.delays import gather_samples
from retwin.update.corrections.tensor_segments import TensorSegments
from retwin.update.residual import ResidualModel
from retwin.update.residual.model import describe
from retwin.update.surrogate import Surrogate


class ResidualGraph(nn.Module):
    """Discrepancies z as a function of given noise, see `ResidualModel.drawn`.

    Parameters
    ----------
    residual : ResidualModel
        The conditional distribution of z, a mixture.
    rate : float
        Sample rate in Hz.

    """

    def __init__(self, residual: ResidualModel, rate: float) -> None:
        super().__init__()
        self.residual = residual
        self.rate = rate

    def forward(
        self,
        commands: Tensor,
        nominal: Tensor,
        start: Tensor,
        settle: Tensor,
        stop: Tensor,
        uniform: Tensor,
        segment_noise: Tensor,
        trajectory_noise: Tensor,
        trajectory_uniform: Tensor,
    ) -> Tensor:
        """Draw z.

        Parameters
        ----------
        commands : Tensor, shape (n, T, d_u)
            Commands without faults.
        nominal : Tensor, shape (n, T, d_y)
            Nominal outputs.
        start, settle, stop : Tensor, shape (n, M)
            Times of the segments, in samples.
        uniform : Tensor, shape (n, M, blocks)
            Uniform noise in [0, 1), which selects components of the mixtures.
        segment_noise : Tensor, shape (n, M, d_z)
            Standard normal noise of each segment.
        trajectory_noise : Tensor, shape (n, 1, d_z)
            Standard normal noise that all segments of a trajectory share.
        trajectory_uniform : Tensor, shape (n, 1, blocks)
            Uniform noise in [0, 1), which selects the factor of the deviations of a trajectory.

        Returns
        -------
        Tensor, shape (n, M, d_z)
            Draws of z, within the bounds of the residual model.

        """
        valid = torch.ones_like(start, dtype=torch.bool)
        context = _context(commands, nominal, (start, settle, stop, valid), self.rate)
        distribution = self.residual.distribution(describe(context))
        shared = self.residual.persistence
        noise = shared.sqrt() * trajectory_noise + (1 - shared).sqrt() * segment_noise
        if self.residual.heavy_tailed:
            uniform = shared_factor(trajectory_uniform, uniform)
        z = distribution.from_noise(uniform, noise)
        return z.clamp(-self.residual.bounds, self.residual.bounds)


class CorrectionGraph(nn.Module):
    """Corrected outputs before the sensor, as a function of commands, segments and z.

    Parameters
    ----------
    correction : Correction
        The operator g.
    surrogate : Surrogate
        Predicts outputs from commands.

    """

    def __init__(self, correction: Correction, surrogate: Surrogate) -> None:
        super().__init__()
        self.correction = correction
        self.surrogate = surrogate

    def forward(
        self,
        faulty_commands: Tensor,
        frozen: Tensor,
        start: Tensor,
        settle: Tensor,
        stop: Tensor,
        valid: Tensor,
        z: Tensor,
    ) -> Tensor:
        """Correct the outputs.

        Parameters
        ----------
        faulty_commands : Tensor, shape (n, T, d_u)
            Commands after the faults that change the reference.
        frozen : Tensor, shape (n, d_u)
            Sample from which each actuator is stuck, T for one that never is.
        start, settle, stop : Tensor, shape (n, M)
            Times of the segments, in samples.
        valid : Tensor, shape (n, M)
            Whether a segment exists.
        z : Tensor, shape (n, M, d_z)
            Discrepancies.

        Returns
        -------
        Tensor, shape (n, T, d_y)
            Corrected outputs.

        """
        time = torch.minimum(torch.arange(faulty_commands.shape[1])[:, None], frozen[:, None])
        path = self.surrogate(faulty_commands.gather(1, time))
        times = start, settle, stop, valid
        context = _context(faulty_commands, path, times, 1.0, self.surrogate, frozen)
        return self.correction.apply(context, z)


def _context(
    commands: Tensor,
    outputs: Tensor,
    times: tuple[Tensor, Tensor, Tensor, Tensor],
    rate: float,
    surrogate: Callable[[Tensor], Tensor] | None = None,
    frozen: Tensor | None = None,
) -> Context:
    """A context whose nominal and corrected outputs are both `outputs`."""
    steps, count = commands.shape[1], times[0].shape[1]
    return Context(
        surrogate=cast(Any, surrogate),
        commands=commands,
        faulty_commands=commands,
        frozen=cast(Tensor, frozen),
        nominal=outputs,
        segments=cast(Segments, TensorSegments(*times, steps=steps, max_count=count)),
        rate=rate,
        corrected=outputs,
    )


class SensorGraph(nn.Module):
    """The record of corrected outputs as a function of given noise, see `SampledSensor.read`.

    Parameters
    ----------
    sensor : SampledSensor
        The fitted sensor.
    rate : float
        Sample rate of the outputs in Hz.

    """

    def __init__(self, sensor: SampledSensor, rate: float) -> None:
        super().__init__()
        self.sensor = sensor
        self.rate = rate
        self.every, _ = sensor.timing(rate)

    def forward(
        self,
        outputs: Tensor,
        phase: Tensor,
        error_level: Tensor,
        glitch_level: Tensor,
        glitch_noise: Tensor,
    ) -> Tensor:
        """Record outputs with S sensor samples per trajectory.

        Parameters
        ----------
        outputs : Tensor, shape (n, T, d_y)
            Corrected outputs.
        phase : Tensor, shape (n, 1)
            Index of the first sensor sample.
        error_level : Tensor, shape (n, S, d_y)
            Uniform noise in [0, 1): levels of the quantiles of the sensor's error.
        glitch_level : Tensor, shape (n, S, 1)
            Uniform noise in [0, 1): a glitch occurs below the glitch's probability.
        glitch_noise : Tensor, shape (n, S, d_y)
            Standard normal noise that scales a glitch.

        Returns
        -------
        Tensor, shape (n, T, d_y)
            The record, linear between sensor samples.

        """
        steps = outputs.shape[1]
        when = (phase + self.every * torch.arange(error_level.shape[1])).clamp_max(steps - 1)
        values = gather_samples(outputs, when) + self.sensor.glitches(glitch_level, glitch_noise)
        if self.sensor.noise is not None:
            values = values + self.sensor.regular_errors(error_level)
        return self.sensor.record(values, when, steps, self.rate)


def sampling_sensor(correction: Correction) -> SampledSensor | None:
    """The sensor at the end of a chain, if it has a sampling period; None otherwise."""
    sensor = sensor_of(correction)
    return None if sensor is None or sensor.period is None else sensor


class FeaturesGraph(nn.Module):
    """Features of trajectories, see `Features`."""

    def __init__(self, features: Features) -> None:
        super().__init__()
        self.stride = features.stride

    def forward(self, nominal: Tensor, observed: Tensor, mask: Tensor, settled: Tensor) -> Tensor:
        """Compute features.

        Parameters
        ----------
        nominal, observed : Tensor, shape (n, T, d_y)
            Nominal and observed outputs.
        mask : Tensor, shape (n, T, d_y)
            Whether an output was measured.
        settled : Tensor, shape (n, 1)
            Sample until which the start is hidden, 0 if it is not.

        Returns
        -------
        Tensor, shape (n, T', 2 d_y)
            Features.

        """
        time = torch.arange(0, nominal.shape[1], self.stride)
        residual = torch.where(mask, observed - nominal, torch.zeros_like(nominal))
        hidden = (time < settled)[..., None]
        at_rest = nominal.gather(1, settled[..., None].expand(-1, -1, nominal.shape[2]))
        shown = torch.where(hidden, at_rest, nominal[:, :: self.stride])
        return torch.cat([shown, torch.where(hidden, 0.0, residual[:, :: self.stride])], dim=2)


class DiagnoserGraph(nn.Module):
    """Class probabilities as a function of features."""

    def __init__(self, diagnoser: NetworkDiagnoser) -> None:
        super().__init__()
        self.diagnoser = diagnoser

    def forward(self, features: Tensor) -> Tensor:
        """Probabilities (n, classes) of features (n, T', 2 d_y)."""
        return self.diagnoser(features).softmax(dim=1)


class GuardGraph(nn.Module):
    """Energies as a function of the inputs of `FeaturesGraph`; the start is never hidden."""

    def __init__(self, guard: nn.Module, features: Features) -> None:
        super().__init__()
        self.guard = guard
        self.features = FeaturesGraph(features)

    def forward(self, nominal: Tensor, observed: Tensor, mask: Tensor) -> Tensor:
        """Energies (n,), in log odds."""
        start = torch.zeros_like(nominal[:, :1, 0], dtype=torch.int64)
        return self.guard(self.features(nominal, observed, mask, start))
