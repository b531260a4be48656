"""Residual diagnostics of simulated records: whiteness, commands, spectra, amplitude, time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.report.blocks import Cell, Section, Table, columns
from retwin.report.figure import Axis, Band, Figure, Key, Line, Mark, Panel, Points, Row, Spans
from retwin.report.labels import decimals, number, p_value, quantity, source_name, with_unit
from retwin.report.study import Study
from retwin.report.style import colour_of, dash
from retwin.scores.residuals import (
    Correlogram,
    autocorrelation,
    cross_correlation,
    decorrelated_after,
    error_by_amplitude,
    ljung_box,
    rms_over_time,
    spectra,
)

__all__ = ["residuals"]

OUTPUTS = 3
"""Outputs of which figures are drawn, at most."""
COMMANDS = 3
"""Commands of which figures are drawn, at most."""
POINTS = 241
"""Lags that a figure shows, at most."""
BLOCKS = 40
"""Blocks of the error over time."""
OUTSIDE = Key("outside the range of the calibration", "grid", "bar")


@dataclass(frozen=True)
class ChannelRecords:
    """A command or an output of all records: values (n, T), range in calibration."""

    name: str
    unit: str
    values: NDArray
    low: float
    high: float

    @property
    def outside(self) -> NDArray:
        """Whether a value is outside that range (n, T)."""
        return (self.values < self.low) | (self.values > self.high)


def residuals(study: Study) -> Section | None:
    """A table of all sources; figures of the plain twin, the best other one, and `dynamics`."""
    known = [name for name in study.sources if f"simulation/{name}/mean" in study.arrays]
    if not known or "simulation/commands" not in study.arrays:
        return None
    best = sorted(known[1:], key=lambda name: study.sources[name].mean("nrmse"))[:1]
    shown = list(dict.fromkeys([known[0], *best, *(name for name in known if name == "dynamics")]))
    outputs, commands = _channels(study, "observed"), _channels(study, "commands")
    errors = {name: _errors(study, name, outputs) for name in known}
    drawn = {name: errors[name] for name in shown}
    keys = [Key(source_name(name), colour_of(name), dash(name)) for name in shown]
    rate = float(study.arrays["simulation/rate"])
    figures = [
        _autocorrelations(drawn, outputs, rate, keys),
        _cross_correlations(drawn, outputs, commands, rate, keys),
        _spectra(drawn, outputs, rate, keys),
        _amplitudes(drawn, outputs, commands, keys),
        _times(drawn, outputs, commands, rate, keys),
    ]
    figures = [each for each in figures if each.panels]
    values = {
        "table": _table(errors, outputs, commands, rate),
        "figures": {each.name: each for each in figures},
        "limited": len(outputs) > OUTPUTS or len(commands) > COMMANDS,
        "ranged": "simulation/range" in study.arrays,
    }
    return Section("residuals", "Residual diagnostics", values, figures)


def _channels(study: Study, kind: str) -> list[ChannelRecords]:
    """The channels of the records, in the units that are shown."""
    arrays = study.arrays[f"simulation/{kind}"].astype(float)
    about = study.results.inputs if kind == "commands" else study.results.outputs
    count = arrays.shape[2]
    names = about.names or [f"{kind} {i + 1}" for i in range(count)]
    units = [quantity(unit) for unit in about.units or [""] * count]
    ends = study.arrays.get("simulation/range")
    if ends is None:
        ends = np.repeat([[-np.inf], [np.inf]], count, axis=1)
    else:
        ends = ends[:, :count] if kind == "commands" else ends[:, -count:]
    return [
        ChannelRecords(names[i], unit, factor * arrays[..., i], *(factor * ends[:, i]).tolist())
        for i, (factor, unit) in enumerate(units)
    ]


def _errors(study: Study, source: str, outputs: Sequence[ChannelRecords]) -> list[NDArray]:
    """Measured minus simulated values (n, T) of each output."""
    mean = study.arrays[f"simulation/{source}/mean"].astype(float)
    units = study.results.outputs.units or [""] * len(outputs)
    return [each.values - quantity(units[i])[0] * mean[..., i] for i, each in enumerate(outputs)]


def _table(
    errors: dict[str, list[NDArray]],
    outputs: Sequence[ChannelRecords],
    commands: Sequence[ChannelRecords],
    rate: float,
) -> Table:
    heads = columns(
        "Source",
        "RMSE",
        "mean error",
        "largest autocorrelation",
        "p, white",
        "largest correlation with a command",
        "RMSE outside the calibration",
    )
    rows: list[list[Cell]] = []
    outside = _outside([*outputs, *commands])
    for i, output in enumerate(outputs):
        if len(outputs) > 1:
            rows.append([Cell(with_unit(output.name, output.unit))])
        for source, each in errors.items():
            error = each[i]
            own = autocorrelation(error)
            lags = decorrelated_after(next(iter(errors.values()))[i])
            crossed = [(u, cross_correlation(error, u.values, lags)) for u in commands]
            command, cross = max(crossed, key=lambda pair: _excess(pair[1]))
            (rms, mean), (beyond, _) = _moments(error), _moments(error[outside])
            share = np.mean(outside[np.isfinite(error)]) if np.isfinite(rms) else 0.0
            rows.append(
                [
                    Cell(source_name(source), source=source),
                    Cell(number(rms)),
                    Cell(number(mean, decimals(rms))),
                    Cell(*_at_lag(own, rate)),
                    Cell(p_value(ljung_box(own)[1])),
                    Cell(*_at_lag(cross, rate, command.name)),
                    Cell(number(beyond, decimals(rms)), f"{100 * share:.2g} % of the samples"),
                ]
            )
    title = "Residuals of all sources"
    return Table(title if len(outputs) > 1 else with_unit(title, outputs[0].unit), heads, rows)


def _outside(channels: Sequence[ChannelRecords]) -> NDArray:
    """Whether any channel is outside its range in calibration (n, T)."""
    return np.any([each.outside for each in channels], axis=0)


def _moments(error: NDArray) -> tuple[float, float]:
    """Root mean square and mean; NaN where nothing was measured."""
    seen = error[np.isfinite(error)]
    return (float(np.sqrt(np.mean(seen**2))), float(seen.mean())) if len(seen) else (np.nan,) * 2


def _excess(found: Correlogram) -> float:
    """The largest correlation in multiples of its limit."""
    i = found.largest
    return float(np.nan_to_num(abs(found.values[i]) / found.limits[i]))


def _at_lag(found: Correlogram, rate: float, command: str = "") -> tuple[str, str]:
    """The largest correlation, and below it where it is and its limit."""
    i = found.largest
    seconds = abs(found.lags[i]) / rate
    where = f"{seconds:.0f} s" if seconds >= 1000 else f"{seconds:.3g} s"
    if command:
        where = f"{command}, {where} {'later' if found.lags[i] < 0 else 'earlier'}"
    return number(found.values[i], 2), f"{where}; limit {number(found.limits[i], 2)}"


def _autocorrelations(
    errors: dict[str, list[NDArray]],
    outputs: Sequence[ChannelRecords],
    rate: float,
    keys: list[Key],
) -> Figure:
    panels = []
    for i, output in enumerate(outputs[:OUTPUTS]):
        lags = decorrelated_after(next(iter(errors.values()))[i])
        found = {s: _thinned(autocorrelation(each[i], lags)) for s, each in errors.items()}
        first = next(iter(found.values()))
        x = first.lags / rate
        white = "95 % limits of white noise"
        marks: list[Mark] = [Band(x, -first.limits, first.limits, white, "muted", 0.25)]
        marks += [_line(x, each.values, source) for source, each in found.items()]
        panels.append(
            Panel(
                Axis("lag", "s"),
                [Row(Axis("autocorrelation", limits=(-1.05, 1.05), step=0.5), marks)],
                f"Autocorrelation of the error of {output.name}",
                output.name,
                height=300,
            )
        )
    keys = [*keys, Key("95 % limits of white noise", "muted", "bar")]
    return Figure("autocorrelation", panels, keys)


def _cross_correlations(
    errors: dict[str, list[NDArray]],
    outputs: Sequence[ChannelRecords],
    commands: Sequence[ChannelRecords],
    rate: float,
    keys: list[Key],
) -> Figure:
    panels = []
    for i, output in enumerate(outputs[:OUTPUTS]):
        lags = decorrelated_after(next(iter(errors.values()))[i])
        for command in commands[:COMMANDS]:
            marks: list[Mark] = []
            largest = 0.0
            for source, each in errors.items():
                found = _thinned(cross_correlation(each[i], command.values, lags))
                x, colour = found.lags / rate, colour_of(source)
                name = f"95 % limits, {source_name(source)}"
                marks.append(Band(x, -found.limits, found.limits, name, colour, 0.18))
                marks.append(_line(x, found.values, source))
                both = np.concatenate([np.abs(found.values), found.limits])
                largest = float(max(largest, *both[np.isfinite(both)], 0.0))
            y = Axis("correlation", limits=(-1.1 * largest, 1.1 * largest) if largest > 0 else None)
            panels.append(
                Panel(
                    Axis("time by which the command is earlier", "s"),
                    [Row(y, marks)],
                    f"Correlation of the error of {output.name} with {command.name}",
                    f"{output.name}, {command.name}",
                    height=300,
                )
            )
    limits = [Key(f"95 % limits, {key.text}", key.colour, "bar") for key in keys]
    return Figure("crosscorrelation", panels, [*keys, *limits])


def _spectra(
    errors: dict[str, list[NDArray]],
    outputs: Sequence[ChannelRecords],
    rate: float,
    keys: list[Key],
) -> Figure:
    panels = []
    for i, output in enumerate(outputs[:OUTPUTS]):
        series = [output.values, *(each[i] for each in errors.values())]
        frequencies, (signal, *others) = spectra(series, rate)
        if not len(frequencies):
            continue
        marks: list[Mark] = [Line(frequencies, np.sqrt(signal), "measured", "ink", width=1.4)]
        for source, each in zip(errors, others, strict=True):
            marks.append(_line(frequencies, np.sqrt(each), source))
        unit = f"{output.unit}/√Hz" if output.unit else "1/√Hz"
        panels.append(
            Panel(
                _log("frequency", "Hz", frequencies),
                [Row(_log("spectral density", unit, np.sqrt([signal, *others])), marks)],
                f"Spectrum of {output.name} and of its errors",
                output.name,
                height=340,
            )
        )
    return Figure("spectra", panels, [Key("measured output", "ink"), *keys])


def _amplitudes(
    errors: dict[str, list[NDArray]],
    outputs: Sequence[ChannelRecords],
    commands: Sequence[ChannelRecords],
    keys: list[Key],
) -> Figure:
    panels = []
    for i, output in enumerate(outputs[:OUTPUTS]):
        for channel in [output, *commands[:COMMANDS]]:
            ends = (channel.low, channel.high)
            found = {
                name: error_by_amplitude(each[i], channel.values, ends)
                for name, each in errors.items()
            }
            bins = next(iter(found.values()))
            if not len(bins.rms):
                continue
            least, most = float(bins.low.min()), float(bins.high.max())
            beyond = [(least, min(channel.low, most))] * (least < channel.low)
            beyond += [(max(channel.high, least), most)] * (channel.high < most)
            marks: list[Mark] = [Spans(beyond)] if beyond else []
            for source, each in found.items():
                marks.append(_points(each.centre, each.rms, source))
            y = _log("RMS error", output.unit, [each.rms for each in found.values()])
            panels.append(
                Panel(
                    Axis(channel.name, channel.unit),
                    [Row(y, marks)],
                    f"Error of {output.name} by the value of {channel.name}",
                    f"{output.name} by {channel.name}",
                    height=320,
                )
            )
    return Figure("amplitude", panels, [*keys, *([OUTSIDE] if _ranged(outputs) else [])])


def _times(
    errors: dict[str, list[NDArray]],
    outputs: Sequence[ChannelRecords],
    commands: Sequence[ChannelRecords],
    rate: float,
    keys: list[Key],
) -> Figure:
    panels = []
    outside: NDArray = np.any(_outside([*outputs, *commands]), axis=0)
    for i, output in enumerate(outputs[:OUTPUTS]):
        found = {source: rms_over_time(each[i], BLOCKS) for source, each in errors.items()}
        edges = next(iter(found.values()))[0] / rate
        marks: list[Mark] = [Spans(list(_runs(outside, edges, rate)))] if outside.any() else []
        for source, (_, rms) in found.items():
            marks.append(_line((edges[1:] + edges[:-1]) / 2, rms, source))
        panels.append(
            Panel(
                Axis("time", "s", (0, edges[-1]), count=8),
                [Row(_log("RMS error", output.unit, [rms for _, rms in found.values()]), marks)],
                f"Error of {output.name} over time",
                output.name,
                height=300,
            )
        )
    ranged = [OUTSIDE] if outside.any() else []
    return Figure("overtime", panels, [*keys, *ranged], columns=1)


def _runs(outside: NDArray, edges: NDArray, rate: float) -> Iterator[tuple[float, float]]:
    """Spans of time of the blocks with a sample outside; neighbours are one span."""
    starts = np.round(edges * rate).astype(int)
    held = np.add.reduceat(outside, starts[:-1]) > 0
    ends = np.flatnonzero(np.diff(np.concatenate([[0], held, [0]])))
    for first, last in ends.reshape(-1, 2).tolist():
        yield float(edges[first]), float(edges[last])


def _ranged(channels: Sequence[ChannelRecords]) -> bool:
    return any(np.isfinite([each.low, each.high]).any() for each in channels)


def _thinned(found: Correlogram) -> Correlogram:
    """The same at `POINTS` lags at most."""
    kept = np.unique(np.linspace(0, len(found.lags) - 1, POINTS).round().astype(int))
    return Correlogram(*(each[kept] for each in (found.lags, found.values, found.limits)))


def _line(x: NDArray, y: NDArray, source: str) -> Line:
    return Line(x, y, source_name(source), colour_of(source), dash(source), 1.6)


def _points(x: NDArray, y: NDArray, source: str) -> Points:
    return Points(x, y, source_name(source), colour_of(source), dash=dash(source), size=6)


def _log(label: str, unit: str, values: object) -> Axis:
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
