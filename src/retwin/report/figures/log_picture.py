"""A log as a picture: its signals, what of them is in trajectories, and what is missing there."""

from __future__ import annotations

import numpy as np

from retwin.arrays import runs
from retwin.data.logs.mapped import Parts
from retwin.data.logs.signals import Log
from retwin.report.figures.figure import Axis, Figure, Key, Line, Mark, Panel, Row, Spans
from retwin.report.figures.png import png
from retwin.report.labels import counted

COMMAND, OUTPUT = "c1", "c0"
KEYS = (
    Key("value of the log", "observed"),
    Key("command of a trajectory", COMMAND),
    Key("output of a trajectory", OUTPUT),
    Key("missing samples", "stop", "bar"),
)


def log_picture(log: Log, tried: Parts | str, *, max_rows: int = 16) -> bytes:
    """The signals of a log as PNG, above each other, with the trajectories that a mapping makes.

    Trajectories are shaded, and their samples are drawn over the values of the log. Samples that
    are missing are marked in red below the signal.

    Parameters
    ----------
    log : Log
        The signals.
    tried : Parts or str
        The trajectories; or why there are none, and the first signals are drawn alone.
    max_rows : int, default 16
        Signals that are drawn at most.

    """
    if isinstance(tried, str):
        title = f"signals alone; {tried}"
        names = list(log.signals)
        marks: list[list[Mark]] = [
            [Line(each.times, each.values, each.name, OUTPUT, width=1.1)]
            for each in list(log.signals.values())[:max_rows]
        ]
    else:
        title = f"{counted(len(tried.blocks), 'trajectory')} at {tried.rate:g} Hz"
        names = [f"{each.name} [{each.unit}]" for each in tried.every]
        marks = [_marks(tried, column) for column in range(min(len(names), max_rows))]
    if len(names) > max_rows:
        title += f"; {len(names) - max_rows} more signals are not drawn"
    limits = (-0.02 * log.end, max(1.02 * log.end, 1e-9))
    last = Axis("time since the first value of the log", "s", limits)
    panels = [
        # Names above the lines and not beside them, since they are long.
        Panel(
            last if place == len(marks) - 1 else Axis("", "", limits, bare=True),
            [Row(Axis("", count=3), row)],
            name,
            name,
            height=125,
        )
        for place, (name, row) in enumerate(zip(names, marks, strict=False))
    ]
    title = f"{log.name}: {title}"
    title = title if len(title) < 100 else title[:99] + "…"
    keys = () if isinstance(tried, str) else KEYS
    return png(Figure("log", panels, keys, columns=1, title=title), emulated=False)


def _marks(parts: Parts, column: int) -> list[Mark]:
    """The values of a channel, and what trajectories have of them."""
    channel, colour = parts.every[column], COMMAND if column < len(parts.commands) else OUTPUT
    known = np.isfinite(channel.signal.values)
    times, values = channel.signal.times[known], channel.signal.values[known]
    pauses = np.flatnonzero(np.diff(times) > channel.longest) + 1  # no line leads over them
    x, y = np.insert(times, pauses, times[pauses - 1]), np.insert(values, pauses, np.nan)
    marks: list[Mark] = [Line(x, y, "value of the log", "observed", width=1, alpha=0.7)]
    for start, block in parts.blocks:
        grid = start + np.arange(len(block)) / parts.rate
        holes = runs(~np.isfinite(block[:, column])) - [0, 1]
        missing = [(float(grid[first]), float(grid[end])) for first, end in holes]
        marks += [
            Spans([(float(grid[0]), float(grid[-1]))], colour, alpha=0.07, outline=0.6),
            Line(grid, block[:, column], "trajectory", colour, width=1.4),
            Spans(missing, "stop", height=0.08, outline=0.8),
        ]
    return marks
