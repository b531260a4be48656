"""Delay (TDe) and position error (TPE) in one segment of a trajectory (the paper's figure 2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.report.figures.figure import Axis, Dimension, Figure, Key, Line, Mark, Panel, Row, Spans
from retwin.report.labels import number
from retwin.report.study import Study
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
