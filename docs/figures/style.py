"""How the pictures of the docs look: as those of a study's report."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from retwin.report.figures.png import blank, dress
from retwin.report.figures.style import PALETTE, hexadecimal

__all__ = [
    "BLUE",
    "GREEN",
    "INK",
    "MUTED",
    "ORANGE",
    "PINK",
    "RULE",
    "animation",
    "blank",
    "dress",
    "note",
    "save",
    "title",
    "write",
]

INK, MUTED, RULE = map(hexadecimal, ("ink", "muted", "rule"))
IMAGES = Path(__file__).parents[1] / "images"
BLUE, ORANGE, GREEN, PINK = (light for light, _ in PALETTE[:4])
COLOURS = 128
"""Colours of a file, which keeps it small."""


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
    write(name, file)


def write(name: str, file: io.BytesIO) -> None:
    """docs/images/NAME.png of a picture in memory, with few colours."""
    IMAGES.mkdir(exist_ok=True)
    image = Image.open(file).convert("RGB").quantize(COLOURS)
    image.save(IMAGES / f"{name}.png", optimize=True)


def animation(name: str, frames: Sequence[Image.Image], fps: float) -> None:
    """docs/images/NAME.webp, which repeats; its last frame stays for three seconds."""
    IMAGES.mkdir(exist_ok=True)
    durations = [round(1000 / fps)] * (len(frames) - 1) + [3000]
    first, *rest = frames
    first.save(
        IMAGES / f"{name}.webp",
        save_all=True,
        append_images=rest,
        duration=durations,
        loop=0,
        quality=60,
        method=4,
    )
