"""The first page: what was updated, how wrong it was and is, and what was learned."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.report.blocks import Table, tabulate
from retwin.report.figures.figure import Axis, Figure, Key, Line, Mark, Panel, Row, bar, draw_bands
from retwin.report.figures.style import colour_of
from retwin.report.labels import (
    behind,
    learned_name,
    number,
    percent,
    percents,
    places,
    quantities,
    quantity,
    source_name,
    span,
)
from retwin.report.study import Study
from retwin.report.uses import RULE, use_rows
from retwin.report.verdict import headline
from retwin.scores.change import ErrorChange
from retwin.scores.intervals import grouped_share_interval, jackknife_interval
from retwin.scores.segments import median_error_trajectory
from retwin.scores.uses import error_of

BAR = 0.38
"""Width of a bar; groups of bars are 1 apart."""


def summary(study: Study) -> dict[str, Any] | None:
    """The variables of the template `summary.html.j2`; None without an updated twin."""
    pair = headline(study.results)
    if pair is None:
        return None
    return {
        "rows": use_rows(study.results),
        "rule": RULE,
        "learned": learned(study),
        "figure": picture(study),
    }


def learned(study: Study) -> Table | None:
    """What the healthy test trajectories show of the discrepancy, in the machine's units.

    The mean over trajectories of each component of z, its 95 % interval over trajectories, and the
    range of single segments.
    """
    rows: dict[str, tuple[list[str], int]] = {}
    for component in (*_segment_values(study), *_held_out_values(study)):
        name, row = component[0], _row(*component)
        # Of a component that both have, the one that more segments identify.
        if row and (name not in rows or row[1] > rows[name][1]):
            rows[name] = row
    heads = ["Quantity", "Mean", "95 % interval", "Range of 90 % of the segments"]
    heads += ["Generated mean", "Segments"]
    cells = [[learned_name(name), *texts, str(count)] for name, (texts, count) in rows.items()]
    return tabulate("What was learned", heads, cells).without_empty() if rows else None


Values = Iterator[tuple[str, str, NDArray, float | None]]
"""Components of z: name, unit, values (trajectories, segments), NaN where they are not identified,
and the mean of those that the updated twin generates, if it is known."""


def _segment_values(study: Study) -> Values:
    """Delays, offsets and missed segments, inferred from every healthy test trajectory."""
    overlay, values = study.results.overlay, study.arrays.get("portrait/z")
    if overlay is None or values is None or not study.overlaid_healthy.any():
        return
    units = quantities(overlay.latent_units, len(overlay.latents))
    for column, (name, (factor, unit)) in enumerate(zip(overlay.latents, units, strict=True)):
        yield name, unit, factor * values[study.overlaid_healthy, :, column].astype(float), None


def _held_out_values(study: Study) -> Values:
    """Delay, and noise at rest of each output, measured and generated.

    Offsets too, where no others are known from every test trajectory.
    """
    pair = headline(study.results)
    if pair is None:
        return
    owner = study.arrays.get(f"z/{pair[0]}/trajectory")
    kinds = ("noise_", "delay", *([] if study.results.overlay else ["offset_"]))
    for each in study.components(pair[0]):
        if not each.name.startswith(kinds):
            continue
        values, drawn = each.observed.astype(float), each.predicted[np.isfinite(each.predicted)]
        groups = [values] if owner is None else [values[owner == i] for i in np.unique(owner)]
        size = max(map(len, groups))
        padded = [np.pad(part, (0, size - len(part)), constant_values=np.nan) for part in groups]
        mean = float(drawn.astype(float).mean()) if len(drawn) else None
        yield each.name, each.unit, np.array(padded), mean


def _row(
    name: str, unit: str, values: NDArray, generated: float | None
) -> tuple[list[str], int] | None:
    """Texts of `Values`, and how many segments identify them; None where nothing is identified."""
    values = values[np.isfinite(values).any(axis=1)]
    if not len(values):
        return None
    counts = np.isfinite(values).sum(axis=1)
    single, total = values[np.isfinite(values)], int(counts.sum())
    if name.startswith("missed"):
        hits = np.nansum(values, axis=1)
        ends = grouped_share_interval(hits, counts)
        return [percent(float(hits.sum() / total), 1), percents(ends), "–", "–"], total
    means = np.nanmean(values, axis=1)
    ends = jackknife_interval(lambda weights: weights @ means, len(means))
    low, high = np.quantile(single, [0.05, 0.95])
    mean = float(means.mean())
    digits = places([mean, low, high])
    # Number of segments below which no range of them is shown.
    texts = [
        number(mean, digits),
        span(ends, digits),
        span((low, high) if total >= 10 else None, digits),
        number(generated, digits),
    ]
    return [text if text == "–" else behind(text, unit) for text in texts], total


def picture(study: Study) -> Figure | None:
    """A typical trajectory with the corrected band, and bars of the error before and after."""
    pair = headline(study.results)
    if pair is None:
        return None
    measured = error_of(study.results, study.arrays)
    if measured is not None:
        pair = measured[-1], pair[1]
    shown = _trajectory(study, pair) or _record(study, pair)
    bars = None if measured is None else _bars(study, *measured)
    panels = [each for each in (shown, bars) if each is not None]
    if not panels:
        return None
    colour = colour_of(pair[0])
    before, after = f"before: {source_name(pair[1])}", f"after: {source_name(pair[0])}"
    lines = [
        Key("measured", "ink"),
        Key(before, "muted", "dot"),
        Key(f"{after}, 90 % and 50 % bands", colour, "bar"),
    ]
    titles = ("error before", "error after") if shown else (before, after)
    errors = [Key(titles[0], "muted", "bar"), Key(titles[1], colour, "bar")]
    keys = [*(lines if shown else []), *(errors if bars else [])]
    return Figure("summary", panels, keys, columns=2)


def _trajectory(study: Study, pair: tuple[str, str], *, mostly: float = 0.5) -> Panel | None:
    """The healthy test trajectory with the median error, in the output with the largest one.

    Parameters
    ----------
    mostly : float, default 0.5
        The share of a trajectory that was measured, at least, if none was measured completely.

    """
    overlay, portrait = study.results.overlay, study.portrait
    if overlay is None or overlay.source != pair[0] or not portrait:
        return None
    names = "nominal", "observed", "times", "bands"
    nominal, observed, times, bands = (portrait[name] for name in names)
    chosen = partial(median_error_trajectory, nominal, observed, times, study.overlaid_healthy)
    # Where no healthy trajectory is complete, one of which most was measured.
    place = chosen() if chosen() is not None else chosen(at_least=mostly)
    if place is None:
        return None
    outputs = study.results.outputs
    # Masked, since an output may lack any measured value.
    measured = np.ma.masked_invalid(observed.astype(float))
    spread = measured[study.overlaid_healthy].std(axis=(0, 1)).filled(0.0)
    error = np.sqrt(np.square(measured[place] - nominal[place]).mean(axis=0).filled(0.0))
    column = int(np.argmax(error / np.where(spread > 0, spread, np.inf)))
    time = np.arange(nominal.shape[1]) / float(portrait["rate"])
    where = f"a typical healthy run ({study.results.data.test.ids[study.results.overlaid[place]]})"
    values = nominal[place, :, column], observed[place, :, column], bands[place, :, :, column]
    shown = outputs.names[column], *study.output_quantities[column]
    return _panel(shown, where, time, values, colour_of(pair[0]))


def _record(study: Study, pair: tuple[str, str]) -> Panel | None:
    """The first test record of a study without classes."""
    names = ("simulation/observed", *(f"simulation/{name}/mean" for name in pair))
    if any(name not in study.arrays for name in names):
        return None
    observed, after, before = (study.arrays[name][0, :, 0] for name in names)
    bands = study.arrays.get(f"simulation/{pair[0]}/bands")
    drawn = np.tile(after, (5, 1)) if bands is None else bands[0, :, :, 0]
    outputs = study.results.outputs
    time = np.arange(len(observed)) / float(study.arrays["simulation/rate"])
    output = (outputs.names or ["output"])[0], *quantities(outputs.units, 1)[0]
    record = f"test record “{study.arrays['simulation/ids'][0]}”"
    return _panel(output, record, time, (before, observed, drawn), colour_of(pair[0]))


def _panel(
    output: tuple[str, float, str],
    where: str,
    time: NDArray,
    values: tuple[NDArray, NDArray, NDArray],
    colour: str,
) -> Panel:
    """A panel of nominal and measured values (P,) and quantiles (5, P) of one output."""
    name, factor, unit = output
    before, measured, bands = (factor * np.asarray(each, float) for each in values)
    marks: list[Mark] = [
        *draw_bands(time, bands, colour),
        Line(time, before, "before", "muted", "dot", 1.6),
        Line(time, bands[2], "after, median", colour, width=1.2),
        Line(time, measured, "measured", "ink", width=1.5),
    ]
    x, title = Axis("time", "s", (float(time[0]), float(time[-1]))), f"{name} in {where}"
    alt = f"{title}: measured, before and after the update"
    return Panel(x, [Row(Axis(name, unit), marks)], alt, title, height=270)


def _bars(study: Study, change: ErrorChange, given: str, source: str) -> Panel:
    """The error of each output before and after the update, in a given unit."""
    factor, unit = (1.0, "σ") if given == "σ" else quantity(given)
    before, after = factor * change.outputs_before, factor * change.outputs_after
    names = study.results.outputs.names
    # Number of outputs beyond which one pair of bars stands for all of them.
    if len(before) > 6 or len(before) != len(names):
        before, after = (np.array([factor * each]) for each in (change.before, change.after))
        names = ["all outputs"]
    marks = [
        bar(place + shift + np.array([0.0, BAR]), np.array([value]), title, colour)
        for values, shift, title, colour in (
            (before, -BAR, "before", "muted"),
            (after, 0.0, "after", colour_of(source)),
        )
        for place, value in enumerate(values)
        if math.isfinite(value)
    ]
    ticks = {float(place): name for place, name in enumerate(names)}
    shown = "" if unit == "σ" else unit
    simulated = study.results.overlay is None
    title = "Root mean square error" if simulated else "Mean absolute error, healthy runs"
    x = Axis("", limits=(-0.6, len(names) - 0.4), kind="names", ticks=ticks)
    y = Axis("error" if unit != "σ" else "error / σ", shown, from_zero=True)
    alt = f"{title}, each output, before and after the update"
    return Panel(x, [Row(y, marks)], alt, title, height=270)
