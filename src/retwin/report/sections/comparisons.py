"""Every pair of sources on every metric: paired bootstrap, verdict, Welch's test over runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from retwin.catalog import METRICS
from retwin.report import labels
from retwin.report.blocks import (
    Cell,
    Column,
    Forest,
    Section,
    Table,
    grouped,
    tabulate,
    text_column,
)
from retwin.report.study import Study
from retwin.report.verdict import headline, outcome_of
from retwin.results.sources import Comparison


def comparisons(study: Study) -> Section | None:
    """Of many sources a matrix of differences, and the pairs with the headline's sources only."""
    found = [each for each in study.results.comparisons if each.metric in METRICS]
    if not found:
        return None
    many = len(study.sources) > labels.MANY
    metric = next(name for name in METRICS if any(each.metric == name for each in found))
    matrix = _matrix(study, found, metric) if many else None
    if many:
        pair = set(headline(study.results) or ())
        selected = [e for e in found if {e.a, e.b} & pair and e.metric in labels.SELECTED]
        found = selected or found
    values = {
        "matrix": matrix,
        "metric": labels.metric_name(metric),
        "pairs": _pairs(study, found),
        "many": many,
        "several": len(_axes(study, found)) > 1,
        "hundredths": not METRICS[metric].simulated,
        "reasons": sorted({labels.reason(each) for each in found} - {""}),
    }
    return Section("comparisons", "Comparisons", values)


def _matrix(study: Study, found: Sequence[Comparison], metric: str) -> Table:
    """The difference of each row's source from each column's, with its outcome."""
    factor, unit = labels.metric_quantity(metric, study.results.outputs.units)
    own = [e for e in found if e.metric == metric]
    if METRICS[metric].simulated:
        shown = labels.decimals(*(factor * e.mean_diff for e in own))
    else:  # scores of diagnoses are shown in hundredths
        factor, shown = 100.0, 0
    rows = []
    for place, source in enumerate(study.sources):
        pairs = [e.with_first(source) for e in own if source in (e.a, e.b)]
        cells = {
            e.b: Cell(labels.signed(factor * e.mean_diff, shown), tone=outcome_of(e) or "open")
            for e in pairs
        }
        name = Cell(f"{place + 1}. {labels.source_name(source)}", source=source)
        rows.append([name, *(cells.get(other, "") for other in study.sources)])
    others = [Column(str(place + 1), group="minus") for place in range(len(study.sources))]
    title = labels.with_unit(
        f"Pairwise differences in {labels.in_sentence(labels.metric_name(metric))}", unit
    )
    return tabulate(title, ["Source", *others], rows)


def _axes(study: Study, found: Sequence[Comparison]) -> dict[str, tuple[float, float]]:
    """The ends of the axis of the bars, one per unit; each contains zero."""
    ends: dict[str, tuple[float, float]] = {}
    for each in found:
        if each.interval is not None:
            unit = labels.metric_quantity(each.metric, study.results.outputs.units)[1]
            low, high = ends.get(unit, (0.0, 0.0))
            ends[unit] = min(low, each.interval[0]), max(high, each.interval[1])
    return ends


def _pairs(study: Study, found: Sequence[Comparison]) -> Table:
    heads = ["Score", text_column("Outcome"), "Difference", "95 % interval", text_column("")]
    heads += ["p, all pairs", *grouped("Welch’s test over runs", "t (df)", "p", "p, Holm")]
    units = study.results.outputs.units
    rows: list[list[object]] = []
    last: tuple[str, str] | None = None
    oriented = _sorted(found)
    axes = _axes(study, oriented)
    decided = any(outcome_of(each) for each in oriented)
    for each in oriented:
        if (each.a, each.b) != last:
            rows.append([f"{labels.source_name(each.a)} minus {labels.source_name(each.b)}"])
        last = each.a, each.b
        axis = axes.get(labels.metric_quantity(each.metric, units)[1], (0.0, 0.0))
        outcome = outcome_of(each)
        named = {"open": "undecided", "": "no verdict"}.get(outcome, outcome)
        shown = Cell(named if decided else "", tone=outcome)
        rows.append([labels.metric_name(each.metric), shown, *_row(each, units, axis)])
    return tabulate("Differences, pair by pair", heads, rows)


def _sorted(found: Sequence[Comparison]) -> list[Comparison]:
    """Pair by pair, metrics in the catalog's order; the later source of a pair stands first."""
    ranked = labels.order(dict.fromkeys(name for each in found for name in (each.a, each.b)))
    oriented = [each.with_first(max(each.a, each.b, key=ranked.index)) for each in found]
    metrics = list(METRICS)
    return sorted(
        oriented, key=lambda e: (-ranked.index(e.a), ranked.index(e.b), metrics.index(e.metric))
    )


def _row(each: Comparison, units: Sequence[str], axis: tuple[float, float]) -> list[object]:
    forest, (low, high) = None, axis
    if each.interval is not None and np.isfinite(each.mean_diff) and high > low:
        lower, at, upper, zero = (
            100 * (value - low) / (high - low)
            for value in (each.interval[0], each.mean_diff, each.interval[1], 0.0)
        )
        forest = Forest(lower, min(max(at, 0), 100), upper, zero)
    mean, interval = labels.difference(each, units)
    # Draws that are all equal show no uncertainty, which does not mean that there is none.
    wide = each.interval is not None and each.interval[0] < each.interval[1]
    return [
        mean,
        interval if wide else "–",
        Cell("", forest=forest, source=each.a),
        labels.p_value(each.p_verdict),
        f"{labels.number(each.t, 2)} ({labels.number(each.df, 1)})" if each.t is not None else "–",
        labels.p_value(each.p),
        labels.p_value(each.p_holm),
    ]
