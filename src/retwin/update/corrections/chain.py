"""`Chain`: operators in series, the measuring chain at the end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from retwin.checks import require
from retwin.data.trajectories import Channels
from retwin.update.corrections.correction import (
    Context,
    Correction,
    Discrepancy,
    Head,
    block_diagonal,
)
from retwin.update.corrections.delays import gather_samples
from retwin.update.corrections.sampled_sensor import SampledSensor


@dataclass(frozen=True)
class Chain:
    """The output of `first` is corrected, or recorded, by `second`; chains may be chained again.

    z is that of the first operator, then that of the second; a sensor has none: the errors of its
    samples are drawn when a record is made. z of the first is inferred as if it were alone, z of
    the second from what the first leaves; of a sensor's record only the sampled values count.

    Parameters
    ----------
    first : Correction
        The operator that acts on the system.
    second : Correction or SampledSensor
        The operator that acts on its output, or the sensor that records it.

    Raises
    ------
    InputError
        The operators have a different resolution, or one stands behind a sensor.

    """

    first: Correction
    second: Correction | SampledSensor

    def __post_init__(self) -> None:
        acts = not isinstance(self.first, SampledSensor) and sensor_of(self.first) is None
        expected = "an operator that acts on the system, the sensor being last"
        got = type(self.first).__name__
        require(acts, "first", expected=expected, got=got, remedy="give the sensor as the second")
        if not isinstance(self.second, SampledSensor):
            alike = self.first.resolution == self.second.resolution
            expected = f"an operator with one z per {self.first.resolution}, as the first has"
            got = f"{type(self.second).__name__}, one per {self.second.resolution}"
            remedy = "chain operators of the same resolution"
            require(alike, "second", expected=expected, got=got, remedy=remedy)

    @property
    def resolution(self) -> str:
        """As the operators in it."""
        return self.first.resolution

    @property
    def pools(self) -> bool:
        """Whether `infer` of an operator learns from all trajectories together."""
        return any(getattr(each, "pools", False) for each in self._operators)

    @property
    def severities(self) -> bool:
        """Whether `infer` of an operator estimates the severity of a known fault."""
        return any(getattr(each, "severities", False) for each in self._operators)

    @property
    def _operators(self) -> tuple[Correction, ...]:
        """Those that have a z."""
        sensor = isinstance(self.second, SampledSensor)
        return (self.first,) if sensor else (self.first, self.second)  # type: ignore[return-value]

    def latent(self, inputs: Channels, outputs: Channels) -> Channels:
        """Components of the first, then of the second; names of both get the operator's."""
        parts = [(each, each.latent(inputs, outputs)) for each in self._operators]
        names = _tell_apart([(each, name) for each, part in parts for name in part.names])
        return Channels(names, tuple(unit for _, part in parts for unit in part.units))

    def heads(self, inputs: Channels, outputs: Channels) -> tuple[Head, ...]:
        """Blocks of the first, then of the second, named likewise."""
        parts = [(each, head) for each in self._operators for head in each.heads(inputs, outputs)]
        names = _tell_apart([(each, head.name) for each, head in parts])
        return tuple(replace(head, name=name) for (_, head), name in zip(parts, names, strict=True))

    def apply(self, context: Context, z: Tensor) -> Tensor:
        """The outputs after all operators, before a sensor records them."""
        for operator, part in zip(self._operators, self._split(context, z), strict=True):
            context = replace(context, corrected=operator.apply(context, part))
        return context.path

    def completed(self, context: Context, observed: Tensor, mask: Tensor) -> Chain:
        """The same, what each operator leaves open chosen as if it were alone."""
        seen = sample_mask(self, observed, mask, context.rate)
        made = [completed(each, context, observed, seen) for each in self._operators]
        return Chain(*made) if len(made) == 2 else replace(self, first=made[0])

    def infer(self, context: Context, observed: Tensor, mask: Tensor) -> Discrepancy:
        """z* of one operator after the other, each from what those before it left."""
        if isinstance(self.second, SampledSensor):
            seen = sample_mask(self, observed, mask, context.rate)
            return self.first.infer(context, observed, seen)
        one = self.first.infer(context, observed, mask)
        with torch.no_grad():
            after = replace(context, corrected=self.first.apply(context, one.z))
        other = self.second.infer(after, observed, mask)
        return Discrepancy(
            z=torch.cat([one.z, other.z.to(one.z)], dim=-1),
            covariance=block_diagonal(one.covariance, other.covariance),
            identified=torch.cat([one.identified, other.identified], dim=-1),
            noise=other.noise,
            severity=one.severity,
            # Where one operator can only give points, both do.
            posterior=one.posterior and other.posterior,
            at_bound=_either(one.at_bound, other.at_bound),
        )

    def _split(self, context: Context, z: Tensor) -> tuple[Tensor, ...]:
        """The z of each operator."""
        inputs = Channels.numbered("u", context.commands.shape[2])
        outputs = Channels.numbered("y", context.nominal.shape[2])
        return z.split([len(each.latent(inputs, outputs)) for each in self._operators], dim=-1)


def _tell_apart(names: Sequence[tuple[Correction, str]]) -> tuple[str, ...]:
    """Names, with that of the operator before those that both operators have."""
    once = Counter(name for _, name in names)
    return tuple(
        name if once[name] == 1 else f"{type(each).__name__}.{name}" for each, name in names
    )


def completed(
    correction: Correction, context: Context, observed: Tensor, mask: Tensor
) -> Correction:
    """The operator with the settings that were left open, if it has such."""
    method = getattr(correction, "completed", None)
    return correction if method is None else method(context, observed, mask)


def _either(one: Tensor | None, other: Tensor | None) -> Tensor | None:
    """Where one of both is true, if both are known."""
    return one if other is None else other if one is None else one | other


def sensor_of(correction: Correction) -> SampledSensor | None:
    """The sensor at the end of a chain, if there is one."""
    last = correction.second if isinstance(correction, Chain) else None
    return last if isinstance(last, SampledSensor) else None


def before_sensor(correction: Correction) -> Correction:
    """The operator whose outputs the sensor at the end of a chain records; itself without one."""
    if isinstance(correction, Chain) and isinstance(correction.second, SampledSensor):
        return correction.first
    return correction


def fit_correction(
    correction: Correction, context: Context, observed: Tensor, mask: Tensor
) -> tuple[Correction, Discrepancy]:
    """The operator with all settings fitted to measured outputs (n, T, d_y), and their z*."""
    sensor = sensor_of(correction)
    if sensor is None or not isinstance(correction, Chain):
        operator = completed(correction, context, observed, mask)
        return operator, operator.infer(context, observed, mask)
    timed = replace(correction, second=sensor.timed(observed, mask, context.rate))
    chain = timed.completed(context, observed, mask)
    found = chain.infer(context, observed, mask)
    with torch.no_grad():
        explained = chain.apply(context, found.z)
    fitted = sensor.fitted(observed, mask, explained, context.segments, context.rate)
    return replace(chain, second=fitted), found


def sample_mask(correction: Correction, observed: Tensor, mask: Tensor, rate: float) -> Tensor:
    """`mask` (n, T, d_y) where the operator's sensor, if it has one, sampled the outputs.

    `rate` is that of the record, in Hz.
    """
    sensor = sensor_of(correction)
    if sensor is None:
        return mask
    return sensor.timed(observed, mask, rate).sample_mask(observed, mask, rate)


def measured_outputs(
    correction: Correction, context: Context, z: Tensor, generator: torch.Generator
) -> Tensor:
    """The corrected outputs (n, T, d_y) as the operator's sensor, if it has one, records them.

    Outputs that are not sampled are not computed, if the operator has `at`.
    """
    return measuring(correction, context, generator)(z)


def measuring(
    correction: Correction, context: Context, generator: torch.Generator
) -> Callable[[Tensor], Tensor]:
    """`measured_outputs` as a function of z: what is random of the sensor is drawn here."""
    sensor = sensor_of(correction)
    if sensor is None or sensor.period is None or not isinstance(correction, Chain):
        return partial(correction.apply, context)
    (count, steps, width), rate = context.nominal.shape, context.rate
    at, apply = getattr(correction.first, "at", None), correction.apply
    when = sensor.polls(count, steps, generator, rate)
    errors = sensor.errors((*when.shape, width), context.nominal.dtype, generator)

    def measured(z: Tensor) -> Tensor:
        values = gather_samples(apply(context, z), when) if at is None else at(context, z, when)
        return sensor.record(values + errors.to(values), when, steps, rate)

    return measured
