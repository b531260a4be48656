"""Figures of the page: estimates in their ranges, records before and after, residuals."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.evaluation.identification.validation import Identification
from retwin.report.figures.figure import (
    Axis,
    Figure,
    Key,
    Line,
    Mark,
    Panel,
    Points,
    Row,
    record_panel,
)
from retwin.report.figures.residual_panels import ChannelRecords, Errors, residual_figures
from retwin.report.labels import behind

OUTPUTS, INPUTS = 6, 3
"""Outputs and inputs of which figures are drawn, at most."""
SAMPLES = 1500
"""Samples of a record that are drawn, at most."""
BEFORE, AFTER, MEASURED = "c1", "c0", "ink"
KEYS = (Key("before", BEFORE, "dash"), Key("after", AFTER))
ROW_HEIGHT, MARGIN = 34, 80
"""Pixels of a parameter in the figure of estimates, and of its axis."""


def figures(found: Identification) -> dict[str, Figure]:
    """The figures that have something to show, by name."""
    measured, before, after = found.simulated[found.compared]
    errors = [measured.measured.astype(float) - each for each in (before, after)]
    shown = [i for i in range(len(measured.outputs)) if measured.mask[..., i].any()][:OUTPUTS]
    made = [_estimates(found), _records(found, shown), *_residuals(measured, errors, shown)]
    return {each.name: each for each in made if each.panels}


def _estimates(found: Identification) -> Figure:
    """Each estimate and its interval within its range, the first parameter on top."""
    known = found.parameters
    place = np.arange(len(known))[::-1].astype(float)
    low = np.array([each.low for each in known])
    width = np.array([each.high for each in known]) - low

    def shares(values: Iterable[float]) -> NDArray:
        return (np.array(list(values)) - low) / width

    ends = [each.interval or (each.value, each.value) for each in known]
    start, value = (shares(getattr(each, name) for each in known) for name in ("start", "value"))
    inside = [np.clip(shares(values), 0, 1).tolist() for values in zip(*ends, strict=True)]
    bars = list(zip(*inside, strict=True))
    texts = [behind(f"{each.name}: {each.value:.4g}", each.unit) for each in known]
    first = [f"{each.name} before: {each.start:.4g}" for each in known]
    marks: list[Mark] = [
        Points(start, place, "before", BEFORE, "diamond-open", texts=first),
        Points(value, place, "after", AFTER, ends=bars, texts=texts, bar_width=3),
    ]
    ticks = {at: each.name for at, each in zip(place.tolist(), known, strict=True)}
    panel = Panel(
        Axis("place in its range", "", (-0.03, 1.03), "percent", step=0.25),
        [Row(Axis("", kind="names", limits=(-0.6, len(known) - 0.4), ticks=ticks), marks)],
        "Estimates of the parameters and their 95 % intervals within their ranges",
        height=MARGIN + ROW_HEIGHT * len(known),
    )
    keys = [Key("before", BEFORE, "diamond"), Key("after, with its 95 % interval", AFTER, "circle")]
    return Figure("estimates", [panel], keys, columns=1)


def _records(found: Identification, shown: list[int]) -> Figure:
    """Measured and simulated outputs of the trajectory with the median error after."""
    measured, before, after = found.simulated[found.compared]
    row = _typical(measured, after)
    seen = measured.mask[row].any(axis=1)
    samples = np.flatnonzero(seen)
    first, last = int(samples[0]), int(samples[-1]) + 1
    chosen = np.arange(first, last, max(1, -(-(last - first) // SAMPLES)))
    times = chosen / measured.rate
    panels = []
    for i in shown:
        values = measured.measured[row, chosen, i]
        marks: list[Mark] = [
            Line(times, values, "measured", MEASURED, width=2.6, alpha=0.45),
            Line(times, before[row, chosen, i], "before", BEFORE, "dash", 1.6),
            Line(times, after[row, chosen, i], "after", AFTER, width=1.6),
        ]
        name, unit = measured.outputs.names[i], measured.outputs.units[i]
        panels.append(record_panel(times, name, unit, marks))
    keys = [Key("measured", MEASURED), *KEYS]
    return Figure("records", panels, keys, str(measured.ids[row]), columns=1)


def _typical(measured: Trajectories, after: NDArray) -> int:
    """The trajectory whose error, over all outputs in units of their spread, is the median."""
    error = measured.measured - after
    values = [measured.observed[..., i][measured.mask[..., i]] for i in range(error.shape[2])]
    spread = np.array([each.std() if len(each) else 0.0 for each in values])
    scaled = error / np.where(spread > 0, spread, 1.0)
    seen = np.isfinite(scaled)
    count = np.maximum(seen.sum(axis=(1, 2)), 1)
    mean = np.where(seen, scaled**2, 0.0).sum(axis=(1, 2)) / count
    known = np.flatnonzero(seen.any(axis=(1, 2)))
    return int(known[np.argsort(mean[known])[(len(known) - 1) // 2]])


def _residuals(measured: Trajectories, errors: list[NDArray], shown: list[int]) -> list[Figure]:
    """Correlations and spectra of the residuals after and before, of outputs that have some."""
    about, rate = measured.outputs, measured.rate
    drawn = []
    for i in shown:
        pair = [each[..., i] for each in errors]
        if all(map(_useful, pair)):
            values = measured.measured[..., i].astype(float)
            output = ChannelRecords(about.names[i], about.units[i], values)
            drawn.append(Errors(output, dict(zip(reversed(KEYS), reversed(pair), strict=True))))
    commands = [
        ChannelRecords(name, "", measured.commands[..., j].astype(float))
        for j, name in enumerate(measured.inputs.names[:INPUTS])
        if np.ptp(measured.commands[..., j]) > 0
    ]
    return residual_figures(drawn, commands, KEYS, rate)


def _useful(residual: NDArray) -> bool:
    """Whether correlations of a residual are defined."""
    values = residual[np.isfinite(residual)]
    return len(values) > 16 and bool(np.ptp(values) > 0)
