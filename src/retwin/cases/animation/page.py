"""Pages of a film: the picture with title, time and legend, and the chart of an updated twin."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.cases.animation.shots import GHOST, PAPER, RING, SOLID, UPDATED, Camera, Pictures, Shots

DPI = 100
"""Pixels per inch, by which matplotlib converts sizes."""
VEIL = 0.88
"""Opacity of the veil over what is not yet reached, from 0 to 1."""
INK, MUTED, ALARM = "#1b1f24", "#5a636e", "#8f2d00"


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


def picture_size(size: tuple[int, int], *, chart: bool, wide: float = 1.5) -> tuple[int, int]:
    """Width and height in pixels of the picture in a film, which the chart leaves for it.

    Parameters
    ----------
    wide : float, default 1.5
        Ratio of width to height from which on the chart is beside the picture and not below it.

    """
    width, height = size
    if not chart:
        return size
    return (
        (round(0.45 * width), height) if width >= wide * height else (width, round(0.66 * height))
    )


def film_pages(
    shots: Shots, size: tuple[int, int], pictures: Pictures | None, chart: Chart | None
) -> Iterator[NDArray]:
    """Draw the pages of a film with matplotlib.

    Parameters
    ----------
    shots : Shots
        The frames.
    size : (int, int)
        Width and height in pixels.
    pictures : iterable of ndarray of uint8, shape (height, width, 4), optional
        The pictures, as large as `picture_size` states; by default stick figures are drawn.
    chart : Chart, optional
        The chart beside or below them, of which time uncovers more and more.

    Yields
    ------
    ndarray of uint8, shape (height, width, 3)
        One page per frame.

    """
    # Without pyplot, which would use a window system and global state.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = size
    figure: Any = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor=PAPER)
    canvas = FigureCanvasAgg(figure)
    inner = picture_size(size, chart=chart is not None)
    rest = width - inner[0], height - inner[1]
    part = figure
    if chart is not None:
        part, beside = (
            figure.subfigures(1, 2, width_ratios=(inner[0], rest[0]))
            if rest[0]
            else figure.subfigures(2, 1, height_ratios=(inner[1], rest[1]))
        )
    scene = _draw_scene(part, shots, inner, pictures is not None)
    steps = [_captions(part, shots, inner)]
    if chart is not None:
        steps.append(_draw_chart(beside, chart, shots, (rest[0] or width, rest[1] or height)))
    for i, picture in enumerate(repeat(None, len(shots)) if pictures is None else pictures):
        scene(i, picture)
        for step in steps:
            step(i)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _captions(figure: Any, shots: Shots, size: tuple[int, int]) -> Callable[[int], None]:
    """Write the title, the legend, and at each frame the time."""
    text = max(9.0, min(size[0] / 44, size[1] / 31))
    x, y, points = text / size[0], text / size[1], 72 * text / DPI
    look: dict[str, Any] = {"fontsize": points, "color": INK, "va": "top"}
    figure.text(x, 1 - y, shots.title, weight="bold", **look, parse_math=False)
    time = figure.text(1 - x, 1 - y, "", ha="right", **look)
    if shots.emulated:
        note = "EMULATED: no real measurements"
        figure.text(x, 1 - 2.5 * y, note, weight="bold", **look | {"color": ALARM})
    legend = [
        (SOLID, "observed: only the tip is measured, the pose is the nearest to the nominal"),
        (GHOST, "nominal (ghost)"),
    ]
    if len(shots.drawn):
        legend[0] = (SOLID, "observed; the pose is inferred from the tip")
        legend.append((UPDATED, f"updated twin, {len(shots.drawn)} draws of the tip"))
    for place, (colour, line) in enumerate(legend):
        for shift, words, paint in ((0.0, "▬", colour), (2 * x, line, MUTED)):
            where = x + shift, (1 + 1.5 * place) * y
            figure.text(*where, words, fontsize=0.9 * points, color=paint)
    return lambda frame: time.set_text(f"{shots.seconds[frame]:.2f} s")


def _draw_scene(
    figure: Any, shots: Shots, size: tuple[int, int], solid: bool
) -> Callable[[int, NDArray | None], None]:
    """Draw bodies or skeletons, the paths of their tips, and the draws of an updated twin."""
    width, height = size
    unit, camera = min(size) / 480, Camera.of(shots, size)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()

    def line(colour: Any, thick: float, zorder: int, **look: Any) -> Any:
        return axes.plot([], [], color=colour, linewidth=thick * unit, zorder=zorder, **look)[0]

    def show(one: Any, points: NDArray) -> None:
        one.set_data(*camera.project(points).T)

    for ring in shots.rings:
        show(line(RING, 1 / unit, 1), ring)
    blank = np.zeros((height, width, 4), np.uint8)
    image = axes.imshow(blank, extent=(0, width, height, 0), aspect="auto", zorder=2)
    chains = [
        (
            points,
            line(colour, 1.2, zorder, marker="o", markersize=5 * unit, markevery=[-1]),
            line(colour, thick, zorder + 2, alpha=alpha, marker="o", markersize=1.7 * thick * unit),
        )
        for points, colour, alpha, thick, zorder in (
            (shots.points[0], GHOST, 0.55, 5.0, 3),
            (shots.points[1], SOLID, 1.0, 4.0, 4),
        )
    ]
    trails = [line(UPDATED, 0.8, 4, alpha=0.6) for _ in shots.drawn]
    tips = line(UPDATED, 0, 7, marker="o", markersize=3.5 * unit)

    def step(frame: int, picture: NDArray | None) -> None:
        for trail, path in zip(trails, shots.trails(frame), strict=True):
            show(trail, path)
        if trails:
            show(tips, shots.drawn[:, frame])
        for points, trace, chain in chains:
            show(trace, points[: frame + 1, -1])
            if not solid:
                show(chain, points[frame])
        if picture is not None:
            image.set_data(picture)

    return step


def _draw_chart(
    figure: Any, chart: Chart, shots: Shots, size: tuple[int, int]
) -> Callable[[int], None]:
    """Draw the bands of the updated twin and what was measured."""
    width, height = size
    text = max(5.0, min(width / 42, height / 13))
    columns = 4 if width > 45 * text else 2
    left, bottom, top = 6 * text, 4.2 * text, (2.0 if columns == 4 else 3.5) * text
    corners = (left, bottom, width - left - text, height - bottom - top)
    axes = figure.add_axes(tuple(np.divide(corners, (*size, *size))), facecolor=PAPER)
    points = 65 * text / DPI
    for share, alpha in ((0.9, 0.25), (0.5, 0.4)):
        low, high = np.quantile(chart.drawn, [(1 - share) / 2, (1 + share) / 2], axis=0)
        look: dict[str, Any] = {"color": UPDATED, "alpha": alpha, "linewidth": 0}
        label = f"updated twin, {100 * share:.0f} %"
        axes.fill_between(chart.time, low, high, label=label, **look)
    axes.axhline(0, color=GHOST, linewidth=1.2, linestyle=":", label="nominal")
    axes.plot(chart.time, chart.observed, color=SOLID, linewidth=1.5, label="observed")
    axes.set_xlabel("time, s", fontsize=points)
    axes.set_ylabel(chart.title, fontsize=points, parse_math=False)
    axes.tick_params(labelsize=points)
    axes.spines[["top", "right"]].set_visible(False)
    begin, end = chart.time[0], max(chart.time[-1], chart.time[0] + 1e-9)
    axes.set_xlim(begin, end)
    place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0, 1), "frameon": False}
    axes.legend(ncols=columns, fontsize=points, **place)
    now = axes.axvline(begin, color=GHOST, linewidth=1)
    veil = axes.axvspan(begin, end, color=PAPER, alpha=VEIL, linewidth=0, zorder=5)

    def step(frame: int) -> None:
        reached = min(float(shots.seconds[frame]), end)
        now.set_xdata([reached, reached])
        veil.set_bounds(reached, 0, end - reached, 1)

    return step
