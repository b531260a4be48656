"""Captions: title, time and legend on every picture of a film."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from retwin.cases.animation.shots import GHOST, SOLID, UPDATED, Pictures, Shots

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont


INK = (27, 31, 36)
MUTED = (90, 99, 110)
ALARM = (143, 45, 0)


def captioned(pictures: Pictures, shots: Shots) -> Iterator[NDArray]:
    """Add captions to pictures.

    Parameters
    ----------
    pictures : iterable of ndarray, shape (height, width, 3)
        One picture per frame.
    shots : Shots
        The frames.

    Yields
    ------
    ndarray, shape (height, width, 3)
        The picture with title, time and legend, and a note where data are emulated.

    """
    from PIL import Image, ImageDraw

    for second, picture in zip(shots.seconds, pictures, strict=True):
        image = Image.fromarray(picture)
        _write(ImageDraw.Draw(image), image.size, shots, float(second))
        yield np.asarray(image)


def _write(draw: ImageDraw, size: tuple[int, int], shots: Shots, second: float) -> None:
    """Draw the captions of one frame."""
    width, height = size
    text = max(9, round(min(width / 44, height / 31)))
    margin = text
    title, plain = _font(text, bold=True), _font(text)
    draw.text((margin, margin), shots.title, INK, title)
    draw.text((width - margin, margin), f"{second:.2f} s", INK, plain, anchor="ra")
    if shots.emulated:
        draw.text((margin, margin + 1.5 * text), "EMULATED: no real measurements", ALARM, title)
    line = height - margin
    legend = [
        (SOLID, "observed: only the tip is measured, the pose is the nearest to the nominal"),
        (GHOST, "nominal (ghost)"),
    ]
    if len(shots.drawn):
        legend[0] = (SOLID, "observed; the pose is inferred from the tip")
        legend.append((UPDATED, f"updated twin, {len(shots.drawn)} draws of the tip"))
    for colour, text_line in legend:
        mark = (margin, line - 0.5 * text, margin + 1.4 * text, line - 0.25 * text)
        draw.rectangle(mark, fill=tuple(round(255 * part) for part in colour))
        draw.text((margin + 2 * text, line), text_line, MUTED, _font(0.9 * text), anchor="ls")
        line -= round(1.5 * text)


def _font(size: float, *, bold: bool = False) -> FreeTypeFont:
    """The font of the captions, which matplotlib brings along."""
    import matplotlib
    from PIL.ImageFont import truetype

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", name), size)
