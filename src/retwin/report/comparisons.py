"""Every pair of sources, score by score: Welch over runs, bootstrap over trajectories."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from retwin.catalog import METRICS
from retwin.report.blocks import Block, Cell, Column, Forest, Section, Table
from retwin.report.parts import Comparison
from retwin.report.results import Results
from retwin.report.verdict import outcome
from retwin.report.words import (
    MANY,
    in_sentence,
    number,
    order,
    p_value,
    signed,
    source_name,
    span,
)

__all__ = ["comparisons"]

AGAINST = ("dt", "ibg_rg_command")
"""Of many sources, those that the others are held against."""


def comparisons(results: Results) -> Section | None:
    """Every pair on every score: Welch over runs, bootstrap over trajectories."""
    found = [each for each in results.comparisons if each.metric in METRICS]
    if not found:
        return None
    blocks: list[Block] = []
    if len(results.sources) > MANY:
        blocks.append(_who_beats_whom(results, found))
        found = [
            each
            for each in found
            if {each.a, each.b} & set(AGAINST) and each.metric in ("macro_f1", "healthy_recall")
        ] or found
    blocks.append(_pairs(results, found))
    return Section("comparisons", "Comparisons", blocks)


def _who_beats_whom(results: Results, found: Sequence[Comparison]) -> Table:
    """A row per source, a column per other one: the difference, and whether it is decided."""
    metric = next(name for name in METRICS if any(each.metric == name for each in found))
    sources = order(list(results.sources))
    rows = []
    for place, source in enumerate(sources):
        pairs = [e.seen_from(source) for e in found if e.metric == metric and source in (e.a, e.b)]
        gaps = {e.b: Cell(signed(100 * e.mean_diff, 0), tone=outcome(e)) for e in pairs}
        name = Cell(f"{place + 1}. {source_name(source)}", source=source)
        rows.append([name, *(gaps.get(other, Cell("")) for other in sources)])
    title = METRICS[metric].title
    against = [Column(str(place + 1), group="minus") for place in range(len(sources))]
    text = (
        f"{title} of the row’s source minus the column’s, in hundredths. ▲ better, ▼ worse: "
        "said only where the 95 % paired bootstrap interval over test trajectories leaves zero "
        "out; grey is undecided. The intervals are not corrected for their number."
    )
    columns = [Column("Source", numeric=False), *against]
    return Table(f"Who is better than whom in {in_sentence(title)}", text, columns, rows)


def _pairs(results: Results, found: Sequence[Comparison]) -> Table:
    columns = [
        Column("Score", numeric=False),
        Column("Reading", numeric=False),
        Column("Difference"),
        Column("95 % interval"),
        Column("", numeric=False),
        Column("t (df)", group="Welch’s test over runs"),
        Column("p", group="Welch’s test over runs"),
        Column("p, Holm", group="Welch’s test over runs"),
    ]
    shown = [each.interval for each in found if each.interval is not None]
    low, high = min([0.0, *(lo for lo, _ in shown)]), max([0.0, *(hi for _, hi in shown)])
    rows: list[list[Cell]] = []
    last: tuple[str, str] | None = None
    for each in _by_pair(found):
        if (each.a, each.b) != last:
            rows.append([Cell(f"{source_name(each.a)} minus {source_name(each.b)}")])
        last = each.a, each.b
        rows.append(_comparison_row(each, low, high))
    text = _comparison_caption(results)
    if len(results.sources) > MANY:
        text += " Only pairs with the plain and the updated twin; results.json has all."
    return Table("Differences, pair by pair", text, columns, rows)


def _by_pair(found: Sequence[Comparison]) -> list[Comparison]:
    """What was learned most stands first in a pair; pairs together, scores in their order."""
    ranked = order(list(dict.fromkeys(name for each in found for name in (each.a, each.b))))
    turned = [each.seen_from(max(each.a, each.b, key=ranked.index)) for each in found]
    metrics = list(METRICS)
    return sorted(
        turned,
        key=lambda e: (-ranked.index(e.a), ranked.index(e.b), metrics.index(e.metric)),
    )


def _comparison_row(each: Comparison, low: float, high: float) -> list[Cell]:
    forest = None
    if each.interval is not None and np.isfinite(each.mean_diff) and high > low:
        lower, at, upper, zero = (
            100 * (value - low) / (high - low)
            for value in (each.interval[0], each.mean_diff, each.interval[1], 0.0)
        )
        forest = Forest(lower, min(max(at, 0), 100), upper, zero)
    result = outcome(each)
    reading = "undecided" if result == "open" else result or "–"
    return [
        Cell(METRICS[each.metric].title),
        Cell(reading, tone=result),
        Cell(signed(each.mean_diff)),
        Cell(span(each.interval, sign=True)),
        Cell("", forest=forest, source=each.a),
        Cell(f"{number(each.t, 2)} ({number(each.df, 1)})" if each.t is not None else "–"),
        Cell(p_value(each.p)),
        Cell(p_value(each.p_holm)),
    ]


def _comparison_caption(results: Results) -> str:
    runs = f"{results.runs} runs" if results.runs > 1 else "one run, so there is no test"
    return (
        "“Better” and “worse” are said only where the 95 % paired bootstrap interval over test "
        "trajectories leaves zero out; the bars draw these intervals on one axis, with a line at "
        "zero. Welch’s test asks whether the mean over runs differs, so it sees the chance in "
        f"training ({runs}) but not the choice of test trajectories. Holm’s correction covers the "
        "scores that show its p; the intervals are not corrected for their number."
    )
