"""The figures as PNG, by matplotlib, for papers and slides."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from retwin.catalog import METRICS
from retwin.report.canvas import (
    INK,
    MUTED,
    RULE,
    WASH,
    blank,
    colour,
    dress,
    line,
    marker,
    png,
    shade,
)
from retwin.report.confusion import recalls
from retwin.report.curves import bands
from retwin.report.discrepancy import figure_names, groups
from retwin.report.learning import learning_curves
from retwin.report.movement import movement
from retwin.report.plots import published_value
from retwin.report.reliability import reliabilities
from retwin.report.results import Results
from retwin.report.roc import roc_curves
from retwin.report.simulation import records
from retwin.report.twin_figures import (
    draw_bands,
    draw_latents,
    draw_movement,
    draw_pit,
    draw_simulation,
)
from retwin.report.words import class_name, mean_and_spread, order, source_name

__all__ = ["FIGURES", "draw_figures"]

FIGURES = (
    "scores",
    "confusion",
    "roc",
    "reliability",
    "simulation",
    "movement",
    "tde",
    "tpe",
    "noise",
    "pit",
    "bands",
    "learning",
)
"""The figures of a study; its file is `figures/NAME.png`, of a second source `NAME-2.png`."""
SCORES = ("macro_f1", "balanced_accuracy", "auroc", "healthy_recall")


def draw_figures(results: Results) -> dict[str, bytes]:
    """PNG by figure name; what lacks its data is left out."""
    drawn = {
        "scores": _scores(results),
        "confusion": _confusion(results),
        "roc": _roc(results),
        "reliability": _reliability(results),
        "learning": _learning(results),
    }
    if found := records(results):
        drawn["simulation"] = draw_simulation(found)
    if taken_apart := movement(results):
        drawn["movement"] = draw_movement(taken_apart)
    for group in groups(results):
        drawn[group.name] = draw_latents(group.shown, group.source)
    for source, added in figure_names(results).items():
        if f"pit/{source}" in results.arrays:
            drawn[f"pit{added}"] = draw_pit(results.arrays[f"pit/{source}"], source)
        if shown := bands(results, source):
            drawn[f"bands{added}"] = draw_bands(shown, source)
    return {
        name: png(figure, results.emulated) for name, figure in drawn.items() if figure is not None
    }


def _scores(results: Results) -> Figure | None:
    sources = order(list(results.sources))
    shown = [name for name in SCORES if any(name in results.sources[s].scores for s in sources)]
    if not shown:
        return None
    figure = blank(7, 0.9 + 0.26 * len(shown) * max(len(sources), 2))
    axes = figure.add_subplot()
    for place, source in enumerate(sources):
        lane = 0.62 * ((place + 0.5) / len(sources) - 0.5) - 0.04
        _score_marks(axes, results, source, shown, lane)
    axes.set_yticks(range(len(shown)), [METRICS[name].title for name in shown])
    axes.set_ylim(len(shown) - 0.5, -0.5)
    axes.set_xlim(-0.01, 1.02)
    paper = "; open diamonds: paper ± sd" if results.published else ""
    dress(axes, f"score: mean and 95 % bootstrap interval{paper}", "")
    axes.tick_params(axis="y", length=0, labelcolor=INK)
    axes.grid(visible=False, axis="y")
    axes.legend(frameon=False, fontsize=9, ncols=3, loc="lower left", bbox_to_anchor=(0, 1))
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
            axes.plot(ends, [place + lane] * 2, color=colour(source), linewidth=1.8)
            name = None if named else source_name(source)
            axes.plot(
                mean, place + lane, marker(source), color=colour(source), markersize=6, label=name
            )
            named = True
        value = published_value(told.get(metric, ""))
        if value is not None:
            axes.errorbar(
                value[0],
                place + lane + 0.12,
                xerr=value[1] or None,
                fmt="D",
                color=colour(source),
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
    figure = blank(1 + 4.2 * wide, 0.6 + 4.1 * tall)
    names = [class_name(name) for name in results.classes]
    grid = figure.subplots(tall, wide, squeeze=False)
    for axes in grid.flat[len(sources) :]:
        axes.set_visible(False)
    for place, source in enumerate(sources):
        axes = grid.flat[place]
        counts = results.sources[source].confusion or []
        shares = np.array(recalls(counts))
        tint = LinearSegmentedColormap.from_list("tint", [WASH, colour(source)])
        axes.imshow(shares, cmap=tint, vmin=0, vmax=1)
        for (row, column), share in np.ndenumerate(shares):
            if counts[row][column]:
                tone = "white" if share >= 0.78 else INK
                text = str(counts[row][column])
                axes.text(column, row, text, ha="center", va="center", color=tone, fontsize=8)
        axes.set_title(source_name(source), fontsize=11, color=INK, loc="left")
        axes.set_xticks(range(len(names)), names, rotation=90)
        axes.set_yticks(range(len(names)), names if place % wide == 0 else [])
        dress(axes, "answer", "true class" if place % wide == 0 else "")
        axes.grid(visible=False)
        axes.tick_params(length=0, labelsize=8)
    return figure


def _roc(results: Results) -> Figure | None:
    curves = roc_curves(results)
    if not curves:
        return None
    figure = blank(5.6, 5.2)
    axes = figure.add_subplot()
    axes.plot([0, 1], [0, 1], color=RULE, linewidth=1)
    for source, curve in curves.items():
        if len(curve.areas) > 1:
            axes.fill_between(curve.rate, *curve.band, **shade(source, 0.18))
        text = f"{source_name(source)}: {mean_and_spread(curve.areas)}"
        axes.plot(curve.rate, curve.mean, linewidth=1.8, label=text, **line(source))
    axes.set(xlim=(-0.01, 1.01), ylim=(-0.01, 1.01), aspect="equal")
    dress(axes, "false positive rate", "true positive rate (micro-average)")
    axes.legend(frameon=False, fontsize=9, loc="lower right")
    return figure


def _reliability(results: Results) -> Figure | None:
    found = reliabilities(results)
    if not found:
        return None
    wide = min(len(found), 3)
    tall = math.ceil(len(found) / wide)
    figure = blank(0.6 + 2.9 * wide, 0.4 + 2.9 * tall)
    grid = figure.subplots(tall, wide, squeeze=False, sharex=True, sharey=True)
    for axes in grid.flat[len(found) :]:
        axes.set_visible(False)
    for place, (source, each) in enumerate(found.items()):
        axes = grid.flat[place]
        axes.plot([0, 1], [0, 1], ":", color=MUTED, linewidth=1)
        axes.vlines(
            each.confidence, each.low, each.high, color=colour(source), alpha=0.35, linewidth=5
        )
        axes.plot(each.confidence, each.right, marker(source), color=colour(source), markersize=6)
        axes.set_title(source_name(source), fontsize=11, color=INK, loc="left")
        below, left = place >= len(found) - wide, place % wide == 0
        dress(axes, "confidence" if below else "", "share that is right" if left else "")
        axes.set(xlim=(-0.03, 1.05), ylim=(-0.03, 1.05), aspect="equal")
    return figure


def _learning(results: Results) -> Figure | None:
    curves = learning_curves(results)
    if not curves:
        return None
    figure = blank(4 * len(curves), 3.4)
    for axes, (title, lines) in zip(
        figure.subplots(1, len(curves), squeeze=False)[0], curves.items(), strict=True
    ):
        for source, points in lines.items():
            count, value, low, high = (np.array(each) for each in zip(*points, strict=True))
            axes.plot(count, value, label=source_name(source), **line(source))
            axes.fill_between(count, low, high, **shade(source, 0.12))
        axes.set_xscale("log")
        ticks = sorted({point[0] for points in lines.values() for point in points})
        axes.set_xticks(ticks, [str(tick) for tick in ticks], minor=False)
        axes.minorticks_off()
        axes.set_ylim(*((0, None) if title == "RMSE" else (-0.02, 1.02)))
        dress(axes, "healthy trajectories", title)
    axes.legend(frameon=False, fontsize=8)
    return figure
