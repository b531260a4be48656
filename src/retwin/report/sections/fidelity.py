"""Fidelity of the draws of corrected twins: scores, calibration, and figures of both."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.report.blocks import Cell, Section, Table, grouped, tabulate
from retwin.report.figures.figure import (
    Axis,
    Band,
    Figure,
    Key,
    Line,
    Mark,
    Panel,
    Row,
    draw_bands,
    outline,
)
from retwin.report.figures.style import colour_of
from retwin.report.labels import number, order, places, quantities, source_name, span, with_unit
from retwin.report.sections.discrepancy import detailed, figure_cell, suffixes, titled
from retwin.report.study import Study
from retwin.results import FidelityFigure, FidelityResults

RIVALS = {"mean_only": "Mean only", "single_gaussian": "One Gaussian"}
"""Titles of the simpler generators."""
SHARES = {
    "coverage50": "in the 50 % band",
    "coverage90": "in the 90 % band",
    "pit": "PIT from uniform",
    "auroc": "AUROC, real or generated",
}
"""Columns of the table of all sources."""


def fidelity(study: Study) -> Section | None:
    """Scores of the draws beside those of simpler generators, and their calibration."""
    known = {name: study.results.fidelity[name] for name in order(study.results.fidelity)}
    scored = [name for name, each in known.items() if each.figures]
    figures = {name: _figures(study, name) for name in known}
    details: list[dict[str, Any]] = [
        {
            "source": name,
            "fidelity": known[name],
            "scores": _scores(study, name),
            "calibration": _calibration(study, name),
            "figures": figures[name],
        }
        for name in detailed(study)
        if name in scored
    ]
    if not details and len(scored) < 2:
        return None
    overview = _overview(study, scored) if len(scored) > 1 else None
    for each in details:  # without simpler generators it would repeat a row of the overview
        if overview is not None and not each["fidelity"].rivals:
            each["scores"] = None
    values: dict[str, Any] = {
        "overview": overview,
        "explained": next((each["source"] for each in details if each["scores"]), ""),
        "partial": set(scored) > set(detailed(study)),
        "details": details,
        "several": len(known) > 1,
        "fewest": min(each.trajectories or 0 for each in known.values()),
    }
    names = [each["source"] for each in details]
    shown = [figure for name in names for figure in figures[name].values()]
    further = [f for name in known if name not in names for f in figures[name].values()]
    return Section("fidelity", "Fidelity", values, shown, further)


def _lengths(each: FidelityResults, energy: str) -> list[tuple[str, str, float, str]]:
    """Key, title, factor and unit of the CRPS of each output; `energy` is put behind them."""
    units = quantities(each.units, len(each.outputs))
    rows = [(f"crps/{n}", f"CRPS {n}", *u) for n, u in zip(each.outputs, units, strict=True)]
    if energy and len(each.outputs) > 1:
        rows.append(("crps", energy, 1.0, ""))
    common = units[0] if len(set(each.units)) == 1 else (1.0, "")
    return [*rows, ("energy", "Energy score", *common)]


def _overview(study: Study, sources: list[str]) -> Table:
    """A row per source."""
    known = {name: study.results.fidelity[name].figures for name in sources}
    lengths = _lengths(study.results.fidelity[sources[0]], "")
    shown = [*lengths, *((key, title, 1.0, "") for key, title in SHARES.items())]
    shown = [each for each in shown if any(each[0] in figures for figures in known.values())]
    heads = ["Source", *(with_unit(title, unit) for _, title, _, unit in shown)]
    digits = dict.fromkeys(SHARES, 2) | {
        key: _digits((each.get(key) for each in known.values()), factor)
        for key, _, factor, _ in lengths
    }
    rows = [
        [
            Cell(source_name(name), source=name),
            *(figure_cell(figures.get(key), digits[key], factor) for key, _, factor, _ in shown),
        ]
        for name, figures in known.items()
    ]
    return tabulate("Fidelity of all sources", heads, rows)


def _digits(figures: Iterable[FidelityFigure | None], factor: float) -> int:
    """Decimals with which the scores have three digits."""
    return places(factor * each.value for each in figures if each is not None)


def _scores(study: Study, source: str) -> Table:
    """CRPS and energy score of this twin and its rivals, and the paired differences."""
    each = study.results.fidelity[source]
    heads: list[object] = ["Score", source_name(source)]
    for rival in each.rivals:
        name = RIVALS.get(rival, rival)
        heads += grouped(name, "score", "reduction by this twin, %")
    rows = []
    for key, title, factor, unit in _lengths(each, "CRPS, mean over outputs"):
        kind, *output = key.split("/", 1)
        keys = (key, *(f"{key}/{rival}" for rival in each.rivals))
        scored = [each.figures.get(name) for name in keys]
        digits = _digits(scored, factor)
        row: list[object] = [with_unit(title, unit), figure_cell(scored[0], digits, factor)]
        for rival, theirs in zip(each.rivals, scored[1:], strict=True):
            row.append(figure_cell(theirs, digits, factor))
            below = "/".join([f"{kind}_below", *output, rival])
            row.append(figure_cell(each.figures.get(below), 0, 100.0))
        rows.append(row)
    return tabulate(titled(study, source, "Scores of the draws"), heads, rows)


def _calibration(study: Study, source: str) -> Table:
    each = study.results.fidelity[source]
    widened = f"90 % band, widened × {number(each.widening, 2)}"
    titles = {
        "coverage50": ("Points inside the 50 % band", "0.50"),
        "coverage90": ("Points inside the 90 % band", "0.90"),
        "coverage90_widened": (f"Points inside the {widened}", "0.90"),
        "pit": ("PIT, distance from uniform", "0"),
        "auroc": ("Classifier of real against generated, AUROC", "0.50"),
    }
    rows = [
        [title, number(found.value, 2), span(found.ends, 2), number(found.p, 2), ideal]
        for key, (title, ideal) in titles.items()
        if (found := each.figures.get(key))
    ]
    heads = "Calibration", "Value", "95 % interval", "p", "Ideal"
    return tabulate(titled(study, source, "Calibration of the draws"), heads, rows)


def _figures(study: Study, source: str) -> dict[str, Figure]:
    """The PIT histogram and the bands, as far as their arrays are there."""
    added = suffixes(study)[source]
    pit = study.arrays.get(f"pit/{source}")
    found = {} if pit is None else {"pit": _pit(source, f"pit{added}", pit)}
    if study.bands(source):
        found["bands"] = _bands(study, source, f"bands{added}")
    return found


def _pit(source: str, name: str, pit: NDArray) -> Figure:
    """Shares of the PIT (3, bins): measured, and the 90 % range of perfect generators."""
    count = pit.shape[1]
    edges = np.linspace(0, 1, count + 1)
    colour = colour_of(source)
    x, measured = (each[1:-1] for each in outline(edges, pit[0]))
    marks: list[Mark] = [
        Band(x, np.repeat(pit[1], 2), np.repeat(pit[2], 2), "perfect generators", colour, 0.25),
        Line([0, 1], [1 / count] * 2, "uniform", "muted", "dot", 1, hover=False),
        Line(x, measured, "measured", "ink"),
    ]
    panel = Panel(
        Axis("share of draws below the measured value", limits=(0, 1), kind="share", step=0.2),
        [Row(Axis("share of points", kind="percent", from_zero=True), marks)],
        "Histogram of the probability integral transform",
    )
    keys = [
        Key("measured", "ink"),
        Key("90 % range of perfect generators", colour, "bar"),
        Key("uniform", "muted", "dot"),
    ]
    return Figure(name, [panel], keys, source, narrow=True)


def _bands(study: Study, source: str, name: str) -> Figure:
    """Measured outputs within the bands of the draws, both minus the nominal output.

    The first trajectory is the typical one, the second the worst.
    """
    parts, each = study.bands(source), study.results.fidelity[source]
    units = quantities(each.units, len(each.outputs))
    residual = np.where(parts["seen"][..., None], parts["observed"] - parts["nominal"], np.nan)
    quantiles = parts["quantiles"] - parts["nominal"][:, None]
    time = np.arange(residual.shape[1]) / float(parts["rate"])
    panels = []
    for i, trajectory in enumerate(parts["ids"].tolist()):
        for c, output in enumerate(each.outputs):
            factor, unit = units[c]
            marks: list[Mark] = [
                *draw_bands(time, factor * quantiles[i, :, :, c], colour_of(source)),
                Line(time, factor * residual[i, :, c], "measured", "ink", width=1.6),
            ]
            which = "typical" if trajectory == parts["ids"][0] else "worst"
            x = Axis("time", "s", (time[0], time[-1]))
            row = Row(Axis(f"{output} minus nominal", unit), marks)
            alt = f"{output} of trajectory {trajectory} within the bands of the draws"
            panels.append(Panel(x, [row], alt, f"{output}, {which} ({trajectory})", height=280))
    keys = [Key("measured", "ink"), Key("90 % and 50 % of the draws", colour_of(source), "bar")]
    return Figure(name, panels, keys, source, columns=len(each.outputs))
