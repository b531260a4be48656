"""What all figures made by matplotlib share: their look, and how they become a PNG."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from retwin.report.words import CHROME, DASHES, PALETTE, dash, slot, symbol

__all__ = [
    "ALARM",
    "GRID",
    "INK",
    "MUTED",
    "OBSERVED",
    "RULE",
    "WASH",
    "blank",
    "colour",
    "dress",
    "legend",
    "line",
    "marker",
    "png",
    "shade",
]

INK, MUTED, GRID, RULE, WASH, OBSERVED, ALARM = (
    CHROME[name][0] for name in ("ink", "muted", "grid", "rule", "wash", "observed", "alarm")
)
STYLES = dict(zip(DASHES, ("-", "--", ":", "-."), strict=True))


def blank(width: float, height: float) -> Figure:
    """A white figure of this size in inches."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def png(figure: Figure, emulated: bool) -> bytes:
    """As it is stored; above emulated data it says so."""
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


def dress(axes: Axes, x: str, y: str) -> None:
    """Labels of both axes, in the page's style."""
    axes.set_xlabel(x, color=MUTED)
    axes.set_ylabel(y, color=MUTED)
    axes.tick_params(colors=MUTED, labelsize=9)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    for name, spine in axes.spines.items():
        spine.set_color(RULE)
        spine.set_visible(name in ("left", "bottom"))


def colour(source: str) -> str:
    """As on the page when it is light."""
    return PALETTE[slot(source)][0]


def legend(figure: Figure, columns: int) -> None:
    """Below all axes, of what the first one shows."""
    marks = figure.axes[0].get_legend_handles_labels()
    figure.legend(*marks, frameon=False, fontsize=9, ncols=columns, loc="outside lower left")


def line(source: str) -> dict[str, Any]:
    """Colour and style of the source's lines, as matplotlib's plot takes them."""
    return {"color": colour(source), "linestyle": STYLES[dash(source)]}


def shade(source: str, alpha: float) -> dict[str, Any]:
    """Of the source's bands, as matplotlib's fill_between takes them."""
    return {"color": colour(source), "alpha": alpha, "linewidth": 0}


def marker(source: str) -> str:
    """Of the source's points."""
    return {"circle": "o", "square": "s"}[symbol(source)]
