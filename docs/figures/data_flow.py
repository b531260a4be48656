"""The picture of docs/architecture.md: what goes where, from files to the report.

    python docs/figures/data_flow.py

Writes docs/images/data-flow.png.
"""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch
from style import BLUE, GREEN, INK, MUTED, ORANGE, blank, save

WIDTH, HEIGHT = 1.7, 0.62
THINGS = {
    "files": ("files", -0.2, 1.5, MUTED),
    "twin": ("Trajectories\ntwin data", 2.9, 3.0, MUTED),
    "real": ("Trajectories\ncalibration", 2.9, 1.5, MUTED),
    "test": ("Trajectories\ntest", 2.9, 0.0, ORANGE),
    "ibg": ("Surrogate\n(IBG)", 5.8, 3.0, BLUE),
    "rg": ("ResidualModel\n(RG)", 5.8, 1.5, BLUE),
    "updated": ("CorrectedTwin", 8.7, 2.25, BLUE),
    "made": ("Trajectories\nlabelled", 11.6, 2.25, MUTED),
    "diagnoser": ("Diagnoser", 11.6, 0.75, GREEN),
    "scores": ("results.json\nreport.html", 8.7, 0.0, GREEN),
}
ARROWS = (
    ("files", "twin", ""),
    ("files", "real", "load, split"),
    ("files", "test", ""),
    ("twin", "ibg", "fit_surrogate"),
    ("real", "rg", "infer z*,\nfit_residual"),
    ("ibg", "rg", ""),
    ("ibg", "updated", ""),
    ("rg", "updated", ""),
    ("updated", "made", "generate"),
    ("made", "diagnoser", "fit_diagnoser"),
    ("diagnoser", "scores", ""),
    ("test", "scores", "evaluate"),
)


def main() -> None:
    """Draw it."""
    figure = blank(9.6, 3.1)
    axes = figure.subplots()
    axes.set_axis_off()
    axes.set_xlim(-1.2, 12.6)
    axes.set_ylim(-0.5, 3.5)
    for text, x, y, colour in THINGS.values():
        box(axes, text, x, y, colour)
    for begin, end, text in ARROWS:
        arrow(axes, begin, end, text)
    save("data-flow", figure, "The test part (orange) meets nothing but the fitted diagnoser")


def box(axes: Axes, text: str, x: float, y: float, colour: str) -> None:
    """A thing, its name inside."""
    corner = (x - WIDTH / 2, y - HEIGHT / 2)
    shape = FancyBboxPatch(
        corner, WIDTH, HEIGHT, boxstyle="round,pad=0.06", facecolor="white", edgecolor=colour
    )
    axes.add_patch(shape)
    axes.text(x, y, text, ha="center", va="center", fontsize=8.5, color=INK)


def arrow(axes: Axes, begin: str, end: str, text: str) -> None:
    """From the side of one thing to the side of another, the verb above."""
    (_, x0, y0, _), (_, x1, y1, _) = THINGS[begin], THINGS[end]
    across = abs(x1 - x0) > WIDTH
    away = (WIDTH / 2 + 0.1) if across else (HEIGHT / 2 + 0.1)
    sign = 1 if (x1 > x0 if across else y1 > y0) else -1
    first = (x0 + sign * away, y0) if across else (x0, y0 + sign * away)
    last = (x1 - sign * away, y1) if across else (x1, y1 - sign * away)
    look = {"arrowstyle": "-|>", "color": MUTED, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", last, first, arrowprops=look)
    x, y = (first[0] + last[0]) / 2, (first[1] + last[1]) / 2
    style = {"fontsize": 7.5, "color": MUTED}
    if across:
        axes.text(x, y + 0.06, text, ha="center", va="bottom", **style)
    else:
        axes.text(x + 0.08, y, text, ha="left", va="center", **style)


if __name__ == "__main__":
    main()
