"""What each source costs in twin runs and seconds, and how long the stages took."""

from __future__ import annotations

import math

from retwin.report.blocks import Block, Cell, Column, Section, Table
from retwin.report.parts import Source
from retwin.report.results import Results
from retwin.report.words import duration, label, order, real_data, source_name

__all__ = ["bulk_seconds", "time"]

BULK = 3600
"""Trajectories for which the time of generation is told."""


def time(results: Results) -> Section | None:
    """What each source costs, and how long the stages took."""
    blocks: list[Block] = []
    costs = _costs(results)
    if costs is not None:
        blocks.append(costs)
    parts = results.timing.get("seconds")
    told = {**(parts if isinstance(parts, dict) else {}), "total_s": results.timing.get("total_s")}
    numbers = {
        key: float(value)
        for key, value in told.items()
        if isinstance(value, int | float) and math.isfinite(value)
    }
    stages = {key: value for key, value in numbers.items() if key != "total_s"}
    rows = [[Cell(label(key)), Cell(duration(value))] for key, value in stages.items()]
    if "total_s" in numbers:
        rows.append([Cell("All jobs"), Cell(duration(numbers["total_s"]))])
    if rows:
        columns = [Column("Stage", numeric=False), Column("Time")]
        blocks.append(
            Table(
                "Time of the stages",
                "Mean time of a job of each kind, on one core; and of all jobs together.",
                columns,
                rows,
            )
        )
    return Section("time", "Time", blocks) if blocks else None


def _costs(results: Results) -> Table | None:
    sources = order(list(results.sources))
    parts = results.sources
    bulky = f"{BULK} trajectories"
    shown = {
        "Twin runs": [
            "–" if parts[each].twin_runs is None else str(parts[each].twin_runs) for each in sources
        ],
        "Update": [duration(parts[each].update_s) for each in sources],
        bulky: [duration(bulk_seconds(parts[each])) for each in sources],
        "Training": [duration(parts[each].train_s) for each in sources],
        "One diagnosis": [duration(parts[each].predict_s) for each in sources],
    }
    kept = {name: texts for name, texts in shown.items() if set(texts) != {"–"}}
    if not kept:
        return None
    told = any("generate" in results.published.get(source, {}) for source in sources)
    paper = told and bulky in kept
    word = "Emulated" if results.emulated else "Real"
    head = "Training data" if results.classes else "Source"
    columns = [Column(head, numeric=False), Column(f"{word} data used", numeric=False)]
    columns += [
        Column("this study", group=bulky) if paper and name == bulky else Column(name)
        for name in kept
    ]
    if paper:
        place = 1 + next(i for i, each in enumerate(columns) if each.group == bulky)
        columns.insert(place, Column("paper", group=bulky, paper=True))
    rows = []
    for place, each in enumerate(sources):
        row = [Cell(source_name(each), source=each), Cell(real_data(parts[each].real_data))]
        for name, texts in kept.items():
            row.append(Cell(texts[place]))
            if paper and name == bulky:
                row.append(Cell(results.published.get(each, {}).get("generate", "–")))
        rows.append(row)
    text = (
        "What a source costs in one run, with all that must be made before it: runs of the twin, "
        "the update (fitting what makes its data), the generation of trajectories"
    )
    if results.classes:
        text += ", the training of the diagnoser, and the diagnosis of one trajectory"
    text += ". Each job on one core."
    if paper:
        text += (
            " The paper’s times are from another machine (Apple M1 Pro) and another twin, so "
            "only the order of magnitude compares."
        )
    return Table("Cost of a source in one run", text, columns, rows)


def bulk_seconds(source: Source) -> float | None:
    """For `BULK` trajectories, from the time that as many as were generated took."""
    if source.generate_s is None or not source.generated:
        return None
    return source.generate_s * BULK / source.generated
