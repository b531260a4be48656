"""Delay (TDe) and position error (TPE) in one segment of a trajectory (the paper's figure 2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import HEALTHY
from retwin.report.figure import Axis, Dimension, Figure, Key, Line, Mark, Panel, Row, Spans
from retwin.report.labels import number, quantity
from retwin.report.study import Study
from retwin.scores.segments import SegmentError, clearest_segment, median_error_trajectory


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
    if study.results.overlay is None or "portrait/bands" not in study.arrays:
        return None
    nominal, observed, times = (
        study.arrays[f"portrait/{name}"] for name in ("nominal", "observed", "times")
    )
    labels = np.array(study.results.data.test.labels)
    healthy = labels == HEALTHY if HEALTHY in labels else np.ones(len(labels), dtype=bool)
    place = median_error_trajectory(nominal, observed, times, healthy)
    if place is None:
        return None
    rate = float(study.arrays["portrait/rate"])
    outputs = study.results.outputs
    scale = np.array([quantity(unit)[0] for unit in outputs.units])
    both = scale * nominal[place], scale * observed[place]
    error = clearest_segment(*both, times[place], rate)
    if error is None:
        return None
    known = times[place][np.isfinite(times[place]).all(axis=1)]
    return Segment(
        study.results.data.test.ids[place],
        outputs.names[error.output],
        quantity(outputs.units[error.output])[1],
        np.arange(nominal.shape[1]) / rate,
        both[0][:, error.output],
        both[1][:, error.output],
        known[:, :2],
        error,
    )


def segment_figure(found: Segment) -> Figure:
    """The whole trajectory, the segment with TDe, and the difference in it with TPE."""
    error = found.error
    tde, tpe = found.labels
    window = error.onset, error.end
    difference = found.observed - found.nominal
    delay = Dimension(*error.midpoints, "delay", (64, 24))
    offset = Dimension((error.settle, error.offset), (error.end, error.offset), "offset", (0, -40))
    panels = [
        Panel(
            Axis("time", "s", limits),
            [Row(Axis(label, found.unit), [*_lines(found, values, limits), *marks])],
            alt,
            title,
        )
        for limits, label, values, marks, alt, title in (
            (
                (float(found.time[0]), float(found.time[-1])),
                found.output,
                {"nominal": found.nominal, "measured": found.observed},
                [],
                f"{found.output} over the whole trajectory",
                "Whole trajectory",
            ),
            (
                window,
                found.output,
                {"nominal": found.nominal, "measured": found.observed},
                [delay] if math.isfinite(error.delay) else [],
                f"{found.output} in one segment, {tde}",
                f"One segment: {tde}",
            ),
            (
                window,
                f"{found.output} minus nominal",
                {"measured": difference},
                [offset],
                f"Residual in the same segment, {tpe}",
                f"Residual in this segment: {tpe}",
            ),
        )
    ]
    keys = [Key("measured", "ink"), Key("nominal", "muted", "dot"), Key("in motion", "grid", "bar")]
    return Figure("movement", panels, keys)


def _lines(
    found: Segment, values: dict[str, NDArray], limits: tuple[float, float]
) -> Sequence[Mark]:
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
