"""Stick figures: the skeleton drawn with matplotlib, where MuJoCo cannot draw."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.cases.animation.shots import GHOST, PAPER, RING, SOLID, UPDATED, Shots, rings

DPI = 100
"""Pixels per inch, by which matplotlib converts sizes."""


def stick_pictures(shots: Shots, size: tuple[int, int]) -> Iterator[NDArray]:
    """Draw the two skeletons, the paths of their tips, and the draws of an updated twin.

    Parameters
    ----------
    shots : Shots
        The frames.
    size : (int, int)
        Width and height in pixels.

    Yields
    ------
    ndarray of uint8, shape (height, width, 3)
        One picture per frame.

    """
    # Without pyplot, which would use a window system and global state.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(size[0] / DPI, size[1] / DPI), dpi=DPI, facecolor=PAPER)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes(
        (0, 0.04, 1, 0.96), projection="3d", facecolor=PAPER, computed_zorder=False
    )
    _stage(axes, shots)
    unit = min(size) / 480
    drawn: list[tuple[NDArray, Any, Any]] = []
    for place, (points, colour, alpha, thick) in enumerate(
        ((shots.nominal_points, GHOST, 0.55, 5.0), (shots.observed_points, SOLID, 1.0, 4.0))
    ):
        (trace,) = axes.plot([], [], [], color=colour, linewidth=1.2 * unit, zorder=2 + place)
        (chain,) = axes.plot(
            [], [], [], color=colour, alpha=alpha, linewidth=thick * unit, zorder=4 + place
        )
        chain.set(marker="o", markersize=1.7 * thick * unit, solid_capstyle="round")
        drawn.append((points, trace, chain))
    trails: list[Any] = [
        axes.plot([], [], [], color=UPDATED, linewidth=0.8 * unit, alpha=0.6, zorder=3)[0]
        for _ in shots.drawn
    ]
    tips: Any
    (tips,) = axes.plot([], [], [], color=UPDATED, marker="o", linestyle="", zorder=6)
    tips.set_markersize(3.5 * unit)
    for i in range(len(shots)):
        for trail, path in zip(trails, shots.trails(i), strict=True):
            trail.set_data_3d(*path.T)
        if trails:
            tips.set_data_3d(*shots.drawn[:, i].T)
        for points, trace, chain in drawn:
            trace.set_data_3d(*points[: i + 1, -1].T)
            chain.set_data_3d(*points[i].T)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _stage(axes: Any, shots: Shots) -> None:
    """Show the whole workspace from slightly above, on a light floor."""
    root, reach = shots.root, shots.reach
    axes.set(
        xlim=(root[0] - reach, root[0] + reach),
        ylim=(root[1] - reach, root[1] + reach),
        zlim=(root[2], root[2] + reach),
    )
    axes.set_box_aspect((2, 2, 1), zoom=1.5)
    axes.view_init(elev=18, azim=-50)
    axes.set_axis_off()
    for ring in rings(root, reach):
        axes.plot(*ring.T, color=RING, linewidth=1, zorder=1, clip_on=False)
