"""Pictures of what goes into a step and what comes out, for pages on data, simulators and bundles.

    python docs/figures/flows.py

Writes docs/images/flow-*.png.
"""

from __future__ import annotations

from itertools import pairwise

from data_flow import box
from matplotlib.axes import Axes
from style import BLUE, GREEN, MUTED, ORANGE, blank, save

STEP, ROW = 3.4, 1.15
"""Distances of boxes, in the units of the drawing."""
Columns = tuple[tuple[tuple[str, str], ...], ...]
FLOWS: dict[str, tuple[str, Columns] | tuple[str, Columns, tuple[tuple[int, int, int], ...]]] = {
    "flow-own-data": (
        "From a log to a set",
        (
            (("CSV, MAT, NPZ\nof the machine", MUTED),),
            (("Trajectories\nnamed, in units", BLUE),),
            (("calibration", BLUE), ("test", ORANGE)),
        ),
    ),
    "flow-own-simulator": (
        "Every simulator becomes a Twin, and every Twin goes through the same functions",
        (
            (("Python function", MUTED), ("state equations", MUTED), ("MuJoCo, FMU", MUTED)),
            (("Twin", BLUE),),
            (("generate", GREEN), ("identify", GREEN), ("fit_surrogate", GREEN)),
        ),
    ),
    "flow-bundle": (
        "A bundle holds what was fitted, and runs elsewhere",
        (
            (("CorrectedTwin", MUTED), ("Diagnoser", MUTED), ("healthy data", MUTED)),
            (("Bundle\nwith a guard", BLUE),),
            (
                ("generate", GREEN),
                ("predict,\nor refuse", GREEN),
                ("ONNX graphs,\nno torch", GREEN),
            ),
        ),
    ),
    "flow-fmu-export": (
        "An updated twin goes back into the simulation tools of its users",
        (
            (("StateTwin", MUTED), ("DynamicsTwin", MUTED), ("CorrectedTwin", MUTED)),
            (("FMU\nC source inside", BLUE),),
            (("Simulink", GREEN), ("OpenModelica", GREEN), ("any FMI tool", GREEN)),
        ),
    ),
    "flow-scale": (
        "Any number of trajectories, in chunks that are made once",
        (
            (("twin, sampler,\nfaults, seed", MUTED),),
            (("chunk 0", BLUE), ("chunk 1", BLUE), ("chunk 2 …", BLUE)),
            (("one Zarr folder", GREEN),),
        ),
    ),
    "flow-identify": (
        "Part of the measurements is held out, so that the result can be judged",
        (
            (("twin with free\nparameters", MUTED), ("logs", MUTED)),
            (("identify", BLUE), ("held out", ORANGE)),
            (("report.html", GREEN), ("updated twin,\ncalibrated FMU", GREEN)),
        ),
        ((0, 0, 0), (0, 1, 0), (0, 1, 1), (1, 0, 0), (1, 1, 0), (1, 0, 1)),
    ),
    "flow-actuator": (
        "What the actuators execute, learned from outputs, for training of robots",
        (
            (("CorrectedTwin", MUTED), ("commands of\nthe task", MUTED)),
            (("export_actuator", BLUE),),
            (("actuator.pt", GREEN), ("actuator.onnx", GREEN)),
            (("simulation of\nmany robots", MUTED),),
        ),
    ),
}
"""Name to its caption, its columns of boxes from left to right, each with its colour, and its lines
(column, row, row in the next one); by default all."""


def main() -> None:
    """Draw all of them."""
    for name, (caption, columns, *lines) in FLOWS.items():
        rows = max(map(len, columns))
        figure = blank(7.4, 0.72 * rows + 0.5)
        axes = figure.subplots()
        axes.set_axis_off()
        axes.set_xlim(-1.2, STEP * (len(columns) - 1) + 1.2)
        axes.set_ylim(-ROW * (rows - 1) / 2 - 0.55, ROW * (rows - 1) / 2 + 0.55)
        for place, (left, right) in enumerate(pairwise(columns)):
            for i, begin in enumerate(heights(left)):
                for j, end in enumerate(heights(right)):
                    if not lines or (place, i, j) in lines[0]:
                        line(axes, (STEP * place, begin), (STEP * (place + 1), end))
        for place, column in enumerate(columns):
            for (text, colour), height in zip(column, heights(column), strict=True):
                box(axes, text, STEP * place, height, colour)
        save(name, figure, caption)


def heights(column: tuple[tuple[str, str], ...]) -> list[float]:
    """The heights of the boxes of a column, about its middle."""
    return [ROW * ((len(column) - 1) / 2 - place) for place in range(len(column))]


def line(axes: Axes, begin: tuple[float, float], end: tuple[float, float]) -> None:
    """An arrow from the right side of one box to the left side of another."""
    look = {"arrowstyle": "-|>", "color": MUTED, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (end[0] - 0.97, end[1]), (begin[0] + 0.97, begin[1]), arrowprops=look)


if __name__ == "__main__":
    main()
