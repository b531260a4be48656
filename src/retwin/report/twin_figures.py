"""What twins generate, as PNG: simulations, a movement, discrepancies, bands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from retwin.report.canvas import (
    GRID,
    INK,
    MUTED,
    OBSERVED,
    RULE,
    blank,
    colour,
    dress,
    legend,
    line,
    shade,
)
from retwin.report.curves import Band, Latent
from retwin.report.movement import Movement
from retwin.report.plots import latent_names, missing
from retwin.report.simulation import Record
from retwin.report.words import PALETTE, source_name

__all__ = ["draw_bands", "draw_latents", "draw_movement", "draw_pit", "draw_simulation"]


def draw_simulation(found: Sequence[Record]) -> Figure:
    """Measured and simulated above, errors below, record by record."""
    figure = blank(8, 0.5 + 3.4 * len(found))
    grid = figure.subplots(2 * len(found), 1, squeeze=False, height_ratios=[2, 1] * len(found))
    for each, (above, below) in zip(found, grid.reshape(-1, 2), strict=True):
        for low, high, alpha, share in ((0, 4, 0.2, "90 %"), (1, 3, 0.35, "50 %")):
            if each.bands is not None:
                edges = each.bands[low], each.bands[high]
                text, look = f"{share} of the draws", shade(each.banded, alpha)
                above.fill_between(each.time, *edges, label=text, **look)
        for name, mean in each.means.items():
            above.plot(each.time, mean, linewidth=1.3, label=source_name(name), **line(name))
            below.plot(each.time, mean - each.observed, linewidth=1.1, **line(name))
        above.plot(each.time, each.observed, color=INK, linewidth=1, label="measured")
        below.axhline(0, color=RULE, linewidth=1)
        unit = f", {each.unit}" if each.unit else ""
        dress(above, "", f"{each.output}{unit}")
        dress(below, "time, s", f"error{unit}")
        above.set_title(f"{each.output} ({each.name})", fontsize=11, color=INK, loc="left")
        for axes in (above, below):
            axes.set_xlim(each.time[0], each.time[-1])
    legend(figure, 3)
    return figure


def draw_latents(shown: Sequence[Latent], source: str) -> Figure:
    """Observed as bars, generated as steps, side by side."""
    figure = blank(1 + 3.6 * max(len(shown), 1.3), 3.4)
    for axes, latent in zip(figure.subplots(1, len(shown), squeeze=False).flat, shown, strict=True):
        title, quantity = latent_names(latent.name)
        left, width = latent.edges[:-1], np.diff(latent.edges)
        axes.bar(left, latent.observed, width, align="edge", color=OBSERVED, label="observed")
        stairs = {"color": colour(source), "linewidth": 1.8, "label": "generated"}
        axes.stairs(latent.predicted, latent.edges, **stairs)
        unit = f", {latent.unit}" if latent.unit else ""
        dress(axes, f"{quantity}{unit}", "share per bin")
        axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        axes.set_title(title, fontsize=11, color=INK, loc="left")
        if any(latent.outside):
            text = missing(latent).replace(": ", ":\n")
            axes.set_title(text, fontsize=7, color=MUTED, loc="right")
        axes.set_xlim(latent.edges[0], latent.edges[-1])
    legend(figure, 2)
    return figure


def draw_pit(pit: NDArray, source: str) -> Figure:
    """Shares of the PIT as steps, before what perfect generators show."""
    figure = blank(5.6, 3.6)
    axes = figure.add_subplot()
    count = pit.shape[1]
    edges = np.linspace(0, 1, count + 1)
    low, high = (np.append(row, row[-1]) for row in pit[1:])
    text = "where 90 % of perfect generators lie"
    axes.fill_between(edges, low, high, step="post", label=text, **shade(source, 0.25))
    axes.axhline(1 / count, color=MUTED, linestyle=":", linewidth=1, label="uniform")
    axes.stairs(pit[0], edges, baseline=None, color=INK, linewidth=1.6, label="measured")
    axes.set_ylim(0, 1.1 * max(high.max(), pit[0].max()))
    dress(axes, "share of draws below the measured value", "share of points")
    axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    axes.set_xlim(0, 1)
    figure.legend(frameon=False, fontsize=9, ncols=3, loc="outside lower left")
    return figure


def draw_bands(shown: Sequence[Band], source: str) -> Figure:
    """A row per trajectory, a column per output."""
    names = list(dict.fromkeys(band.trajectory for band in shown))
    wide = len(shown) // len(names)
    figure = blank(0.6 + 3.6 * max(wide, 1.3), 0.5 + 2.6 * len(names))
    grid = figure.subplots(len(names), wide, squeeze=False, sharex=True)
    for axes, band in zip(grid.flat, shown, strict=True):
        for low, high, alpha, text in ((0, 4, 0.2, "90 % of the draws"), (1, 3, 0.45, "50 %")):
            edges = band.quantiles[low], band.quantiles[high]
            axes.fill_between(band.time, *edges, label=text, **shade(source, alpha))
        axes.plot(band.time, band.observed, color=INK, linewidth=1, label="measured")
        unit = f", {band.unit}" if band.unit else ""
        last = band.trajectory == names[-1]
        dress(axes, "time, s" if last else "", f"{band.output} minus nominal{unit}")
        which = "typical" if band.trajectory == names[0] else "worst"
        axes.set_title(f"{band.output}, {which}", fontsize=11, color=INK, loc="left")
        axes.set_xlim(band.time[0], band.time[-1])
    legend(figure, 3)
    return figure


def draw_movement(found: Movement) -> Figure:
    """The whole trajectory, one movement larger with TDe, and the gap in it with TPE."""
    figure = blank(12, 3.4)
    whole, larger, rest = figure.subplots(1, 3)
    late, off = found.words
    for axes, title in ((whole, "all movements"), (larger, late), (rest, off)):
        start, end = found.window if axes is not whole else (found.time[0], found.time[-1])
        inside = (found.time >= start) & (found.time <= end)
        time, ideal, real = (v[inside] for v in (found.time, found.nominal, found.observed))
        base = ideal if axes is rest else 0.0
        if axes is not rest:
            axes.plot(time, ideal, ":", color=MUTED, linewidth=1.6, label="nominal")
        axes.plot(time, real - base, color=INK, linewidth=1.4, label="measured")
        for onset, settle in found.times:
            if settle > start and onset < end:
                axes.axvspan(max(onset, start), min(settle, end), color=GRID, linewidth=0, zorder=0)
        unit = f", {found.unit}" if found.unit else ""
        dress(axes, "time, s", f"{found.output}{' minus nominal' if axes is rest else ''}{unit}")
        axes.grid(visible=False)
        axes.set_xlim(start, end)
        axes.set_title(title, fontsize=11, color=INK, loc="left")
    mark = {"color": PALETTE[1][0], "linewidth": 3}
    larger.plot(*zip(*found.half, strict=True), **mark)
    rest.plot([found.settle, found.window[1]], [found.offset] * 2, **mark)
    legend(figure, 2)
    return figure
