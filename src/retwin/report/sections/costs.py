"""The costs of each source in twin runs and seconds, and the duration of the stages."""

from __future__ import annotations

import math

from retwin.report.blocks import Cell, Column, Section, Table, columns
from retwin.report.labels import duration, real_data, source_name, stage_name
from retwin.report.study import Study

PUBLISHED_BULK, BULK = 3600, 1000
"""The number of trajectories to which generation times refer: in the paper, and elsewhere."""


def time(study: Study) -> Section | None:
    """The costs of the sources, and the duration of the stages."""
    costs, stages = _costs(study), _stages(study)
    if costs is None and stages is None:
        return None
    paper = costs is not None and any(column.paper for column in costs.columns)
    return Section("time", "Time", {"costs": costs, "stages": stages, "paper": paper})


def _stages(study: Study) -> Table | None:
    timing = study.results.timing
    seconds = timing.get("seconds")
    named = {
        **{stage_name(key): value for key, value in (seconds or {}).items()},
        "All jobs": timing.get("total_s"),
    }
    rows = [
        [Cell(name), Cell(duration(float(value)))]
        for name, value in named.items()
        if isinstance(value, int | float) and math.isfinite(value)
    ]
    return Table("Time of the stages", columns("Stage", "Time"), rows) if rows else None


def _costs(study: Study) -> Table | None:
    count = PUBLISHED_BULK if study.results.published else BULK
    bulk = f"{count} trajectories"
    shown = {
        "Twin runs": [
            "–" if s.twin_runs is None else str(s.twin_runs) for s in study.sources.values()
        ],
        "Update": [duration(s.update_s) for s in study.sources.values()],
        bulk: [duration(s.generation_seconds(count)) for s in study.sources.values()],
        "Training": [duration(s.train_s) for s in study.sources.values()],
        "One diagnosis": [duration(s.predict_s) for s in study.sources.values()],
    }
    kept = {name: texts for name, texts in shown.items() if set(texts) != {"–"}}
    if not kept:
        return None
    published = study.results.published
    paper = bulk in kept and any("generate" in published.get(name, {}) for name in study.sources)
    heads = [
        Column("Training data" if study.results.classes else "Source", numeric=False),
        Column(f"{study.word.capitalize()} data used", numeric=False),
    ]
    for name in kept:
        if paper and name == bulk:
            heads += [Column("this study", group=bulk), Column("paper", group=bulk, paper=True)]
        else:
            heads.append(Column(name))
    rows = []
    for place, (source, each) in enumerate(study.sources.items()):
        used = real_data(each.real_data, classes=bool(study.results.classes))
        row = [Cell(source_name(source), source=source), Cell(used)]
        for name, texts in kept.items():
            row.append(Cell(texts[place]))
            if paper and name == bulk:
                row.append(Cell(published.get(source, {}).get("generate", "–")))
        rows.append(row)
    return Table("Cost of a source in one run", heads, rows)
