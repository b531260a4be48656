"""How the pictures of the docs look: as those of a study's report."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from retwin.report.words import CHROME, PALETTE

__all__ = [
    "BLUE",
    "GREEN",
    "INK",
    "MUTED",
    "ORANGE",
    "PINK",
    "RULE",
    "dress",
    "new",
    "note",
    "save",
    "title",
]

IMAGES = Path(__file__).parents[1] / "images"
INK, MUTED, GRID, RULE = (CHROME[name][0] for name in ("ink", "muted", "grid", "rule"))
BLUE, ORANGE, GREEN, PINK = (light for light, _ in PALETTE[:4])
COLOURS = 128
"""Colours of a file, which keeps it small."""


def new(width: float, height: float) -> Figure:
    """An empty picture, in inches."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def dress(axes: Axes, x: str, y: str) -> None:
    """Names of the axes, and no more lines than it takes."""
    axes.set_xlabel(x, color=MUTED)
    axes.set_ylabel(y, color=MUTED)
    axes.tick_params(colors=MUTED, labelsize=9)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    for name, spine in axes.spines.items():
        spine.set_color(RULE)
        spine.set_visible(name in ("left", "bottom"))


def title(axes: Axes, text: str) -> None:
    """What a panel shows."""
    axes.set_title(text, fontsize=10, color=INK, loc="left")


def note(axes: Axes, text: str, *, low: bool = False, left: bool = False) -> None:
    """A figure that sums a panel up, in one of its corners."""
    axes.text(
        0.02 if left else 0.98,
        0.03 if low else 0.97,
        text,
        transform=axes.transAxes,
        ha="left" if left else "right",
        va="bottom" if low else "top",
        fontsize=9,
        color=INK,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 2},
    )


def save(name: str, figure: Figure, whose: str) -> None:
    """docs/images/NAME.png, with whose data it shows at its top."""
    figure.suptitle(whose, fontsize=9, color=MUTED, x=0.01, ha="left")
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=120, metadata={"Software": None})
    IMAGES.mkdir(exist_ok=True)
    image = Image.open(file).convert("RGB").quantize(COLOURS)
    image.save(IMAGES / f"{name}.png", optimize=True)
