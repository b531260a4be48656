"""Figures as PNG, by matplotlib, in the colours of the light page."""

from __future__ import annotations

import io
import math
from typing import Any, Literal

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, MultipleLocator, NullLocator, PercentFormatter
from PIL import Image

from retwin.report.figures.figure import (
    Axis,
    Band,
    Dimension,
    Figure,
    Heading,
    Key,
    Line,
    Mark,
    Matrices,
    Panel,
    Points,
    Row,
    Spans,
)
from retwin.report.figures.style import CHROME, DASHES, colour_of, hexadecimal

STYLES: dict[str, Any] = dict(zip(DASHES, ("-", "--", ":", "-."), strict=True))
SYMBOLS = {"circle": "o", "square": "s", "diamond": "D", "diamond-open": "D"}


@rc_context({"text.parse_math": False})  # a name with $ is no formula
def png(shown: Figure | Matrices, *, emulated: bool) -> bytes:
    """The figure as PNG; a heading marks emulated data."""
    canvas = draw(shown)
    if emulated:
        heading = "EMULATED data: no real measurements"
        canvas.suptitle(heading, color=hexadecimal("alarm"), fontsize=10)
    elif isinstance(shown, Figure):
        canvas.suptitle(shown.title, color=hexadecimal("ink"), fontsize=10)
    canvas.set_dpi(160)
    drawn = FigureCanvasAgg(canvas)
    drawn.draw()
    # 256 colours suffice and take a third of the bytes.
    image = Image.fromarray(np.asarray(drawn.buffer_rgba())).convert("RGB").quantize(256)
    file = io.BytesIO()
    image.save(file, format="png", optimize=True, dpi=(160, 160))
    return file.getvalue()


def blank(width: float, height: float) -> Canvas:
    """A white canvas of this size in inches."""
    canvas = Canvas(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(canvas)
    return canvas


def dress(axes: Axes, x: str, y: str) -> None:
    """Label both axes in the page's style."""
    axes.set_xlabel(x, color=hexadecimal("muted"))
    axes.set_ylabel(y, color=hexadecimal("muted"))
    axes.tick_params(colors=hexadecimal("muted"), labelsize=9)
    axes.grid(color=hexadecimal("grid"), linewidth=0.8)
    axes.set_axisbelow(True)
    for name, spine in axes.spines.items():
        spine.set_color(hexadecimal("rule"))
        spine.set_visible(name in ("left", "bottom"))


def draw(shown: Figure | Matrices) -> Canvas:
    """The figure on a canvas."""
    return _matrices(shown) if isinstance(shown, Matrices) else _figure(shown)


def _figure(figure: Figure) -> Canvas:
    wide = min(len(figure.panels), figure.columns)
    tall = math.ceil(len(figure.panels) / wide)
    rows = len(figure.panels[0].rows)
    width = 7.5 if wide == 1 else 0.6 + 3.6 * wide
    canvas = blank(width, 0.5 + tall * figure.panels[0].height / 100)
    ratios = ([2, 1] if rows == 2 else [1]) * tall
    grid = canvas.subplots(rows * tall, wide, squeeze=False, height_ratios=ratios)
    for axes in grid.flat:
        axes.set_visible(False)
    for place, panel in enumerate(figure.panels):
        top, column = rows * (place // wide), place % wide
        for below, row in enumerate(panel.rows):
            axes = grid[top + below, column]
            axes.set_visible(True)
            _panel(axes, panel, row, last=below == rows - 1)
        grid[top, column].set_title(panel.title, fontsize=11, color=hexadecimal("ink"), loc="left")
    if figure.keys:
        handles = [_handle(key) for key in figure.keys]
        look: dict[str, Any] = {"frameon": False, "fontsize": 9, "ncols": 2 if wide == 1 else 3}
        canvas.legend(handles=handles, loc="outside lower left", **look)
    return canvas


def _panel(axes: Axes, panel: Panel, row: Row, *, last: bool) -> None:
    dress(axes, panel.x.title if last else "", row.y.title)
    for mark in row.drawn:
        _mark(axes, mark)
    _scale(axes, panel.x, "x")
    _scale(axes, row.y, "y")


def _scale(axes: Axes, axis: Axis, which: Literal["x", "y"]) -> None:
    made = axes.xaxis if which == "x" else axes.yaxis
    limit = axes.set_xlim if which == "x" else axes.set_ylim
    if axis.kind == "log":
        (axes.set_xscale if which == "x" else axes.set_yscale)("log")
        made.set_minor_locator(NullLocator())
    if axis.ticks:
        made.set_ticks(list(axis.ticks), list(axis.ticks.values()))
    elif axis.step is not None:
        made.set_major_locator(MultipleLocator(axis.step))
    elif axis.kind != "log":
        made.set_major_locator(MaxNLocator(axis.count))
    if axis.kind == "percent":
        made.set_major_formatter(PercentFormatter(1))
    if axis.kind == "names":
        axes.grid(visible=False, axis=which)
        axes.tick_params(axis=which, length=0, labelcolor=hexadecimal("ink"))
    if axis.bare:
        axes.tick_params(axis=which, labelbottom=False, labelleft=False)
    if axis.limits is not None:
        limit(*axis.limits)
    elif axis.from_zero:
        limit(0, None)


def _mark(axes: Axes, mark: Mark) -> None:
    look: dict[str, Any] = {
        "color": hexadecimal("ink" if isinstance(mark, Heading) else mark.colour)
    }
    match mark:
        case Line(filled=True):
            axes.fill_between(mark.x, mark.y, linewidth=0, **look)
        case Line():
            look |= {"alpha": mark.alpha, "linestyle": STYLES[mark.dash]}
            axes.plot(mark.x, mark.y, linewidth=0.8 * mark.width, **look)
        case Band():
            axes.fill_between(mark.x, mark.low, mark.high, alpha=mark.alpha, linewidth=0, **look)
        case Points():
            look |= {"elinewidth": 0.8 * mark.bar_width, "markersize": 0.6 * mark.size}
            look |= {f"{mark.along}err": mark.intervals} | _symbol(mark.symbol, look["color"])
            axes.errorbar(mark.x, mark.y, linestyle=STYLES.get(mark.dash, "none"), **look)
        case Spans():
            area = {"facecolor": (look["color"], mark.alpha), "edgecolor": look["color"]}
            for start, end in mark.intervals:
                axes.axvspan(start, end, 0, mark.height, linewidth=mark.outline, zorder=0, **area)
        case Dimension():
            axes.plot(*zip(mark.start, mark.end, strict=True), linewidth=3, **look)
        case Heading():
            look |= {"transform": axes.get_yaxis_transform(), "va": "center", "weight": "bold"}
            axes.text(0.01, mark.y, mark.text, fontsize=9, **look)


def _symbol(name: str, colour: str) -> dict[str, str]:
    filled = "white" if name.endswith("-open") else colour
    return {"marker": SYMBOLS[name], "markerfacecolor": filled}


def _handle(key: Key) -> Line2D | Patch:
    look: dict[str, Any] = {"color": hexadecimal(key.colour), "label": key.text}
    if key.mark == "bar":
        return Patch(alpha=1 if key.colour in CHROME else 0.4, linewidth=0, **look)
    if key.mark in SYMBOLS:
        look |= _symbol(key.mark, look["color"])
    return Line2D([], [], linestyle=STYLES.get(key.mark, "none"), **look)


def _matrices(shown: Matrices) -> Canvas:
    wide = min(len(shown.matrices), 3)
    tall = math.ceil(len(shown.matrices) / wide)
    canvas = blank(1 + 4.2 * wide, 0.6 + 4.1 * tall)
    grid: list[Axes] = list(canvas.subplots(tall, wide, squeeze=False).flat)
    for axes in grid:
        axes.set_visible(False)
    ticks = range(len(shown.classes))
    for place, (axes, matrix) in enumerate(zip(grid, shown.matrices, strict=False)):
        axes.set_visible(True)
        first = place % wide == 0
        ends = [hexadecimal("wash"), hexadecimal(colour_of(matrix.source))]
        tint = LinearSegmentedColormap.from_list("tint", ends)
        axes.imshow(matrix.shares, cmap=tint, vmin=0, vmax=1)
        for (row, column), share in np.ndenumerate(matrix.shares):
            if count := matrix.counts[row][column]:
                tone = "white" if share >= 0.78 else hexadecimal("ink")
                middle: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 8}
                axes.text(column, row, str(count), color=tone, **middle)
        axes.set_title(matrix.title, fontsize=11, color=hexadecimal("ink"), loc="left")
        axes.set_xticks(ticks, shown.classes, rotation=90)
        axes.set_yticks(ticks, shown.classes if first else [])
        dress(axes, "diagnosis", "true class" if first else "")
        axes.grid(visible=False)
        axes.tick_params(length=0, labelsize=8)
    return canvas
