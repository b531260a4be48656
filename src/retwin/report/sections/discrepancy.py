"""The discrepancy: what was observed of it, and what the corrected twins generate.

One figure is of a single segment: its delay (TDe) and position error (TPE), as in the paper's
figure 2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.report import labels
from retwin.report.blocks import Cell, Section, Table, tabulate
from retwin.report.figures.figure import (
    Axis,
    Dimension,
    Figure,
    Key,
    Line,
    Mark,
    Panel,
    Row,
    Spans,
    bar,
    outline,
)
from retwin.report.figures.style import colour_of
from retwin.report.labels import number
from retwin.report.study import Component, Study
from retwin.results import FidelityFigure
from retwin.scores.segments import SegmentError, clearest_segment, median_error_trajectory

Limits = tuple[float, float]
Values = dict[str, NDArray]


@dataclass(frozen=True)
class Segment:
    """The segment of a test trajectory, with the whole trajectory in the same output.

    Attributes
    ----------
    trajectory, output, unit : str
        The trajectory's id, the output's name, and the unit of all values.
    time, nominal, observed : array (P,)
        In s, and in `unit`; observed is NaN where nothing was measured.
    motions : array (M, 2)
        Start and end of the motion in every segment, in s.
    error : SegmentError
        Delay and offset, in s and in `unit`.

    """

    trajectory: str
    output: str
    unit: str
    time: NDArray
    nominal: NDArray
    observed: NDArray
    motions: NDArray
    error: SegmentError

    @property
    def labels(self) -> tuple[str, str]:
        """Delay, and offset with its unit."""
        delay = self.error.delay
        tde = "delay –" if math.isnan(delay) else f"delay {number(1000 * delay, 0)} ms"
        return tde, f"offset {number(self.error.offset, 1)} {self.unit}".rstrip()


def segment(study: Study) -> Segment | None:
    """The clearest segment of the healthy test trajectory with the median error."""
    portrait = study.portrait
    if not portrait:
        return None
    nominal, observed, times = (portrait[name] for name in ("nominal", "observed", "times"))
    healthy = study.overlaid_healthy
    healthy = healthy if healthy.any() else np.ones(len(nominal), dtype=bool)
    place = median_error_trajectory(nominal, observed, times, healthy)
    if place is None:
        return None
    rate, units = float(portrait["rate"]), study.output_quantities
    scale = np.array([factor for factor, _ in units])
    both = scale * nominal[place], scale * observed[place]
    error = clearest_segment(*both, times[place], rate)
    if error is None:
        return None
    known = times[place][np.isfinite(times[place]).all(axis=1)]
    return Segment(
        study.results.data.test.ids[study.results.overlaid[place]],
        study.results.outputs.names[error.output],
        units[error.output][1],
        np.arange(nominal.shape[1]) / rate,
        both[0][:, error.output],
        both[1][:, error.output],
        known[:, :2],
        error,
    )


def segment_figure(found: Segment) -> Figure:
    """The whole trajectory, the segment with TDe, and the difference in it with TPE."""
    error, output = found.error, found.output
    tde, tpe = found.labels
    whole, window = (float(found.time[0]), float(found.time[-1])), (error.onset, error.end)
    both = {"nominal": found.nominal, "measured": found.observed}
    delay = Dimension(*error.midpoints, "delay", (64, 24))
    offset = Dimension((error.settle, error.offset), (error.end, error.offset), "offset", (0, -40))

    missed = {"measured": found.observed - found.nominal}

    def panel(
        title: str, alt: str, limits: Limits, name: str, values: Values, *marks: Mark
    ) -> Panel:
        drawn = [*_lines(found, values, limits), *marks]
        return Panel(Axis("time", "s", limits), [Row(Axis(name, found.unit), drawn)], alt, title)

    shown = [delay] if math.isfinite(error.delay) else []
    alt, below = f"{output} in one segment, {tde}", f"Residual in the same segment, {tpe}"
    name = f"{output} minus nominal"
    panels = [
        panel("Whole trajectory", f"{output} over the whole trajectory", whole, output, both),
        panel(f"One segment: {tde}", alt, window, output, both, *shown),
        panel(f"Residual in this segment: {tpe}", below, window, name, missed, offset),
    ]
    keys = [Key("measured", "ink"), Key("nominal", "muted", "dot"), Key("in motion", "grid", "bar")]
    return Figure("movement", panels, keys)


def _lines(found: Segment, values: Values, limits: Limits) -> Sequence[Mark]:
    """The values within the limits, above shading where there is motion."""
    start, end = limits
    inside = (found.time >= start) & (found.time <= end)
    motions = [
        (max(onset, start), min(settle, end))
        for onset, settle in found.motions.tolist()
        if settle > start and onset < end
    ]
    styles = {"nominal": ("muted", "dot", 1.6), "measured": ("ink", "solid", 1.8)}
    lines = [Line(found.time[inside], y[inside], name, *styles[name]) for name, y in values.items()]
    return [Spans(motions), *lines]


KINDS = {"tde": "delay", "tpe": "offset_", "noise": "noise_"}
"""The figures by name, and the first letters of the components of z that they show."""


def discrepancy(study: Study) -> Section | None:
    """One segment, observed and generated distributions of z, and tests of their agreement."""
    found = segment(study)
    example = None if found is None else segment_figure(found)
    groups = [group for source in suffixes(study) for group in _groups(study, source)]
    shown = [group for group in groups if group["source"] in detailed(study)]
    tables = [
        {"table": table, "segments": study.results.fidelity[source].segments}
        for source in detailed(study)
        if (table := _agreement(study, source)) is not None
    ]
    if example is None and not shown and not tables:
        return None
    figures = ([example] if example else []) + [group["figure"] for group in shown]
    further = [group["figure"] for group in groups if group not in shown]
    values = {"segment": found, "example": example, "groups": shown, "tables": tables}
    return Section("discrepancy", "Discrepancy", values, figures, further)


def suffixes(study: Study) -> dict[str, str]:
    """The end of the figures' names for each source: empty for the first, then -2, -3."""
    known = labels.order(study.results.fidelity)
    return {source: f"-{place + 1}" if place else "" for place, source in enumerate(known)}


def detailed(study: Study, *, few: int = 3) -> list[str]:
    """Sources that are shown in detail; of many, the updated ones.

    Parameters
    ----------
    few : int, default 3
        The number of sources up to which all are shown in detail.

    """
    known = labels.order(study.results.fidelity)
    return known if len(known) <= few else labels.with_role(known, "updated") or known[-few:]


def titled(study: Study, source: str, title: str) -> str:
    """The title of a table, with the source where there are several."""
    return f"{title}, {labels.source_name(source)}" if len(study.results.fidelity) > 1 else title


def figure_cell(figure: FidelityFigure | None, digits: int = 3, factor: float = 1.0) -> Cell:
    """A figure with its interval below it."""
    if figure is None:
        return Cell("–")
    scaled = None if figure.ends is None else [factor * end for end in figure.ends]
    below = "" if scaled is None else f"[{labels.span(scaled, digits)}]"
    return Cell(labels.number(factor * figure.value, digits), below)


def latents(study: Study, source: str) -> list[Component]:
    """Every component of z of which there are observed and generated values."""
    return [each for each in study.components(source) if each.values is not None]


def _groups(study: Study, source: str) -> list[dict[str, Any]]:
    """Delays, offsets, noise and the rest: a figure each, with what its caption states."""
    left = latents(study, source)
    groups = []
    for name, start in {**KINDS, "z": ""}.items():
        shown = [each for each in left if each.name.startswith(start)]
        left = [each for each in left if each not in shown]
        if shown:
            figure = _figure(source, f"{name}{suffixes(study)[source]}", shown)
            groups.append({"source": source, "kind": name, "figure": figure, "latents": shown})
    return groups


def _figure(source: str, name: str, shown: list[Component]) -> Figure:
    """Observed as bars, generated as a stepped line, a panel per component."""
    keys = [Key("observed", "observed", "bar"), Key("generated", colour_of(source))]
    panels = [_panel(each, colour_of(source)) for each in shown]
    return Figure(name, panels, keys, source, narrow=len(panels) == 1)


def _panel(latent: Component, colour: str) -> Panel:
    title, label = labels.latent_names(latent.name)
    values = latent.values
    assert values is not None
    low, high = float(values.edges[0]), float(values.edges[-1])
    marks = [
        bar(values.edges, values.observed, "observed", "observed"),
        Line(*outline(values.edges, values.generated), "generated", colour, width=2.2),
    ]
    limits = f"{labels.number(low, 1)} to {labels.number(high, 1)}"
    x = Axis(label, latent.unit, (low, high), count=7)
    y = Axis("share per bin", kind="percent", from_zero=True)
    alt = labels.with_unit(f"{title}, observed and generated, {limits}", latent.unit)
    return Panel(x, [Row(y, marks)], alt, title, height=300)


def _agreement(study: Study, source: str) -> Table | None:
    fidelity = study.results.fidelity[source]
    rows = [
        [
            labels.latent_names(name)[0],
            figure_cell(distance, 2),
            labels.number(distance.p, 2),
            figure_cell(fidelity.figures.get(f"coverage90/{name}"), 2),
        ]
        for name, distance in fidelity.agreement.items()
    ]
    heads = "Per segment", "KS distance", "p", "in the 90 % range"
    return tabulate(titled(study, source, "Agreement per segment"), heads, rows) if rows else None
