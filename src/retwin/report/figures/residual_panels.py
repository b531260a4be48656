"""Figures of residuals: their correlation with themselves and with commands, and their spectra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from retwin.report.figures.figure import Axis, Band, Figure, Key, Line, Mark, Panel, Row
from retwin.scores.residuals import autocorrelation, cross_correlation, decorrelated_after, spectra

POINTS = 241
"""Lags that a figure shows, at most."""
WHITE = Key("95 % limits of white noise", "muted", "bar")


@dataclass(frozen=True)
class ChannelRecords:
    """A command or an output of all records: values (n, T), range in calibration."""

    name: str
    unit: str
    values: NDArray
    low: float = -np.inf
    high: float = np.inf

    @property
    def outside(self) -> NDArray:
        """Whether a value is outside that range (n, T)."""
        return (self.values < self.low) | (self.values > self.high)


@dataclass(frozen=True)
class Errors:
    """An output, and what was measured minus what was simulated (n, T), by the key of a model."""

    output: ChannelRecords
    by_key: Mapping[Key, NDArray]

    @cached_property
    def lags(self) -> int:
        """Lags up to which correlations are shown, by the first model."""
        return decorrelated_after(next(iter(self.by_key.values())))


def line(x: NDArray, y: NDArray, key: Key) -> Line:
    """The line of a model."""
    return Line(x, y, key.text, key.colour, key.mark, 1.6)


def residual_figures(
    errors: Sequence[Errors], commands: Sequence[ChannelRecords], keys: Sequence[Key], rate: float
) -> list[Figure]:
    """Correlations of errors with themselves and with commands, and spectra; `keys` of models."""
    crossed = [_cross_correlation_panel(each, of, rate) for each in errors for of in commands]
    limits = [Key(f"95 % limits, {key.text}", key.colour, "bar") for key in keys]
    densities = [panel for each in errors if (panel := _spectrum_panel(each, rate))]
    own = [_autocorrelation_panel(each, rate) for each in errors]
    return [
        Figure("autocorrelation", own, [*keys, WHITE]),
        Figure("crosscorrelation", crossed, [*keys, *limits]),
        Figure("spectra", densities, [Key("measured output", "ink"), *keys]),
    ]


def _autocorrelation_panel(errors: Errors, rate: float) -> Panel:
    """The autocorrelation of each error by lag."""
    found = {k: autocorrelation(e, errors.lags).thinned(POINTS) for k, e in errors.by_key.items()}
    first = next(iter(found.values()))
    x = first.lags / rate
    marks: list[Mark] = [Band(x, -first.limits, first.limits, WHITE.text, "muted", 0.25)]
    marks += [line(x, each.values, key) for key, each in found.items()]
    y, name = Axis("autocorrelation", limits=(-1.05, 1.05), step=0.5), errors.output.name
    alt = f"Autocorrelation of the error of {name}"
    return Panel(Axis("lag", "s"), [Row(y, marks)], alt, name, height=300)


def _cross_correlation_panel(errors: Errors, command: ChannelRecords, rate: float) -> Panel:
    """The correlation of each error with a command that is earlier."""
    marks: list[Mark] = []
    largest = 0.0
    for key, each in errors.by_key.items():
        found = cross_correlation(each, command.values, errors.lags).thinned(POINTS)
        x, name = found.lags / rate, f"95 % limits, {key.text}"
        marks.append(Band(x, -found.limits, found.limits, name, key.colour, 0.18))
        marks.append(line(x, found.values, key))
        both = np.concatenate([np.abs(found.values), found.limits])
        largest = float(max(largest, *both[np.isfinite(both)], 0.0))
    y = Axis("correlation", limits=(-1.1 * largest, 1.1 * largest) if largest > 0 else None)
    time, name = Axis("time by which the command is earlier", "s"), errors.output.name
    alt = f"Correlation of the error of {name} with {command.name}"
    return Panel(time, [Row(y, marks)], alt, f"{name}, {command.name}", height=300)


def _spectrum_panel(errors: Errors, rate: float) -> Panel | None:
    """The spectra of the output and of each error; None where all parts have a hole."""
    output = errors.output
    frequencies, (signal, *others) = spectra([output.values, *errors.by_key.values()], rate)
    if not len(frequencies):
        return None
    marks: list[Mark] = [Line(frequencies, np.sqrt(signal), "measured", "ink", width=1.4)]
    for key, each in zip(errors.by_key, others, strict=True):
        marks.append(line(frequencies, np.sqrt(each), key))
    unit = f"{output.unit or 1}/√Hz"
    x = log_axis("frequency", "Hz", frequencies)
    y = log_axis("spectral density", unit, np.sqrt([signal, *others]))
    alt = f"Spectrum of {output.name} and of its errors"
    return Panel(x, [Row(y, marks)], alt, output.name, height=340)


def log_axis(label: str, unit: str, values: object) -> Axis:
    """A logarithmic axis with ticks at 1, 2 and 5, or at powers of 10 where there are many.

    It is linear where no value is above 0.
    """
    every = np.asarray(values, dtype=float)
    positive = every[np.isfinite(every) & (every > 0)]
    if not positive.size:
        return Axis(label, unit)
    low, high = np.log10(positive.min()), np.log10(positive.max())
    powers = np.arange(np.floor(low), np.ceil(high) + 1)
    steps = (1.0, 2.0, 5.0) if high - low < 2 else (1.0,)
    places = np.array([step * 10.0**power for power in powers for step in steps])
    kept = places[(places >= 0.8 * 10**low) & (places <= 1.25 * 10**high)]
    return Axis(label, unit, kind="log", ticks={float(each): f"{each:g}" for each in kept})
