"""The costs of each source in twin runs and seconds."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from retwin.report.blocks import Cell, Section, Table, tabulate, text_column
from retwin.report.labels import duration, real_data, source_name
from retwin.report.study import Study
from retwin.results.sources import SourceResults

PUBLISHED_BULK, BULK = 3600, 1000
"""The number of trajectories to which generation times refer: in the paper, and elsewhere."""


def time(study: Study) -> Section | None:
    """The costs of the sources."""
    costs = _costs(study)
    if costs is None:
        return None
    return Section("time", "Time", {"costs": costs})


def _costs(study: Study) -> Table | None:
    count = PUBLISHED_BULK if study.results.published else BULK
    bulk = f"{count} trajectories"
    classes = bool(study.results.classes)
    shown: dict[str, Callable[[SourceResults], str]] = {
        "Twin runs": lambda each: "–" if each.twin_runs is None else str(each.twin_runs),
        "Update": lambda each: duration(each.update_s),
        bulk: lambda each: duration(each.generation_seconds(count)),
        "Training": lambda each: duration(each.train_s),
        "One diagnosis": lambda each: duration(each.predict_s),
    }
    known = {name: list(map(text, study.sources.values())) for name, text in shown.items()}
    kept = {name: texts for name, texts in known.items() if set(texts) != {"–"}}
    if not kept:
        return None
    heads: list[object] = ["Training data" if classes else "Source"]
    heads.append(text_column(f"{study.word.capitalize()} data used"))
    names = [Cell(source_name(source), source=source) for source in study.sources]
    used = [real_data(each.real_data, classes=classes) for each in study.sources.values()]
    found: list[Sequence[object]] = [names, used]
    heads += kept
    found += kept.values()
    return tabulate("Cost of a source in one run", heads, zip(*found, strict=True))
