"""What the source `dynamics` has learned, as curves over states and commands."""

from __future__ import annotations

import math

import numpy as np

from retwin.report.blocks import Cell, Section, Table, tabulate
from retwin.report.figures.figure import Axis, Band, Figure, Key, Line, Mark, Panel, Row, Spans
from retwin.report.figures.style import colour_of
from retwin.report.labels import number, places, shown_unit, signed
from retwin.report.study import Study

SOURCE = "dynamics"


def delta(study: Study, *, width: float = 1.6449) -> Section | None:
    """The difference of the corrected state equations from those of the twin as given.

    Parameters
    ----------
    width : float, default 1.6449
        Standard deviations of a central 90 % interval.

    """
    arrays = study.arrays
    if "delta/values" not in arrays:
        return None
    colour, panels = colour_of(SOURCE), []
    for i, (equation, variable, unit, slope) in enumerate(arrays["delta/about"].tolist()):
        x, y = (arrays[f"delta/{name}"][i].astype(float) for name in ("values", "discrepancy"))
        half = width * arrays["delta/deviation"][i]
        low, high = arrays["delta/range"][i].tolist()
        marks: list[Mark] = [
            Spans([(float(x[0]), low), (high, float(x[-1]))]),
            Band(x, y - half, y + half, "90 % band", colour, 0.25),
            Line(x[[0, -1]], np.zeros(2), "the twin as given", "muted", "dot", 1, hover=False),
            Line(x, y, "learned", colour, width=2),
        ]
        title = f"Equation of {equation}, over {variable}"
        along = Axis(variable, unit, (float(x[0]), float(x[-1])))
        row = Row(Axis(f"change of the rate of {equation}", slope), marks)
        panels.append(Panel(along, [row], f"Learned discrepancy: {title}", title, height=300))
    keys = [
        Key("learned", colour),
        Key("90 % band", colour, "bar"),
        Key("the twin as given", "muted", "dot"),
        Key("outside the range of the calibration", "grid", "bar"),
    ]
    figure = Figure("delta", panels, keys, SOURCE)
    values = {"figure": figure, "parameters": _parameters(study)}
    return Section("delta", "What was learned", values, [figure])


def _parameters(study: Study) -> Table | None:
    """The estimated parameters, with errors and the strongest correlation of each."""
    arrays = study.arrays
    if "delta/parameters" not in arrays:
        return None
    rows = []
    for (name, unit, other), estimates in zip(
        arrays["delta/parameters"].tolist(), arrays["delta/estimates"].tolist(), strict=True
    ):
        given, estimate, error, correlation = estimates
        known = math.isfinite(error)
        digits = places([error if known else estimate])
        strongest = f"{signed(correlation, 2)} with {other}" if math.isfinite(correlation) else "–"
        shown = number(estimate, digits) if known else "not determined"
        ends = number(given, places([given])), shown, number(error, digits), strongest
        rows.append([Cell(name, below=shown_unit(unit)), *ends])
    heads = "Parameter", "As given", "Estimate", "Standard error", "Strongest correlation"
    return tabulate("Parameters beside the discrepancy", heads, rows)
