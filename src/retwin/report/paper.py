"""The paper item by item, and where the same stands on this page."""

from __future__ import annotations

from retwin.catalog import METRICS
from retwin.report.blocks import Cell, Column, Link, Section, Table
from retwin.report.costs import bulk_seconds
from retwin.report.plots import caption, latent_names
from retwin.report.results import Results
from retwin.report.words import duration, in_sentence, mean_and_spread, number, source_name

__all__ = ["paper"]

COMPARED = ("dt", "ibg_rg")
"""The two sources that the paper compares."""
PAPER, HERE = "the paper", "this study"


def paper(results: Results) -> Section | None:
    """Table 1, figures 2 to 6 and the times: the paper's numbers, ours, and where to look."""
    known = [name for name in COMPARED if name in results.sources]
    if not results.published or not known:
        return None
    columns = [
        Column("Of the paper", numeric=False),
        *(Column(source_name(name), group=PAPER, paper=True) for name in known),
        *(Column(source_name(name), group=HERE) for name in known),
        Column("on this page", numeric=False),
    ]
    rows = [
        *_scores(results, known),
        *_pictures(results, known),
        *_distributions(results, known),
        _time(results, known),
    ]
    text = (
        "The two sources that the paper compares. Its numbers are from another test set, 10 runs "
        "and an LSTM; a dash stands where it shows a picture and gives no number. Figure 1 is a "
        "drawing of the arm. KS distances are those between what was observed and generated, with "
        "the p-value explained below."
    )
    table = Table("Table 1 and figures 2 to 6", caption(results, text), columns, rows)
    return Section("paper", "The paper and this study", [table])


def _row(what: str, theirs: list[str], ours: list[str], link: Link) -> list[Cell]:
    return [Cell(what), *map(Cell, theirs), *map(Cell, ours), Cell("", links=[link])]


def _published(results: Results, known: list[str], key: str) -> list[str]:
    return [results.published.get(name, {}).get(key, "–") for name in known]


def _means(results: Results, known: list[str], metric: str) -> list[str]:
    return [mean_and_spread(results.sources[name].scores.get(metric, [])) for name in known]


def _scores(results: Results, known: list[str]) -> list[list[Cell]]:
    return [
        _row(
            f"Table 1: {in_sentence(METRICS[metric].title)}",
            _published(results, known, metric),
            _means(results, known, metric),
            Link("Scores", "scores"),
        )
        for metric in ("macro_f1", "balanced_accuracy", "auroc", "healthy_recall")
    ]


def _pictures(results: Results, known: list[str]) -> list[list[Cell]]:
    dashes = ["–"] * len(known)
    right = _means(results, known, "accuracy")
    area = _means(results, known, "auroc_micro")
    return [
        _row("Figure 2: segments, TDe, TPE", dashes, dashes, Link("Discrepancy", "discrepancy")),
        _row("Figure 3: confusions, share right", dashes, right, Link("Confusions", "confusion")),
        _row("Figure 4: micro-averaged ROC, area", dashes, area, Link("ROC", "roc")),
    ]


def _distributions(results: Results, known: list[str]) -> list[list[Cell]]:
    """KS distances of delays and of offsets, a row per component."""
    told = [results.fidelity.get(name) for name in known]
    found = [each.agreement if each else {} for each in told]
    rows = []
    for name in dict.fromkeys(name for each in found for name in each):
        figure = 5 if name.startswith("delay") else 6 if name.startswith("offset_") else None
        ours = [
            f"{number(each[name].value, 2)} (p {number(each[name].p, 2)})" if name in each else "–"
            for each in found
        ]
        what = f"Figure {figure}: {latent_names(name)[0]}, KS distance"
        if figure is not None:
            link = Link("Discrepancy", "discrepancy")
            rows.append(_row(what, ["–"] * len(known), ours, link))
    return rows


def _time(results: Results, known: list[str]) -> list[Cell]:
    theirs = _published(results, known, "generate")
    ours = [duration(bulk_seconds(results.sources[name])) for name in known]
    return _row("Section 5: 3600 trajectories in", theirs, ours, Link("Time", "time"))
