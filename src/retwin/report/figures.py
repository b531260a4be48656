"""The figures as PNG, by matplotlib, for papers and slides."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray
from PIL import Image

from retwin.report.curves import Band, Latent, bands
from retwin.report.fidelity import figure_names, groups
from retwin.report.learning import learning_curves
from retwin.report.plots import DASHES, latent_names, missing, published_value
from retwin.report.results import Results
from retwin.report.sections import recalls, roc_curves
from retwin.report.simulation import records
from retwin.report.words import (
    CHROME,
    METRICS,
    PALETTE,
    class_name,
    mean_and_spread,
    order,
    slot,
    source_name,
)

__all__ = ["FIGURES", "draw_figures"]

FIGURES = (
    "scores",
    "confusion",
    "roc",
    "simulation",
    "tde",
    "tpe",
    "noise",
    "pit",
    "bands",
    "learning",
)
"""The figures of a study; its file is `figures/NAME.png`, of a second source `NAME-2.png`."""
SCORES = ("macro_f1", "balanced_accuracy", "auroc", "healthy_recall")
STYLES = dict(zip(DASHES, ("-", "--", ":", "-."), strict=True))
INK, MUTED, GRID, RULE, WASH, OBSERVED, ALARM = (
    CHROME[name][0] for name in ("ink", "muted", "grid", "rule", "wash", "observed", "alarm")
)


def draw_figures(results: Results) -> dict[str, bytes]:
    """PNG by figure name; what lacks its data is left out."""
    drawn = {"scores": _scores(results), "confusion": _confusion(results), "roc": _roc(results)}
    drawn |= {"learning": _learning(results), "simulation": _simulation(results)}
    for group in groups(results):
        drawn[group.name] = _latents(group.shown, group.source)
    for source, added in figure_names(results).items():
        if f"pit/{source}" in results.arrays:
            drawn[f"pit{added}"] = _pit(results.arrays[f"pit/{source}"], source)
        if shown := bands(results, source):
            drawn[f"bands{added}"] = _bands(shown, source)
    return {
        name: _png(figure, results.emulated) for name, figure in drawn.items() if figure is not None
    }


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _png(figure: Figure, emulated: bool) -> bytes:
    if emulated:
        figure.suptitle("EMULATED data: no real measurements", color=ALARM, fontsize=10)
    figure.set_dpi(160)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    # The page holds every figure as well; 256 colours are enough for them and a third of the bytes.
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB").quantize(256)
    file = io.BytesIO()
    image.save(file, format="png", optimize=True, dpi=(160, 160))
    return file.getvalue()


def _dress(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x, color=MUTED)
    axes.set_ylabel(y, color=MUTED)
    axes.tick_params(colors=MUTED, labelsize=9)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    for name, spine in axes.spines.items():
        spine.set_color(RULE)
        spine.set_visible(name in ("left", "bottom"))


def _colour(source: str) -> str:
    return PALETTE[slot(source)][0]


def _scores(results: Results) -> Figure | None:
    sources = order(list(results.sources))
    shown = [name for name in SCORES if any(name in results.sources[s].scores for s in sources)]
    if not shown:
        return None
    figure = _figure(7, 0.9 + 0.26 * len(shown) * max(len(sources), 2))
    axes = figure.add_subplot()
    for place, source in enumerate(sources):
        lane = 0.62 * ((place + 0.5) / len(sources) - 0.5) - 0.04
        _score_marks(axes, results, source, shown, lane)
    axes.set_yticks(range(len(shown)), [METRICS[name].name for name in shown])
    axes.set_ylim(len(shown) - 0.5, -0.5)
    axes.set_xlim(-0.01, 1.02)
    paper = "; open diamonds: paper ± sd" if results.published else ""
    _dress(axes, f"score: mean and 95 % bootstrap interval{paper}", "")
    axes.tick_params(axis="y", length=0, labelcolor=INK)
    axes.grid(visible=False, axis="y")
    axes.legend(frameon=False, fontsize=9, ncols=3, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


def _learning(results: Results) -> Figure | None:
    curves = learning_curves(results)
    if not curves:
        return None
    figure = _figure(4 * len(curves), 3.4)
    for axes, (title, lines) in zip(
        figure.subplots(1, len(curves), squeeze=False)[0], curves.items(), strict=True
    ):
        for source, points in lines.items():
            count, value, low, high = (np.array(each) for each in zip(*points, strict=True))
            style = STYLES[DASHES[slot(source) % len(DASHES)]]
            axes.plot(count, value, style, color=_colour(source), label=source_name(source))
            axes.fill_between(count, low, high, color=_colour(source), alpha=0.12, linewidth=0)
        axes.set_xscale("log")
        ticks = sorted({point[0] for points in lines.values() for point in points})
        axes.set_xticks(ticks, [str(tick) for tick in ticks], minor=False)
        axes.minorticks_off()
        axes.set_ylim(*((0, None) if title == "RMSE" else (-0.02, 1.02)))
        _dress(axes, "healthy trajectories", title)
    axes.legend(frameon=False, fontsize=8)
    return figure


def _simulation(results: Results) -> Figure | None:
    found = records(results)
    if not found:
        return None
    figure = _figure(8, 0.5 + 3.4 * len(found))
    grid = figure.subplots(2 * len(found), 1, squeeze=False, height_ratios=[2, 1] * len(found))
    for each, (above, below) in zip(found, grid.reshape(-1, 2), strict=True):
        for low, high, alpha, share in ((0, 4, 0.2, "90 %"), (1, 3, 0.35, "50 %")):
            if each.bands is not None:
                above.fill_between(
                    each.time,
                    each.bands[low],
                    each.bands[high],
                    color=_colour(each.banded),
                    alpha=alpha,
                    linewidth=0,
                    label=f"{share} of the draws",
                )
        for name, mean in each.means.items():
            style = {"color": _colour(name), "linestyle": STYLES[DASHES[slot(name) % len(DASHES)]]}
            above.plot(each.time, mean, linewidth=1.3, label=source_name(name), **style)
            below.plot(each.time, mean - each.observed, linewidth=1.1, **style)
        above.plot(each.time, each.observed, color=INK, linewidth=1, label="measured")
        below.axhline(0, color=RULE, linewidth=1)
        unit = f", {each.unit}" if each.unit else ""
        _dress(above, "", f"{each.output}{unit}")
        _dress(below, "time, s", f"error{unit}")
        above.set_title(f"{each.output} ({each.name})", fontsize=11, color=INK, loc="left")
        for axes in (above, below):
            axes.set_xlim(each.time[0], each.time[-1])
    marks = figure.axes[0].get_legend_handles_labels()
    figure.legend(*marks, frameon=False, fontsize=9, ncols=3, loc="outside lower left")
    return figure


def _score_marks(
    axes: Axes, results: Results, source: str, shown: Sequence[str], lane: float
) -> None:
    one, told = results.sources[source], results.published.get(source, {})
    named = False
    for place, metric in enumerate(shown):
        if metric in one.scores:
            mean = one.mean(metric)
            ends = one.interval(metric) or (mean, mean)
            axes.plot(ends, [place + lane] * 2, color=_colour(source), linewidth=1.8)
            name = None if named else source_name(source)
            axes.plot(mean, place + lane, "o", color=_colour(source), markersize=6, label=name)
            named = True
        value = published_value(told.get(metric, ""))
        if value is not None:
            axes.errorbar(
                value[0],
                place + lane + 0.12,
                xerr=value[1] or None,
                fmt="D",
                color=_colour(source),
                markerfacecolor="white",
                markersize=5,
                linewidth=0.9,
                capsize=2,
            )


def _confusion(results: Results) -> Figure | None:
    sources = [s for s in order(list(results.sources)) if results.sources[s].confusion]
    if not sources or not results.classes:
        return None
    wide = min(len(sources), 3)
    tall = math.ceil(len(sources) / wide)
    figure = _figure(1 + 4.2 * wide, 0.6 + 4.1 * tall)
    names = [class_name(name) for name in results.classes]
    grid = figure.subplots(tall, wide, squeeze=False)
    for axes in grid.flat[len(sources) :]:
        axes.set_visible(False)
    for place, source in enumerate(sources):
        axes = grid.flat[place]
        counts = results.sources[source].confusion or []
        shares = np.array(recalls(counts))
        shade = LinearSegmentedColormap.from_list("shade", [WASH, _colour(source)])
        axes.imshow(shares, cmap=shade, vmin=0, vmax=1)
        for (row, column), share in np.ndenumerate(shares):
            if counts[row][column]:
                tone = "white" if share >= 0.78 else INK
                text = str(counts[row][column])
                axes.text(column, row, text, ha="center", va="center", color=tone, fontsize=8)
        axes.set_title(source_name(source), fontsize=11, color=INK, loc="left")
        axes.set_xticks(range(len(names)), names, rotation=90)
        axes.set_yticks(range(len(names)), names if place % wide == 0 else [])
        _dress(axes, "answer", "true class" if place % wide == 0 else "")
        axes.grid(visible=False)
        axes.tick_params(length=0, labelsize=8)
    return figure


def _roc(results: Results) -> Figure | None:
    curves = roc_curves(results)
    if not curves:
        return None
    figure = _figure(5.6, 5.2)
    axes = figure.add_subplot()
    axes.plot([0, 1], [0, 1], color=RULE, linewidth=1)
    for source, curve in curves.items():
        colour = _colour(source)
        if len(curve.areas) > 1:
            axes.fill_between(curve.rate, *curve.band, color=colour, alpha=0.18, linewidth=0)
        style = STYLES[DASHES[slot(source) % len(DASHES)]]
        text = f"{source_name(source)}: {mean_and_spread(curve.areas)}"
        axes.plot(curve.rate, curve.mean, style, color=colour, linewidth=1.8, label=text)
    axes.set(xlim=(-0.01, 1.01), ylim=(-0.01, 1.01), aspect="equal")
    _dress(axes, "false positive rate", "true positive rate (micro-average)")
    axes.legend(frameon=False, fontsize=9, loc="lower right")
    return figure


def _latents(shown: Sequence[Latent], source: str) -> Figure:
    figure = _figure(1 + 3.6 * max(len(shown), 1.3), 3.4)
    for axes, latent in zip(figure.subplots(1, len(shown), squeeze=False).flat, shown, strict=True):
        title, quantity = latent_names(latent.name)
        left, width = latent.edges[:-1], np.diff(latent.edges)
        axes.bar(left, latent.observed, width, align="edge", color=OBSERVED, label="observed")
        colour = _colour(source)
        axes.stairs(latent.predicted, latent.edges, color=colour, linewidth=1.8, label="generated")
        unit = f", {latent.unit}" if latent.unit else ""
        _dress(axes, f"{quantity}{unit}", "share per bin")
        axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        axes.set_title(title, fontsize=11, color=INK, loc="left")
        if any(latent.outside):
            text = missing(latent).replace(": ", ":\n")
            axes.set_title(text, fontsize=7, color=MUTED, loc="right")
        axes.set_xlim(latent.edges[0], latent.edges[-1])
    marks = figure.axes[0].get_legend_handles_labels()
    figure.legend(*marks, frameon=False, fontsize=9, ncols=2, loc="outside lower left")
    return figure


def _pit(pit: NDArray, source: str) -> Figure:
    figure = _figure(5.6, 3.6)
    axes = figure.add_subplot()
    count = pit.shape[1]
    edges = np.linspace(0, 1, count + 1)
    low, high = (np.append(row, row[-1]) for row in pit[1:])
    text, colour = "where 90 % of perfect generators lie", _colour(source)
    axes.fill_between(
        edges, low, high, step="post", color=colour, alpha=0.25, linewidth=0, label=text
    )
    axes.axhline(1 / count, color=MUTED, linestyle=":", linewidth=1, label="uniform")
    axes.stairs(pit[0], edges, baseline=None, color=INK, linewidth=1.6, label="measured")
    axes.set_ylim(0, 1.1 * max(high.max(), pit[0].max()))
    _dress(axes, "share of draws below the measured value", "share of points")
    axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    axes.set_xlim(0, 1)
    figure.legend(frameon=False, fontsize=9, ncols=3, loc="outside lower left")
    return figure


def _bands(shown: Sequence[Band], source: str) -> Figure:
    """A row per trajectory, a column per output."""
    names = list(dict.fromkeys(band.trajectory for band in shown))
    wide = len(shown) // len(names)
    figure = _figure(0.6 + 3.6 * max(wide, 1.3), 0.5 + 2.6 * len(names))
    grid = figure.subplots(len(names), wide, squeeze=False, sharex=True)
    colour = _colour(source)
    for axes, band in zip(grid.flat, shown, strict=True):
        for low, high, alpha, text in ((0, 4, 0.2, "90 % of the draws"), (1, 3, 0.45, "50 %")):
            edges = band.quantiles[low], band.quantiles[high]
            axes.fill_between(band.time, *edges, color=colour, alpha=alpha, linewidth=0, label=text)
        axes.plot(band.time, band.observed, color=INK, linewidth=1, label="measured")
        unit = f", {band.unit}" if band.unit else ""
        last = band.trajectory == names[-1]
        _dress(axes, "time, s" if last else "", f"{band.output} minus nominal{unit}")
        which = "typical" if band.trajectory == names[0] else "worst"
        axes.set_title(f"{band.output}, {which}", fontsize=11, color=INK, loc="left")
        axes.set_xlim(band.time[0], band.time[-1])
    marks = figure.axes[0].get_legend_handles_labels()
    figure.legend(*marks, frameon=False, fontsize=9, ncols=3, loc="outside lower left")
    return figure
