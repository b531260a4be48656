"""Scores by the number of healthy calibration trajectories."""

from __future__ import annotations

import math
from typing import Any

from retwin.catalog import METRICS
from retwin.report.blocks import Section
from retwin.report.figures.figure import Axis, Figure, Key, Panel, Points, Row
from retwin.report.figures.style import colour_index, colour_of, dash, symbol
from retwin.report.labels import in_sentence, metric_name, metric_quantity, order, source_name
from retwin.report.study import Study
from retwin.results.sources import CurvePoint

Curves = dict[str, list[CurvePoint]]


def learning(study: Study) -> Section | None:
    """A panel per metric with the curves of all sources."""
    curves = {metric: found for metric in METRICS if (found := _curves(study, metric))}
    if not curves:
        return None
    first = next(iter(curves.values()))
    keys = [Key(source_name(name), colour_of(name), dash(name)) for name in first]
    panels = [_panel(study, metric, found) for metric, found in curves.items()]
    figure = Figure("learning", panels, keys)
    return Section("learning", "Learning curve", {"figure": figure}, [figure])


def _curves(study: Study, metric: str) -> Curves:
    """The points of every source at which the metric is defined, by number of trajectories."""
    points = sorted(study.results.learning_curve or [], key=lambda point: point.healthy)
    known = [point for point in points if math.isfinite(point.mean(metric))]
    names = order(sorted({point.source for point in known}))
    return {name: [point for point in known if point.source == name] for name in names}


def _panel(study: Study, metric: str, curves: Curves) -> Panel:
    factor, unit = metric_quantity(metric, study.results.outputs.units)
    counts = sorted({point.healthy for points in curves.values() for point in points})
    title = in_sentence(metric_name(metric))
    if METRICS[metric].unit == "output":
        y = Axis(title, unit, from_zero=True)
    else:
        y = Axis(title, limits=(-0.02, 1.02), kind="share", step=0.2)
    marks = [_points(metric, name, points, factor) for name, points in curves.items()]
    x = Axis("healthy trajectories", kind="log", ticks={count: str(count) for count in counts})
    alt = f"{title} against calibration trajectories"
    return Panel(x, [Row(y, marks)], alt, title, height=320)


def _points(metric: str, source: str, points: list[CurvePoint], factor: float) -> Points:
    means = [factor * point.mean(metric) for point in points]
    known = [point.interval(metric) for point in points]
    ends = [
        (m, m) if each is None else (factor * each[0], factor * each[1])
        for each, m in zip(known, means, strict=True)
    ]
    # Sources stand side by side, so that intervals do not cover each other.
    shift = 1.02 ** (colour_index(source) - 3)
    x = [point.healthy * shift for point in points]
    texts = [f"{point.healthy}: {m:.3f}" for point, m in zip(points, means, strict=True)]
    look: Any = {"symbol": symbol(source), "dash": dash(source), "size": 7, "bar_width": 1.4}
    name, colour = source_name(source), colour_of(source)
    return Points(x, means, name, colour, ends=ends, along="y", texts=texts, **look)
