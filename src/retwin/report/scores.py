"""Table 1 beside the paper's numbers, and the scores that the paper does not give."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from retwin.catalog import METRICS
from retwin.report.blocks import Cell, Column, Prose, Section, Table
from retwin.report.plots import scores_plot
from retwin.report.reliability import ece_floor
from retwin.report.results import Results
from retwin.report.words import (
    MAIN,
    MANY,
    mean_and_spread,
    number,
    order,
    real_data,
    source_name,
    span,
)

__all__ = ["further_scores", "scores"]

MORE = ("accuracy", "auroc_micro", "ece", "ece_classwise", "coverage50", "coverage90")


def scores(results: Results) -> Section | None:
    """Table 1 beside the paper's, and the same as a picture."""
    table = _score_table(results, MAIN)
    if table is None:
        return None
    blocks: list = [table]
    drawn = MAIN if len(results.sources) <= MANY else ("macro_f1", "healthy_recall", *MAIN[4:])
    picture = scores_plot(results, [name for name in drawn if _has(results, name)])
    if picture is not None:
        blocks.append(picture)
    return Section("scores", "Scores", blocks)


def _score_table(results: Results, metrics: Sequence[str]) -> Table | None:
    shown = [name for name in metrics if _has(results, name)]
    if not shown:
        return None
    columns = [Column("Training data" if results.classes else "Source", numeric=False)]
    paper = any(_in_paper(results, name) for name in shown)
    for name in shown:
        columns += _score_columns(results, name, paper)
    best = {name: _best(results, name) for name in shown}
    word = "emulated" if results.emulated else "real"
    rows = []
    for source in order(list(results.sources)):
        one = results.sources[source]
        used = f"{word} data: {real_data(one.real_data)}"
        known = ["fault protocol known"] if one.fault_protocol_known else []
        row = [Cell(source_name(source), "; ".join([used, *known]), source=source)]
        for name in shown:
            below = f"[{span(one.interval(name))}]" if one.interval(name) else ""
            text = mean_and_spread(one.scores.get(name, []))
            row.append(Cell(text, below, best=source in best[name]))
            if _in_paper(results, name):
                row.append(Cell(results.published.get(source, {}).get(name, "–")))
        rows.append(row)
    title = "Scores of all sources" if metrics is MAIN else "Further scores of all sources"
    return Table(title, _score_caption(results, shown), columns, rows)


def _score_columns(results: Results, name: str, paper: bool) -> list[Column]:
    """One column, or two under the score's name where the paper has it too."""
    title = METRICS[name].title
    if name in ("rmse", "crps") and results.outputs.units:
        title += f", {results.outputs.units[0]}"
    if not paper:
        return [Column(title)]
    ours = Column("this study", group=title)
    return [ours, Column("paper", group=title, paper=True)] if _in_paper(results, name) else [ours]


def _score_caption(results: Results, shown: Sequence[str]) -> str:
    runs = f"mean ± standard deviation over {results.runs} runs"
    text = runs if results.runs > 1 else "one run, so no spread over runs"
    if any(each.intervals for each in results.sources.values()):
        text += "; in brackets the 95 % bootstrap interval over test trajectories"
        if not results.classes:
            text += ", over blocks of their samples where there are fewer than five"
    text = f"{text[0].upper()}{text[1:]}. Bold: the best mean of a column, whoever has it."
    if any(_in_paper(results, name) for name in shown):
        text += (
            " The paper’s numbers (its Table 1) are from its own runs, test set and classifier, "
            "so compare the gap between rows before the level."
        )
    if any(each.fault_protocol_known for each in results.sources.values()):
        text += (
            " “Fault protocol known”: the training faults follow the published onset and sizes, "
            "which would not be known in the field."
        )
    return text


def _has(results: Results, metric: str) -> bool:
    return any(metric in each.scores for each in results.sources.values())


def _in_paper(results: Results, metric: str) -> bool:
    return any(metric in results.published.get(source, {}) for source in results.sources)


def _best(results: Results, metric: str) -> list[str]:
    """The sources with the best mean; none when there is nothing to choose from."""
    means = {
        name: each.mean(metric)
        for name, each in results.sources.items()
        if np.isfinite(each.mean(metric))
    }
    better = METRICS[metric].better
    if len(means) < 2 or better == 0:
        return []
    top = max(better * mean for mean in means.values())
    return [name for name, mean in means.items() if better * mean == top]


def further_scores(results: Results) -> Section | None:
    """Scores that the paper does not give, and how far the ECE can be trusted."""
    table = _score_table(results, MORE)
    if table is None:
        return None
    floors = {name: _floor(results, name) for name in order(list(results.sources))}
    computed = any(floor is not None for floor in floors.values())
    if _has(results, "ece") and computed:
        columns = [
            *table.columns,
            Column("ECE floor", group="ECE floor" if table.columns[-1].group else ""),
        ]
        rows = [
            [*row, Cell(number(floor))]
            for row, floor in zip(table.rows, floors.values(), strict=True)
        ]
        table = replace(table, columns=columns, rows=rows)
    blocks: list = [table]
    if _has(results, "ece"):
        blocks.append(Prose(_floor_note(results, computed), quiet=True))
    return Section("further", "Further scores", blocks)


def _floor(results: Results, source: str) -> float | None:
    return ece_floor(results.probabilities(source)) if source in results.answered else None


def _floor_note(results: Results, computed: bool) -> str:
    count = results.data.test.n or len(results.data.test.labels)
    text = (
        "The expected calibration error (ECE, top label, 10 bins of equal mass) cannot reach zero "
        f"on {count or 'few'} trajectories. "
    )
    if computed:
        return text + (
            "The floor is what a perfectly calibrated classifier with the same confidences would "
            "show on average; the ECE says something only where it lies clearly above."
        )
    return text + "Its floor is about 0.04 with 90 trajectories and 0.06 with 36."
