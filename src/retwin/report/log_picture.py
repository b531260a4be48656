"""A log as a picture: its signals, what of them is in trajectories, and what is missing there."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from retwin.arrays import runs
from retwin.data.logs.mapped import Parts
from retwin.data.logs.signals import Log
from retwin.report.png import blank, dress
from retwin.report.style import PALETTE, hexadecimal

MAX_ROWS = 16
"""Signals that are drawn at most."""
POINTS = 3000
"""Points of a line from which it is drawn by the extremes of its parts."""
COMMAND, OUTPUT = PALETTE[1][0], PALETTE[0][0]


@rc_context({"text.parse_math": False})  # a name with $ is no formula
def log_picture(log: Log, tried: Parts | str) -> bytes:
    """The signals of a log as PNG, above each other, with the trajectories that a mapping makes.

    Trajectories are shaded, and their samples are drawn over the values of the log. Samples that
    are missing are marked in red below the signal.

    Parameters
    ----------
    log : Log
        The signals.
    tried : Parts or str
        The trajectories; or why there are none, and the first signals are drawn alone.

    """
    parts, reason = (None, tried) if isinstance(tried, str) else (tried, "")
    rows: list[tuple[str, str, int | None]] = []
    if parts is not None:
        kinds = [COMMAND] * len(parts.commands) + [OUTPUT] * (
            len(parts.every) - len(parts.commands)
        )
        names = [f"{each.name} [{each.unit}]" for each in parts.every]
        rows = [(name, kind, i) for i, (name, kind) in enumerate(zip(names, kinds, strict=True))]
    else:
        rows = [(name, OUTPUT, None) for name in log.signals]
    left, rows = len(rows) - MAX_ROWS, rows[:MAX_ROWS]
    canvas = blank(11, 1.2 + 1.1 * len(rows))
    every = np.atleast_1d(canvas.subplots(len(rows), 1, sharex=True))
    names = list(log.signals)
    for place, (axes, (title, colour, column)) in enumerate(zip(every, rows, strict=True)):
        dress(axes, "", "")
        # Above the line and not beside it: names of signals are long.
        axes.set_title(title, loc="left", fontsize=9, color=hexadecimal("ink"), pad=3)
        if parts is None or column is None:
            signal = log.signals[names[place]]
            axes.plot(*_thinned(signal.times, signal.values), color=colour, linewidth=0.9)
        else:
            _row(axes, parts, column, colour)
    every[-1].set_xlabel("time since the first value of the log, s", color=hexadecimal("muted"))
    _legend(canvas, every[0], parts, log, reason, left)
    canvas.set_dpi(110)
    drawn = FigureCanvasAgg(canvas)
    file = io.BytesIO()
    drawn.print_png(file, metadata={"Software": None})
    return file.getvalue()


def _row(axes: Axes, parts: Parts, column: int, colour: str) -> None:
    channel = parts.every[column]
    known = np.isfinite(channel.signal.values)
    times, values = channel.signal.times[known], channel.signal.values[known]
    pauses = np.flatnonzero(np.diff(times) > channel.longest)  # no line leads over them
    axes.plot(
        *_thinned(
            np.insert(times, pauses + 1, times[pauses]), np.insert(values, pauses + 1, np.nan)
        ),
        color=hexadecimal("observed"),
        linewidth=0.8,
        alpha=0.7,
    )
    ends = []
    for start, block in parts.blocks:
        grid = start + np.arange(len(block)) / parts.rate
        axes.axvspan(grid[0], grid[-1], color=colour, alpha=0.07, linewidth=0)
        ends += [grid[0], grid[-1]]
        axes.plot(*_thinned(grid, block[:, column]), color=colour, linewidth=1.1)
        for first, last in runs(~np.isfinite(block[:, column])) - [0, 1]:
            axes.axvspan(grid[first], grid[last], 0, 0.06, color=hexadecimal("stop"), linewidth=0.8)
    for each in ends[:400]:
        axes.axvline(each, color=colour, linewidth=0.6, alpha=0.5)


def _thinned(times: NDArray, values: NDArray) -> tuple[NDArray, NDArray]:
    """A line of at most some thousand points, which keeps the extremes."""
    if len(times) <= POINTS:
        return times, values
    parts = np.array_split(np.arange(len(times)), POINTS // 2)
    kept: list[int] = []
    for part in parts:
        own = values[part]
        missing = ~np.isfinite(own)
        ends = part[missing][:1].tolist()  # a hole stays one
        if not missing.all():
            ends += [int(part[np.nanargmin(own)]), int(part[np.nanargmax(own)])]
        kept += sorted(set(ends))
    return times[kept], values[kept]


def _legend(
    canvas: object, axes: Axes, parts: Parts | None, log: Log, reason: str, left: int
) -> None:
    title = f"{log.name}: "
    handles: Sequence[Line2D | Patch] = ()
    if parts is None:
        title += f"signals alone; {reason}"
    else:
        count = len(parts.blocks)
        title += f"{count} {'trajectory' if count == 1 else 'trajectories'} at {parts.rate:g} Hz"
        handles = [
            Line2D([], [], color=hexadecimal("observed"), label="value of the log"),
            Line2D([], [], color=COMMAND, label="command of a trajectory"),
            Line2D([], [], color=OUTPUT, label="output of a trajectory"),
            Patch(color=hexadecimal("stop"), label="missing samples"),
        ]
    if left > 0:
        title += f"; {left} more signals are not drawn"
    canvas.suptitle(title if len(title) < 160 else title[:159] + "…", fontsize=10)  # type: ignore[attr-defined]
    if handles:
        axes.legend(
            handles=handles,
            loc="lower right",
            bbox_to_anchor=(1.0, 1.02),
            ncols=4,
            fontsize=8,
            frameon=False,
        )
