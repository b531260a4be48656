"""The paper item by item, and where the same stands on this page."""

from __future__ import annotations

from retwin.catalog import METRICS
from retwin.report import labels
from retwin.report.blocks import Cell, Column, Link, Section, grouped, tabulate, text_column
from retwin.report.sections.time import PUBLISHED_BULK
from retwin.report.study import Study

TABLE1 = tuple(name for name in labels.MAIN if not METRICS[name].simulated)
"""The metrics of the paper's Table 1."""
FIGURES = (
    ("Figure 3: confusions, accuracy", "accuracy", Link("Confusions", "confusion")),
    ("Figure 4: micro-averaged ROC, area", "auroc_micro", Link("ROC", "roc")),
)
"""Figures of the paper, a metric that sums each up, and where it stands on the page."""


def paper(study: Study) -> Section | None:
    """Table 1, figures 3 to 6 and the times: the paper's, this study's, and links to them."""
    known = [name for name in labels.order(study.results.published) if name in study.sources]
    if not known:
        return None
    heads = [
        "Item of the paper",
        *(Column(labels.source_name(name), group="the paper", paper=True) for name in known),
        *grouped("this study", *map(labels.source_name, known)),
        text_column("on this page"),
    ]
    rows = []
    for metric in TABLE1:
        published, here = _published(study, known, metric), _means(study, known, metric)
        what = f"Table 1: {labels.in_sentence(labels.metric_name(metric))}"
        rows.append(_row(what, published, here, Link("Scores", "scores")))
    for what, metric, link in FIGURES:
        rows.append(_row(what, ["–"] * len(known), _means(study, known, metric), link))
    rows += _distributions(study, known)
    seconds = [study.sources[name].generation_seconds(PUBLISHED_BULK) for name in known]
    published, here = _published(study, known, "generate"), list(map(labels.duration, seconds))
    what = f"Section 5: {PUBLISHED_BULK} trajectories in"
    rows.append(_row(what, published, here, Link("Time", "time")))
    table = tabulate("Table 1, figures 3 to 6 and times", heads, rows)
    return Section("paper", "The paper and this study", {"table": table})


def _row(what: str, published: list[str], here: list[str], link: Link) -> list[object]:
    return [what, *published, *here, Cell("", links=[link])]


def _published(study: Study, known: list[str], key: str) -> list[str]:
    return [study.results.published[name].get(key, "–") for name in known]


def _means(study: Study, known: list[str], metric: str) -> list[str]:
    return [labels.mean_and_deviation(study.sources[name].runs(metric)) for name in known]


def _distributions(study: Study, known: list[str]) -> list[list[object]]:
    """KS distances of delays (figure 5) and of offsets (figure 6), a row per component."""
    fidelity = [study.results.fidelity.get(name) for name in known]
    found = [each.agreement if each else {} for each in fidelity]
    rows = []
    for name in dict.fromkeys(name for each in found for name in each):
        figure = 5 if name.startswith("delay") else 6 if name.startswith("offset_") else None
        if figure is None:
            continue
        here = [
            f"{labels.number(each[name].value, 2)} (p {labels.number(each[name].p, 2)})"
            if name in each
            else "–"
            for each in found
        ]
        what = f"Figure {figure}: {labels.in_sentence(labels.latent_names(name)[0])}, KS distance"
        link = Link("Discrepancy", "discrepancy")
        rows.append(_row(what, ["–"] * len(known), here, link))
    return rows
