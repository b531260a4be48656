"""What is exported: each part of a bundle as a function of tensors alone, noise among them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor, nn

from retwin.data.segments import Segments
from retwin.diagnosis import NetworkDiagnoser
from retwin.diagnosis.features import Features
from retwin.update.corrections import Chain, Context, Correction, SampledSensor
from retwin.update.residual import ResidualModel
from retwin.update.residual.model import describe
from retwin.update.surrogate import Surrogate

__all__ = [
    "CorrectionGraph",
    "DiagnoserGraph",
    "FeaturesGraph",
    "GuardGraph",
    "ResidualGraph",
    "SensorGraph",
    "sensor_of",
]


@dataclass
class Movements:
    """`Segments` whose times are tensors: theirs are checked, which a graph cannot be."""

    start: Tensor
    settle: Tensor
    stop: Tensor
    valid: Tensor
    steps: int
    max_count: int


class ResidualGraph(nn.Module):
    """z (n, M, d_z) drawn by this noise, see `ResidualModel.drawn`.

    Takes clean commands (n, T, d_u), nominal outputs (n, T, d_y), the movements' times in samples
    (n, M), uniform noise (n, M, blocks), normal noise of each movement (n, M, d_z), and of each
    trajectory (n, 1, d_z).
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
        own: Tensor,
        common: Tensor,
    ) -> Tensor:
        """Draws of z (n, M, d_z)."""
        valid = torch.ones_like(start, dtype=torch.bool)
        context = _context(commands, nominal, (start, settle, stop, valid), self.rate)
        law = self.residual.distribution(describe(context))
        shared = self.residual.persistence
        z = law.from_noise(uniform, shared.sqrt() * common + (1 - shared).sqrt() * own)
        return z.clamp(-self.residual.bounds, self.residual.bounds)


class CorrectionGraph(nn.Module):
    """Corrected outputs (n, T, d_y), before a sensor reads them.

    Takes commands with the faults' effect on the reference (n, T, d_u), the sample from which each
    actuator is held (n, d_u), the movements (n, M) and z (n, M, d_z).
    """

    def __init__(self, correction: Correction, surrogate: Surrogate) -> None:
        super().__init__()
        self.correction = correction
        self.surrogate = surrogate

    def forward(
        self,
        told: Tensor,
        frozen: Tensor,
        start: Tensor,
        settle: Tensor,
        stop: Tensor,
        valid: Tensor,
        z: Tensor,
    ) -> Tensor:
        """Corrected outputs (n, T, d_y)."""
        time = torch.minimum(torch.arange(told.shape[1])[:, None], frozen[:, None])
        path = self.surrogate(told.gather(1, time))
        context = _context(told, path, (start, settle, stop, valid), 1.0, self.surrogate, frozen)
        return self.correction.apply(context, z)


def _context(
    commands: Tensor,
    outputs: Tensor,
    times: tuple[Tensor, Tensor, Tensor, Tensor],
    rate: float,
    surrogate: Callable[[Tensor], Tensor] | None = None,
    frozen: Tensor | None = None,
) -> Context:
    """A context of tensors, for what looks at either commands or a path of it."""
    steps, most = commands.shape[1], times[0].shape[1]
    return Context(
        surrogate=cast(Any, surrogate),
        commands=commands,
        faulty_commands=commands,
        frozen=cast(Tensor, frozen),
        nominal=outputs,
        segments=cast(Segments, Movements(*times, steps=steps, max_count=most)),
        rate=rate,
        corrected=outputs,
    )


class SensorGraph(nn.Module):
    """The record (n, T, d_y) of corrected outputs (n, T, d_y), see `SampledSensor.read`.

    Takes the sample of the first reading (n, 1); of each reading the level of its error
    (n, R, d_y) and of a glitch (n, R, 1), both uniform; and a glitch's size, normal (n, R, d_y).
    """

    law: Tensor
    size: Tensor
    steps: Tensor

    def __init__(self, sensor: SampledSensor, width: int) -> None:
        super().__init__()
        self.every = sensor.every or 1
        self.rate = sensor.glitch_rate or 0.0
        law = sensor.noise or ((0.0, 0.0),) * width
        for name, values in (
            ("law", law),
            ("size", sensor.glitch_size or (0.0,) * width),
            ("steps", sensor.steps or (0.0,) * width),
        ):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float32))

    def forward(
        self, outputs: Tensor, phase: Tensor, level: Tensor, chance: Tensor, glitch: Tensor
    ) -> Tensor:
        """The record (n, T, d_y)."""
        steps, width = outputs.shape[1], outputs.shape[2]
        at = phase + self.every * torch.arange(level.shape[1])
        last = (at < steps).sum(dim=1, keepdim=True) - 1
        values = outputs.gather(1, at.clamp_max(steps - 1)[..., None].expand(-1, -1, width))
        values = values + self._error(level) + (chance < self.rate) * self.size * glitch
        whole = self.steps * (values / self.steps.clamp_min(1e-30)).round()
        values = torch.where(self.steps > 0, whole, values)
        place = ((torch.arange(steps) - phase) / self.every).clamp_min(0)
        left = place.floor().long().minimum(last)
        share = (place - left).clamp(0, 1)[..., None]
        before, after = (
            values.gather(1, index[..., None].expand(-1, -1, width))
            for index in (left, (left + 1).minimum(last))
        )
        return before + share * (after - before)

    def _error(self, level: Tensor) -> Tensor:
        """The quantiles (n, R, d_y) of the law at these levels, linear between those it tells."""
        place = level * (self.law.shape[1] - 1)
        below = place.floor().long().clamp(0, self.law.shape[1] - 2)
        law = self.law.T[None].expand(level.shape[0], -1, -1)
        left, right = law.gather(1, below), law.gather(1, below + 1)
        return left + (place - below) * (right - left)


def sensor_of(correction: Correction) -> SampledSensor | None:
    """The sensor that records what the operator leaves, if there is one."""
    last = correction.second if isinstance(correction, Chain) else None
    return last if isinstance(last, SampledSensor) and last.every is not None else None


class FeaturesGraph(nn.Module):
    """Features (n, T', 2 d_y), see `Features`.

    Takes nominal and observed outputs (n, T, d_y), where there is a measurement (n, T, d_y), and
    the sample (n, 1) until which the start is hidden, 0 where it is shown.
    """

    def __init__(self, features: Features) -> None:
        super().__init__()
        self.stride = features.stride

    def forward(self, nominal: Tensor, observed: Tensor, mask: Tensor, settled: Tensor) -> Tensor:
        """Features (n, T', 2 d_y)."""
        time = torch.arange(0, nominal.shape[1], self.stride)
        residual = torch.where(mask, observed - nominal, torch.zeros_like(nominal))
        hidden = (time < settled)[..., None]
        at_rest = nominal.gather(1, settled[..., None].expand(-1, -1, nominal.shape[2]))
        shown = torch.where(hidden, at_rest, nominal[:, :: self.stride])
        return torch.cat([shown, torch.where(hidden, 0.0, residual[:, :: self.stride])], dim=2)


class DiagnoserGraph(nn.Module):
    """Probabilities (n, classes) of features (n, T', 2 d_y)."""

    def __init__(self, diagnoser: NetworkDiagnoser) -> None:
        super().__init__()
        self.diagnoser = diagnoser

    def forward(self, features: Tensor) -> Tensor:
        """Probabilities (n, classes)."""
        return self.diagnoser(features).softmax(dim=1)


class GuardGraph(nn.Module):
    """Energies (n,) of the same as `FeaturesGraph` takes, nothing of it hidden."""

    def __init__(self, guard: nn.Module, features: Features) -> None:
        super().__init__()
        self.guard = guard
        self.features = FeaturesGraph(features)

    def forward(self, nominal: Tensor, observed: Tensor, mask: Tensor) -> Tensor:
        """Energies (n,)."""
        shown = torch.zeros_like(nominal[:, :1, 0], dtype=torch.int64)
        return self.guard(self.features(nominal, observed, mask, shown))
