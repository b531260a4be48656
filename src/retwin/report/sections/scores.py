"""The scores of all sources beside the paper's, as tables and as a figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from retwin.catalog import METRICS
from retwin.report.blocks import Cell, Column, Section, Table, tabulate
from retwin.report.figures.figure import Axis, Figure, Heading, Key, Mark, Panel, Points, Row
from retwin.report.figures.style import colour_of, symbol
from retwin.report.labels import (
    MAIN,
    MANY,
    SELECTED,
    decimals,
    duration,
    mean_and_deviation,
    metric_name,
    metric_quantity,
    real_data,
    source_name,
    span,
    with_unit,
)
from retwin.report.study import Study
from retwin.results import Results
from retwin.results.sources import SourceResults


def scores(study: Study) -> Section | None:
    """Table 1 of the paper, with this study's scores, and the same as a figure."""
    shown = [name for name in MAIN if study.results.has(name)]
    if not shown:
        return None
    values = _table(study, shown)
    if not study.results.classes:
        table = values["table"]
        costs = [Cell(duration(source.update_s)) for source in study.sources.values()]
        rows = [[*row, cost] for row, cost in zip(table.rows, costs, strict=True)]
        values["table"] = Table(table.title, [*table.columns, Column("Update")], rows)
    many = len(study.sources) > MANY
    drawn = [name for name in shown if not (many and study.results.classes) or name in SELECTED]
    drawn = [name for name in drawn if METRICS[name].better > 0]
    figures = [_figure(study, drawn)] if drawn else []
    values["figure"] = next(iter(figures), None)
    return Section("scores", "Scores", values, figures)


def _table(study: Study, metrics: Sequence[str]) -> dict[str, Any]:
    """A row per source, and what the caption states of it."""
    results = study.results
    paper = any(_in_paper(results, name) for name in metrics)
    shown = {name: metric_quantity(name, results.outputs.units) for name in metrics}
    heads = ["Training data" if results.classes else "Source"]
    heads += [with_unit(metric_name(name), unit) for name, (_, unit) in shown.items()]
    best = {name: _best(results, name) for name in metrics}
    rows = []
    for name, source in study.sources.items():
        used = f"{study.word} data: {real_data(source.real_data, classes=bool(results.classes))}"
        known = ["fault protocol known"] if source.fault_protocol_known else []
        row: list[object] = [Cell(source_name(name), "; ".join([name, used, *known]), source=name)]
        for metric, (factor, _) in shown.items():
            values, interval = factor * np.asarray(source.runs(metric)), source.interval(metric)
            ends = [factor * end for end in interval or ()]
            below = f"[{span(ends, decimals(factor * source.mean(metric)))}]" if ends else ""
            published = results.published.get(name, {}).get(metric, "")
            text, leads = mean_and_deviation(values), name in best[metric]
            row.append(Cell(text, below, best=leads, paper=published))
        rows.append(row)
    return {
        "table": tabulate("Scores of all sources", heads, rows),
        "paper": paper,
        "intervals": any(source.intervals for source in study.sources.values()),
    }


def _in_paper(results: Results, metric: str) -> bool:
    return any(metric in results.published.get(source, {}) for source in results.sources)


def _best(results: Results, metric: str) -> list[str]:
    """The sources with the best mean; none where there is no choice."""
    better = METRICS[metric].better
    means = {name: better * each.mean(metric) for name, each in results.sources.items()}
    known = {name: mean for name, mean in means.items() if np.isfinite(mean)}
    if len(known) < 2 or better == 0:
        return []
    return [name for name, mean in known.items() if mean == max(known.values())]


def _figure(study: Study, metrics: Sequence[str]) -> Figure:
    """Means, intervals and the paper's figures, a lane per metric and source."""
    sources = study.sources
    width = 0.76 / max(len(sources), 2)
    lanes = {name: width * (place + 0.5) - 0.3 for place, name in enumerate(sources)}
    marks: list[Mark] = [
        Heading(metric_name(name), place - 0.42) for place, name in enumerate(metrics)
    ]
    keys = [Key(source_name(name), colour_of(name), symbol(name)) for name in sources]
    for name, source in sources.items():
        marks.append(_points(name, source, metrics, lanes[name]))
    ticks = {
        place + lane: source_name(name)
        for place in range(len(metrics))
        for name, lane in lanes.items()
    }
    y = Axis("", limits=(len(metrics) - 0.5, -0.55), kind="names", ticks=ticks)
    panel = Panel(
        Axis("score", limits=(-0.01, 1.02), kind="share", step=0.2),
        [Row(y, marks)],
        "Scores of every source as dots with intervals",
        height=70 + len(metrics) * (30 + 24 * max(len(sources), 2)),
        narrow_bare=True,
    )
    return Figure("scores", [panel], keys)


def _points(name: str, source: SourceResults, metrics: Sequence[str], lane: float) -> Points:
    shown = [metric for metric in metrics if metric in source.scores]
    means = [source.mean(metric) for metric in shown]
    ends = [source.interval(m) or (mean, mean) for m, mean in zip(shown, means, strict=True)]
    y = [metrics.index(metric) + lane for metric in shown]
    texts = [f"{mean_and_deviation(source.runs(m))} [{span(source.interval(m))}]" for m in shown]
    look = (source_name(name), colour_of(name), symbol(name))
    return Points(means, y, *look, ends=ends, texts=texts, size=10)
