"""`SampledSensor`: what lies between a system's outputs and their record.

Outputs are sampled every so many time steps, each sampled value has an error, now and then a gross
one, is rounded, and the record joins the values linearly. Only sampled values are informative:
between them a record has no information, however long it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.checks import given, require
from retwin.data.segments import Segments
from retwin.update.corrections.delays import gather_samples
from retwin.update.kernels.generation import joined_samples

REGULAR, GROSS = 0.9, 30.0
"""A value is a glitch if its error is `GROSS` times this quantile of all errors."""
LEVELS = np.linspace(0, 1, 33)
"""Levels of the quantiles by which the distribution of an error is described."""


@dataclass(frozen=True)
class SampledSensor:
    """Sampling, errors, glitches and rounding; what is left out is fitted from data.

    Parameters
    ----------
    period : float, optional
        Sampling period in seconds, a whole number of time steps.
    phases : tuple of float, optional
        Time of the first sampled value in seconds, from 0 to below the period; where there are
        several, each trajectory has one of them.
    noise : tuple of tuple of float, optional
        Quantiles of an error at levels evenly from 0 to 1, per output in its unit. No shape of its
        distribution is assumed, since rounding may leave most values without any error.
    steps : tuple of float, optional
        Distance of the values that an output can take, per output; 0 for any value.
    glitch_probability : float, optional
        Probability that a sampled value is a glitch, 0 to 1.
    glitch_size : tuple of float, optional
        Standard deviation of their errors, per output.

    Raises
    ------
    InputError
        The period is not positive, a phase is outside the first period, a size is negative,
        quantiles do not rise, or the probability is outside 0 to 1.

    """

    period: float | None = None
    phases: tuple[float, ...] | None = None
    noise: tuple[tuple[float, ...], ...] | None = None
    steps: tuple[float, ...] | None = None
    glitch_probability: float | None = None
    glitch_size: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        sizes = [*(self.steps or ()), *(self.glitch_size or ())]
        sound = (
            (self.period is None or (self.period > 0 and np.isfinite(self.period)))
            and (self.phases is None or (self.phases and self.period))
            and all(0 <= phase < (self.period or 0.0) for phase in self.phases or ())
            and all(np.isfinite(size) and size >= 0 for size in sizes)
            and 0 <= (self.glitch_probability or 0.0) <= 1
            and all(len(q) > 1 and sorted(q) == list(q) for q in self.noise or ())
        )
        expected = "a period in seconds above 0, phases from 0 to below it, finite sizes of "
        expected += "at least 0, rising quantiles and a probability from 0 to 1"
        remedy = "leave out what you do not know: it is fitted from data"
        require(sound, "sensor", expected=expected, got=repr(self), remedy=remedy)

    def timing(self, rate: float) -> tuple[int, tuple[int, ...] | None]:
        """Sampling period and phases in time steps at `rate` in Hz, where a period is given.

        Raises
        ------
        InputError
            No period is given, or it is no whole number of time steps.

        """
        expected, remedy = "one whose timing is known", "call timed or fitted first"
        period = given("sensor", self.period, expected, got=repr(self), remedy=remedy)
        every = round(period * rate)
        # Difference from a whole number of time steps that is only the rounding of numbers.
        whole = every >= 1 and abs(period * rate - every) <= 1e-6
        expected = f"a whole number of time steps of {1 / rate:g} s"
        remedy = "leave it out: it is fitted from data"
        require(whole, "sensor.period", expected=expected, got=f"{period:g} s", remedy=remedy)
        if self.phases is None:
            return every, None
        return every, tuple(round(phase * rate) % every for phase in self.phases)

    def timed(self, observed: Tensor, mask: Tensor, rate: float) -> SampledSensor:
        """Period, phases and rounding as found in a record (n, T, d_y), where not given."""
        if self.period is None:
            every, phases = _timing(observed, mask)
        else:
            every, known = self.timing(rate)
            phases = known or _list_phases(_kinks(_bends(observed, mask), every))
        made = replace(self, period=every / rate, phases=tuple(each / rate for each in phases))
        if made.steps is not None:
            return made
        sampled = observed[made.sample_mask(observed, mask, rate).all(dim=-1)].double().numpy()
        return replace(made, steps=tuple(lattice_step(values) for values in sampled.T))

    def fitted(
        self, observed: Tensor, mask: Tensor, explained: Tensor, segments: Segments, rate: float
    ) -> SampledSensor:
        """Everything that is not given, from a record and the outputs that explain it.

        Errors are measured where the system rests: in the second half of each steady part, about
        that part's median.
        """
        made = self.timed(observed, mask, rate)
        errors = _at_rest(observed - explained, made.sample_mask(observed, mask, rate), segments)
        size = np.abs(errors)
        regular = np.quantile(size, REGULAR, axis=0) if len(errors) else np.zeros(errors.shape[1])
        gross = (size > GROSS * np.where(regular > 0, regular, np.inf)).any(axis=1)
        # An error is as likely as its opposite.
        plain = np.concatenate([errors[~gross], -errors[~gross], np.zeros((1, len(regular)))])
        strong = np.sqrt(np.square(errors[gross]).mean(axis=0)) if gross.any() else 0 * regular
        found: dict[str, Any] = {
            "noise": tuple(tuple(np.quantile(each, LEVELS).tolist()) for each in plain.T),
            "glitch_probability": float(gross.mean()) if len(gross) else 0.0,
            "glitch_size": tuple(strong.tolist()),
        }
        return replace(made, **{k: v for k, v in found.items() if getattr(made, k) is None})

    def sample_mask(self, observed: Tensor, mask: Tensor, rate: float) -> Tensor:
        """`mask` (n, T, d_y) where a record was sampled; in between it has no information."""
        every, phases = self.timing(rate)
        if phases is None or len(phases) > 1:
            phase = _phases(_kinks(_bends(observed, mask), every))
        else:
            phase = torch.tensor(phases).expand(len(observed))
        time = torch.arange(observed.shape[1])
        read = (time - phase[:, None]) % every == 0
        return mask & (read & (time >= phase[:, None]))[..., None]

    def read(self, outputs: Tensor, generator: torch.Generator, rate: float) -> Tensor:
        """The record of outputs (n, T, d_y); differentiable, rounding passed straight through."""
        if self.period is None:
            return outputs
        steps = outputs.shape[1]
        when = self.polls(len(outputs), steps, generator, rate)
        errors = self.errors((*when.shape, outputs.shape[2]), outputs.dtype, generator)
        return self.record(gather_samples(outputs, when) + errors, when, steps, rate)

    def polls(self, count: int, steps: int, generator: torch.Generator, rate: float) -> Tensor:
        """Time steps (count, R) at which records of that length are sampled, within the record."""
        every, phases = self.timing(rate)
        device = generator.device
        choice = torch.tensor(phases or range(every), device=device)
        phase = choice[torch.randint(len(choice), (count,), generator=generator, device=device)]
        samples = torch.arange(-(-steps // every), device=device)
        return (phase[:, None] + every * samples).clamp_max(steps - 1)

    def record(self, values: Tensor, when: Tensor, steps: int, rate: float) -> Tensor:
        """The record (n, steps, d_y) of outputs (n, R, d_y), errors included, at `polls` (n, R)."""
        if self.steps is not None and any(self.steps):
            step = values.new_tensor(self.steps)
            whole = torch.where(step > 0, step * (values / step.clamp_min(1e-30)).round(), values)
            values = values + (whole - values).detach()
        every, phase = self.timing(rate)[0], when[:, :1]
        if every == 1:
            return values
        made = joined_samples(values, phase[:, 0], steps, every)
        if made is not None:
            return made
        last = (steps - 1 - phase) // every
        time = torch.arange(max(steps, values.shape[1]), device=values.device)
        following = (time[: values.shape[1]] + 1).minimum(last)
        ends = torch.stack([values, gather_samples(values, following) - values])
        # Linear interpolation between sampled values; as a matrix product it is fast.
        share = torch.arange(every, device=values.device).to(values) / every
        join = torch.stack([torch.ones_like(share), share], dim=1)
        lines = torch.einsum("ek,knrd->nred", join, ends).flatten(1, 2)
        return gather_samples(lines, (time[:steps] - phase).clamp_min(0))

    def errors(
        self, shape: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator
    ) -> Tensor:
        """Errors of sampled values (n, R, d_y), which is the shape."""
        device = generator.device
        error = torch.zeros(shape, dtype=dtype, device=device)
        if self.noise is not None:
            level = torch.rand(shape, generator=generator, dtype=torch.float64, device=device)
            error = self.regular_errors(level).to(dtype)
        if self.glitch_probability and self.glitch_size is not None:
            level = torch.rand((*shape[:2], 1), generator=generator, device=device)
            size = torch.randn(shape, generator=generator, device=device).to(dtype)
            error = error + self.glitches(level, size)
        return error

    def regular_errors(self, level: Tensor) -> Tensor:
        """Errors (n, R, d_y) at such levels of their quantiles, which are linear in between."""
        errors = []
        for quantiles, own in zip(self.noise or (), level.unbind(-1), strict=True):
            quantile = level.new_tensor(quantiles)
            place = own * (len(quantile) - 1)
            left = place.long().clamp_max(len(quantile) - 2)
            errors.append(torch.lerp(quantile[left], quantile[left + 1], place - left))
        return torch.stack(errors, dim=-1)

    def glitches(self, level: Tensor, size: Tensor) -> Tensor:
        """Errors (n, R, d_y) of glitches by uniform (n, R, 1) and normal (n, R, d_y) noise."""
        hit = level < (self.glitch_probability or 0.0)
        return hit * size.new_tensor(self.glitch_size or 0.0) * size


def _timing(observed: Tensor, mask: Tensor, *, min_values: int = 20) -> tuple[int, tuple[int, ...]]:
    """Sampling period and phases: the longest period with plain kinks.

    Parameters
    ----------
    min_values : int, default 20
        Fewest sampled values of a record from which their period is estimated.

    """
    measured = int(mask.any(dim=-1).any(dim=0).sum())
    bends = _bends(observed, mask)
    # Longest sampling period that is searched for, in time steps of the record: it bounds the time
    # that the search takes. Other limits are shares of the record.
    for every in range(min(1000, measured // min_values), 1, -1):
        kinks = _kinks(bends, every)
        plain = _plain(kinks)
        if 2 * plain.sum() > (kinks.amax(dim=1) > 0).sum():
            return every, _list_phases(kinks)
    return 1, (0,)


def _bends(observed: Tensor, mask: Tensor) -> Tensor:
    """How much a record (n, T, d_y) bends at each time step, (n, T); NaN where that is not known.

    A piecewise-linear record bends at sampled values only; a little elsewhere too, in motion, where
    outputs were computed from values after these had been joined.
    """
    seen = mask.all(dim=-1)
    values = observed.double()
    bend = torch.zeros_like(values)
    bend[:, 1:-1] = values[:, 2:] - 2 * values[:, 1:-1] + values[:, :-2]
    unit = values[seen].std(dim=0).clamp_min(1e-12) if seen.any() else 1.0
    known = torch.zeros_like(seen)
    known[:, 1:-1] = seen[:, 2:] & seen[:, 1:-1] & seen[:, :-2]
    return torch.where(known, (bend / unit).norm(dim=-1), torch.nan)


def _kinks(bends: Tensor, every: int) -> Tensor:
    """Mean bend (n, every) of a record at each phase."""
    whole = nn.functional.pad(bends, (0, -bends.shape[1] % every), value=torch.nan)
    return whole.unflatten(1, (-1, every)).nanmean(dim=1).nan_to_num(0.0)


def _plain(kinks: Tensor, *, plain: float = 0.2, smooth: float = 1e-6) -> Tensor:
    """Whether a record (n,) bends at one phase and hardly at others.

    Parameters
    ----------
    plain : float, default 0.2
        Largest bend at the next most bent phase, relative to that at the sampling phase.
    smooth : float, default 1e-6
        Largest bend, in standard deviations of an output, that is only the rounding of numbers.

    """
    largest, second = kinks.topk(2, dim=1).values.unbind(dim=1)
    return (largest > smooth) & (second < plain * largest)


def _phases(kinks: Tensor) -> Tensor:
    """The phase (n,) of each trajectory, the most common one where it is not plain."""
    own = kinks.argmax(dim=1)
    plain = _plain(kinks)
    return own if not plain.any() else torch.where(plain, own, own[plain].mode().values)


def _list_phases(kinks: Tensor) -> tuple[int, ...]:
    """The phases that trajectories have, in order."""
    return tuple(sorted(set(_phases(kinks).tolist())))


def lattice_step(samples: NDArray) -> float:
    """The distance of neighbouring values of one output, 0 where there is no lattice."""
    values = np.unique(samples)
    if len(values) < 3 or 4 * len(values) > len(samples):
        return 0.0
    distances = np.diff(values)
    step = float(distances[distances > 1e-6 * np.abs(values).max()].min(initial=np.inf))
    multiples = (values - values[0]) / step
    regular = np.isfinite(step) and np.abs(multiples - np.round(multiples)).max() < 0.05
    return step if regular else 0.0


def _at_rest(errors: Tensor, read: Tensor, segments: Segments) -> NDArray:
    """Deviations (k, d_y) of sampled values at rest from the median of their steady part."""
    kept = []
    sampled = read.all(dim=-1).numpy()
    values = errors.detach().double().numpy()
    for i, m in np.argwhere(segments.valid):
        settle, stop = segments.settle[i, m], segments.stop[i, m]
        part = slice(int(np.ceil((settle + stop) / 2)), int(stop))
        rest = values[i, part][sampled[i, part]]
        if len(rest) > 2:
            # A median takes one degree of freedom.
            spread = np.sqrt(len(rest) / (len(rest) - 1))
            kept.append((rest - np.median(rest, axis=0)) * spread)
    return np.concatenate(kept) if kept else np.zeros((0, values.shape[2]))
