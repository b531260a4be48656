"""How real the draws of a corrected twin are: their scores, their bands, what is said of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.report.blocks import Block, Cell, Column, Key, Panel, Plot, Prose, Section, Table
from retwin.report.curves import Band, bands
from retwin.report.discrepancy import cell, detailed, figure_names, titled, whose
from retwin.report.parts import Fidelity, Figure
from retwin.report.plots import axis, caption, short, spec
from retwin.report.results import Results
from retwin.report.words import number, order, quantity, slot, source_name

__all__ = ["fidelity"]

RIVALS = {"mean_only": "Mean only", "single_gaussian": "One Gaussian"}


def fidelity(results: Results) -> Section | None:
    """Scores of the draws beside those of simpler generators, calibration, and pictures of it."""
    judged = [name for name, each in results.fidelity.items() if each.figures]
    blocks: list[Block] = [_overview(results, order(judged))] if len(judged) > 1 else []
    for source in detailed(results):
        added, told = figure_names(results)[source], results.fidelity[source]
        if source not in judged:
            continue
        blocks += [_scores(results, source, told), _calibration(results, source, told)]
        pit = results.arrays.get(f"pit/{source}")
        if pit is not None:
            blocks.append(_pit_plot(results, source, f"pit{added}", pit))
        shown = bands(results, source)
        if shown:
            blocks.append(_band_plot(results, source, f"bands{added}", shown))
    if not blocks:
        return None
    few = min(each.trajectories or 0 for each in results.fidelity.values())
    note = (
        f"The unit is the trajectory, of which there are {few}: samples within one are alike, so "
        "neither intervals nor p-values count samples. With few trajectories intervals are wide, "
        "and somewhat too narrow still."
    )
    return Section("fidelity", "Fidelity", [*blocks, Prose(note, quiet=True)])


def _overview(results: Results, sources: list[str]) -> Table:
    """A row per source."""
    first = results.fidelity[sources[0]]
    units = [*first.units, *[""] * len(first.outputs)]
    lengths = [(f"crps/{n}", f"CRPS {n}", u) for n, u in zip(first.outputs, units, strict=False)]
    lengths.append(("energy", "Energy score", units[0] if len(set(first.units)) == 1 else ""))
    shares = (
        ("coverage50", "in the 50 % band"),
        ("coverage90", "in the 90 % band"),
        ("pit", "PIT from uniform"),
        ("auroc", "AUROC, real or generated"),
    )
    shown = [(key, title, *quantity(unit)) for key, title, unit in lengths]
    shown += [(key, title, 1.0, "") for key, title in shares]
    known = {key for name in sources for key in results.fidelity[name].figures}
    shown = [each for each in shown if each[0] in known]
    columns = [Column("Source", numeric=False)]
    columns += [Column(f"{title}, {unit}" if unit else title) for _, title, _, unit in shown]
    rows = [
        [
            Cell(source_name(name), source=name),
            *(
                cell(results.fidelity[name].figures.get(key, Figure()), 2, factor)
                for key, _, factor, _ in shown
            ),
        ]
        for name in sources
    ]
    text = (
        "How near each source’s draws are to held-out healthy trajectories. CRPS and energy score: "
        "lower is better. Bands should hold 0.50 and 0.90 of the points; a source without chance "
        "has no band, so none lies within. PIT: 0 is best; AUROC: 0.50. In brackets the 95 % "
        "bootstrap interval over trajectories."
    )
    if set(sources) > set(detailed(results)):
        text += " The updated twins are shown in full below; figures/ has the pictures of all."
    return Table("How real, source by source", caption(results, text), columns, rows)


def _scores(results: Results, source: str, told: Fidelity) -> Table:
    """CRPS and energy score of this twin and its rivals, and the paired differences."""
    columns = [Column("Score", numeric=False), Column(source_name(source))]
    for rival in told.rivals:
        name = RIVALS.get(rival, rival)
        columns += [Column("score", group=name), Column("ours below by, %", group=name)]
    units = [*told.units, *[""] * len(told.outputs)]
    alike = quantity(units[0] if len(set(told.units)) == 1 else "")
    lines = [
        (f"crps/{each}", f"CRPS {each}", *quantity(unit))
        for each, unit in zip(told.outputs, units, strict=False)
    ]
    lines += [("crps", "CRPS, mean over outputs", 1.0, ""), ("energy", "Energy score", *alike)]
    rows = []
    for key, title, factor, unit in lines:
        kind, *output = key.split("/", 1)
        row = [Cell(f"{title}, {unit}" if unit else title)]
        row.append(cell(told.figures.get(key, Figure()), 2, factor))
        for rival in told.rivals:
            row.append(cell(told.figures.get(f"{key}/{rival}", Figure()), 2, factor))
            below = "/".join([f"{kind}_below", *output, rival])
            row.append(cell(told.figures.get(below, Figure()), 0, 100.0))
        rows.append(row)
    text = (
        f"How far {told.draws or 'many'} draws per trajectory lie from "
        f"what was measured on {told.trajectories} held-out healthy trajectories, their spread "
        "taken off; lower is better, and the truth would score best. CRPS looks at one output at "
        "one moment, the energy score at a whole trajectory. Mean only: the correction without its "
        "spread, for which the CRPS is the mean absolute error. One Gaussian: a residual model "
        "with one component, fitted to the same data. In brackets the 95 % bootstrap interval over "
        "trajectories; differences are paired."
    )
    title = titled(results, source, "Scores of the draws")
    return Table(title, caption(results, text), columns, rows)


def _calibration(results: Results, source: str, told: Fidelity) -> Table:
    widened = f"90 % band, widened × {number(told.widening, 2)}"
    lines = [
        ("coverage50", "Points inside the 50 % band", "0.50"),
        ("coverage90", "Points inside the 90 % band", "0.90"),
        ("coverage90_widened", f"Points inside the {widened}", "0.90"),
        ("pit", "PIT, distance from uniform", "0"),
        ("auroc", "Classifier of real against generated, AUROC", "0.50"),
    ]
    rows = [
        [
            Cell(title),
            Cell(number(told.figures[key].value, 2)),
            Cell(_interval(told.figures[key])),
            Cell(number(told.figures[key].p, 2)),
            Cell(ideal),
        ]
        for key, title, ideal in lines
        if key in told.figures
    ]
    columns = [
        Column("Calibration", numeric=False),
        Column("Value"),
        Column("95 % interval"),
        Column("p"),
        Column("Ideal"),
    ]
    text = (
        "Bands are pointwise; the share inside is that of a trajectory’s "
        "points, averaged over trajectories. p as above, out of 100. The classifier is a forest "
        "that never saw the trajectory it judges: at 0.50 it cannot tell real from generated, at "
        "1.00 always."
    )
    if "auroc" not in told.figures:
        text = text.split(" The classifier")[0] + " Too few trajectories to train a classifier."
    if "coverage90_widened" in told.figures:
        text += (
            " Widened: by a factor (split conformal) from calibration trajectories kept back from "
            "the residual model; it is shown for comparison, the twin does not use it."
        )
    title = titled(results, source, "Calibration of the draws")
    return Table(title, caption(results, text), columns, rows)


def _interval(figure: Figure) -> str:
    ends = figure.ends
    return "–" if ends is None else " to ".join(number(end, 2) for end in ends)


def _pit_plot(results: Results, source: str, name: str, pit: NDArray) -> Plot:
    """Shares of the PIT as steps, before what perfect generators show."""
    count = pit.shape[1]
    stairs = short(np.repeat(np.linspace(0, 1, count + 1), 2)[1:-1])
    shares, low, high = (short(np.repeat(row, 2)) for row in pit)
    data: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "lines",
            "name": "perfect generators",
            "x": stairs + stairs[::-1],
            "y": high + low[::-1],
            "fill": "toself",
            "fillcolor": f"@c{slot(source)}/0.25",
            "line": {"width": 0},
            "hoverinfo": "skip",
        },
        {
            "type": "scatter",
            "mode": "lines",
            "name": "uniform",
            "x": [0, 1],
            "y": [1 / count, 1 / count],
            "line": {"color": "@muted", "width": 1, "dash": "dot"},
            "hoverinfo": "skip",
        },
        {
            "type": "scatter",
            "mode": "lines",
            "name": "measured",
            "x": stairs,
            "y": shares,
            "line": {"color": "@ink", "width": 1.8},
            "hovertemplate": "%{y:.1%} near %{x:.2f}<extra></extra>",
        },
    ]
    x = axis("share of draws below the measured value", range=[0, 1], dtick=0.2)
    y = axis("share of points", tickformat=".0%", rangemode="tozero", nticks=6)
    keys = [
        Key("measured", "ink"),
        Key("where 90 % of perfect generators lie", f"c{slot(source)}", "bar"),
        Key("uniform", "muted", "dot"),
    ]
    text = (
        f"{whose(results, source)}Where the measured value lies among the draws (PIT). Flat, "
        "within the shaded range: draws spread as the measured ones do. A hump in the middle: "
        "too wide; piles at the ends: too sure; a slope: too high or too low."
    )
    panel = Panel(spec(data, x, y), "Histogram of the probability integral transform", height=340)
    return Plot(name, caption(results, text), [panel], keys, narrow=True)


def _band_plot(results: Results, source: str, name: str, shown: list[Band]) -> Plot:
    """Measured output within the bands of the draws, both minus the nominal output."""
    colour = f"c{slot(source)}"
    keys = [
        Key("measured", "ink"),
        Key("90 % and 50 % of the draws", colour, "bar"),
    ]
    first = shown[0].trajectory
    panels = [_band_panel(each, f"@{colour}", typical=each.trajectory == first) for each in shown]
    text = (
        f"{whose(results, source)}Held-out trajectories, output minus nominal output: the one "
        "with the median energy score (typical), and the one with the worst. Spikes are movements "
        "that come late, steps between them the position errors. Half of the line should lie in "
        "the dark band, nine tenths in the light one."
    )
    return Plot(name, caption(results, text), panels, keys)


def _band_panel(each: Band, colour: str, *, typical: bool) -> Panel:
    time = short(each.time)
    edges = [short(row) for row in each.quantiles]
    data: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "lines",
            "name": name,
            "x": time + time[::-1],
            "y": edges[high] + edges[low][::-1],
            "fill": "toself",
            "fillcolor": f"{colour}/{alpha}",
            "line": {"width": 0},
            "hoverinfo": "skip",
        }
        for name, low, high, alpha in (("90 %", 0, 4, 0.2), ("50 %", 1, 3, 0.4))
    ]
    data.append(
        {
            "type": "scatter",
            "mode": "lines",
            "name": "measured",
            "x": time,
            "y": short(each.observed),
            "line": {"color": "@ink", "width": 1.6},
            "hovertemplate": "%{y:.3g} at %{x:.1f} s<extra></extra>",
        }
    )
    unit = f", {each.unit}" if each.unit else ""
    which = "typical" if typical else "worst"
    x = axis("time, s", range=[time[0], time[-1]], nticks=6)
    y = axis(f"{each.output} minus nominal{unit}", nticks=6)
    alt = f"{each.output} of trajectory {each.trajectory} within the bands of the draws"
    title = f"{each.output}, {which} ({each.trajectory})"
    return Panel(spec(data, x, y), alt, title, height=280)
