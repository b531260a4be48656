"""The chart beside a film: what was measured, and the band of an updated twin, over time."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.cases.animation.shots import GHOST, PAPER, SOLID, UPDATED, Pictures, Shots

DPI = 100
"""Pixels per inch, by which matplotlib converts sizes."""
VEIL = 0.88
"""Opacity of the veil over what is not yet reached, from 0 to 1."""
WIDE = 1.5
"""Ratio of width to height from which on the chart is beside the picture and not below it."""


@dataclass(frozen=True, eq=False)
class Chart:
    """The deviation of one output from the nominal motion.

    Attributes
    ----------
    title : str
        The axis: output and unit.
    time : ndarray, shape (T,)
        Times in s.
    observed : ndarray, shape (T,)
        Measured minus nominal, NaN where nothing was measured.
    drawn : ndarray, shape (draws, T)
        Draws of the updated twin minus nominal.

    """

    title: str
    time: NDArray
    observed: NDArray
    drawn: NDArray


@dataclass(frozen=True)
class Layout:
    """Where picture and chart are in a film, as sizes (width, height) in pixels."""

    picture: tuple[int, int]
    chart: tuple[int, int]

    @classmethod
    def of(cls, size: tuple[int, int]) -> Layout:
        """The chart on the right of a wide film, else below the picture."""
        width, height = size
        if width >= WIDE * height:
            left = round(0.45 * width)
            return cls((left, height), (width - left, height))
        top = round(0.66 * height)
        return cls((width, top), (width, height - top))

    @property
    def beside(self) -> bool:
        """Whether the chart is on the right."""
        return self.picture[1] == self.chart[1]


def charted(pictures: Pictures, shots: Shots, chart: Chart, layout: Layout) -> Iterator[NDArray]:
    """Add the chart to pictures, with what is not yet reached behind a veil.

    Parameters
    ----------
    pictures : iterable of ndarray of uint8, shape (height, width, 3)
        The pictures, of the size that the layout has for them.
    shots : Shots
        The frames.
    chart : Chart
        What is drawn.
    layout : Layout
        Sizes of picture and chart.

    Yields
    ------
    ndarray of uint8, shape (height, width, 3)
        Picture and chart in one.

    """
    whole, (left, right, top, bottom) = _drawn(chart, layout.chart)
    begin, end = chart.time[0], chart.time[-1]
    paper = np.round(255 * np.array(PAPER))
    for second, picture in zip(shots.seconds, pictures, strict=True):
        shown = whole.copy()
        share = 1.0 if end <= begin else min(1.0, (second - begin) / (end - begin))
        now = round(left + share * (right - left))
        veiled = shown[top:bottom, now : right + 2]
        shown[top:bottom, now : right + 2] = np.round(VEIL * paper + (1 - VEIL) * veiled)
        shown[top:bottom, now] = np.round(255 * np.array(GHOST))
        yield np.concatenate([picture, shown], axis=1 if layout.beside else 0)


def _drawn(chart: Chart, size: tuple[int, int]) -> tuple[NDArray, tuple[int, int, int, int]]:
    """The whole chart (height, width, 3), and left, right, top, bottom of its axes in pixels."""
    # Without pyplot, which would use a window system and global state.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    scale = min(size[0] / 4.2, size[1] / 1.9) / DPI  # texts grow with the film
    dpi = max(50.0, min(2.0, scale) * DPI)
    inches = size[0] / dpi, size[1] / dpi
    figure = Figure(figsize=inches, dpi=dpi, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(facecolor=PAPER)
    for share, alpha in ((0.9, 0.25), (0.5, 0.4)):
        low, high = np.quantile(chart.drawn, [(1 - share) / 2, (1 + share) / 2], axis=0)
        label = f"updated twin, {100 * share:.0f} %"
        axes.fill_between(
            chart.time, low, high, color=UPDATED, alpha=alpha, linewidth=0, label=label
        )
    axes.axhline(0, color=GHOST, linewidth=1.2, linestyle=":", label="nominal")
    axes.plot(chart.time, chart.observed, color=SOLID, linewidth=1.5, label="observed")
    axes.set_xlabel("time, s", fontsize=8)
    axes.set_ylabel(chart.title, fontsize=8)
    axes.tick_params(labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlim(chart.time[0], max(chart.time[-1], chart.time[0] + 1e-9))
    figure.legend(
        loc="outside upper center", ncols=2 if inches[0] < 5.6 else 4, frameon=False, fontsize=7
    )
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=dpi)
    box = axes.get_window_extent()
    image = Image.open(file).convert("RGB").resize(size)
    height = size[1]
    edges = box.x0, box.x1, height - box.y1, height - box.y0
    left, right, top, bottom = (round(edge) for edge in edges)
    return np.asarray(image), (left, min(right, size[0] - 2), max(top, 0), bottom)
