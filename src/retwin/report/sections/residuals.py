"""Residual diagnostics of simulated records: whiteness, commands, spectra, amplitude, time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from retwin.arrays import runs
from retwin.report.blocks import Cell, Section, tabulate
from retwin.report.figures.figure import Axis, Figure, Key, Mark, Panel, Points, Row, Spans
from retwin.report.figures.residual_panels import (
    ChannelRecords,
    Errors,
    line,
    log_axis,
    residual_figures,
)
from retwin.report.figures.style import colour_of, dash
from retwin.report.labels import decimals, number, p_value, quantity, source_name, with_unit
from retwin.report.study import Study
from retwin.scores.residuals import (
    Correlogram,
    autocorrelation,
    cross_correlation,
    error_by_amplitude,
    ljung_box,
    rms_over_time,
)

OUTPUTS = 3
"""Outputs of which figures are drawn, at most."""
COMMANDS = 3
"""Commands of which figures are drawn, at most."""


def residuals(study: Study) -> Section | None:
    """A table of all sources; figures of the plain twin, the best other one, and `dynamics`."""
    known = [name for name in study.sources if f"simulation/{name}/mean" in study.arrays]
    if not known or "simulation/commands" not in study.arrays:
        return None
    best = sorted(known[1:], key=lambda name: study.sources[name].mean("nrmse"))[:1]
    shown = list(dict.fromkeys([known[0], *best, *(name for name in known if name == "dynamics")]))
    commands, errors = _channels(study, "commands"), _errors(study, known)
    channels = [*(each.output for each in errors), *commands]
    outside = np.any([each.outside for each in channels], axis=0)
    drawn = [
        Errors(each.output, {key: each.by_key[key] for key in map(_key, shown)}) for each in errors
    ]
    figures = _figures(study, drawn, commands, outside)
    figures = [each for each in figures if each.panels]
    heads = ["Source", "RMSE", "mean error", "largest autocorrelation", "p, white"]
    heads += ["largest correlation with a command", "RMSE outside the calibration"]
    rows: list[list[object]] = []
    for each in errors:
        if len(errors) > 1:
            rows.append([with_unit(each.output.name, each.output.unit)])
        for source, error in zip(known, each.by_key.values(), strict=True):
            found = _row(error, commands, each.lags, outside, _rate(study))
            rows.append([Cell(source_name(source), source=source), *found])
    title = "Residuals of all sources"
    title = title if len(errors) > 1 else with_unit(title, errors[0].output.unit)
    values = {
        "table": tabulate(title, heads, rows),
        "figures": {each.name: each for each in figures},
        "best": min(known, key=lambda name: study.sources[name].mean("nrmse")),
        "limited": len(errors) > OUTPUTS or len(commands) > COMMANDS,
        "ranged": "simulation/range" in study.arrays,
    }
    return Section("residuals", "Residual diagnostics", values, figures)


def _figures(
    study: Study, errors: list[Errors], commands: list[ChannelRecords], outside: NDArray
) -> list[Figure]:
    """All figures, of the first outputs and commands."""
    ranged = any(np.isfinite([each.output.low, each.output.high]).any() for each in errors)
    rate, errors, drawn = _rate(study), errors[:OUTPUTS], commands[:COMMANDS]
    keys = list(errors[0].by_key)
    amplitudes = [_amplitudes(each, of) for each in errors for of in (each.output, *drawn)]
    beyond, late = (
        [Key("outside the range of the calibration", "grid", "bar")] * bool(known)
        for known in (ranged, outside.any())
    )
    over_time = [_over_time(each, np.any(outside, axis=0), rate) for each in errors]
    return [
        *residual_figures(errors, drawn, keys, rate),
        Figure("amplitude", [e for e in amplitudes if e], [*keys, *beyond]),
        Figure("overtime", over_time, [*keys, *late], columns=1),
    ]


def _key(source: str) -> Key:
    return Key(source_name(source), colour_of(source), dash(source))


def _rate(study: Study) -> float:
    return float(study.arrays["simulation/rate"])


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


def _errors(study: Study, sources: Sequence[str]) -> list[Errors]:
    """The errors of each output, in the units that are shown."""
    means = {name: study.arrays[f"simulation/{name}/mean"].astype(float) for name in sources}
    outputs = _channels(study, "observed")
    units = study.results.outputs.units or [""] * len(outputs)
    made = []
    for i, each in enumerate(outputs):
        factor = quantity(units[i])[0]
        errors = {_key(name): each.values - factor * mean[..., i] for name, mean in means.items()}
        made.append(Errors(each, errors))
    return made


def _row(
    error: NDArray, commands: Iterable[ChannelRecords], lags: int, outside: NDArray, rate: float
) -> list[object]:
    """The cells of one source for one output."""
    own = autocorrelation(error)
    crossed = [(u, cross_correlation(error, u.values, lags)) for u in commands]
    command, cross = max(crossed, key=lambda pair: _excess(pair[1]))
    (rms, mean), (beyond, _) = _moments(error), _moments(error[outside])
    share = np.mean(outside[np.isfinite(error)]) if np.isfinite(rms) else 0.0
    return [
        number(rms),
        number(mean, decimals(rms)),
        Cell(*_at_lag(own, rate)),
        p_value(ljung_box(own)[1]),
        Cell(*_at_lag(cross, rate, command.name)),
        Cell(number(beyond, decimals(rms)), f"{100 * share:.2g} % of the samples"),
    ]


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


def _amplitudes(errors: Errors, of: ChannelRecords) -> Panel | None:
    """The error by the value of a channel; None where nothing was measured."""
    ends = (of.low, of.high)
    found = {s: error_by_amplitude(e, of.values, ends) for s, e in errors.by_key.items()}
    bins = next(iter(found.values()))
    if not len(bins.rms):
        return None
    least, most = float(bins.low.min()), float(bins.high.max())
    beyond = [(least, min(of.low, most))] * (least < of.low)
    beyond += [(max(of.high, least), most)] * (of.high < most)
    marks: list[Mark] = [Spans(beyond)] if beyond else []
    for key, each in found.items():
        x, y = each.centre, each.rms
        marks.append(Points(x, y, key.text, key.colour, dash=key.mark, size=6))
    name, alt = errors.output.name, f"Error of {errors.output.name} by the value of {of.name}"
    rows = [Row(log_axis("RMS error", errors.output.unit, [e.rms for e in found.values()]), marks)]
    return Panel(Axis(of.name, of.unit), rows, alt, f"{name} by {of.name}", height=320)


def _over_time(errors: Errors, outside: NDArray, rate: float, *, blocks: int = 40) -> Panel:
    """The error over time, and where a channel of any record is outside (T,).

    Parameters
    ----------
    blocks : int, default 40
        Blocks of the error over time.

    """
    found = {key: rms_over_time(e, blocks) for key, e in errors.by_key.items()}
    edges = next(iter(found.values()))[0] / rate
    marks: list[Mark] = [Spans(list(_runs(outside, edges, rate)))] if outside.any() else []
    for key, (_, rms) in found.items():
        marks.append(line((edges[1:] + edges[:-1]) / 2, rms, key))
    x, name = Axis("time", "s", (0, edges[-1]), count=8), errors.output.name
    y = log_axis("RMS error", errors.output.unit, [rms for _, rms in found.values()])
    return Panel(x, [Row(y, marks)], f"Error of {name} over time", name, height=300)


def _runs(outside: NDArray, edges: NDArray, rate: float) -> Iterator[tuple[float, float]]:
    """Spans of time of the blocks with a sample outside; neighbours are one span."""
    starts = np.round(edges * rate).astype(int)
    for first, last in runs(np.add.reduceat(outside, starts[:-1]) > 0):
        yield float(edges[first]), float(edges[last])
