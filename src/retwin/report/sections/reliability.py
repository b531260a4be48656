"""Reliability diagrams: the share of correct diagnoses by their confidence."""

from __future__ import annotations

from typing import Any

import numpy as np

from retwin.report.blocks import Section
from retwin.report.figures.figure import Axis, Figure, Key, Line, Mark, Panel, Points, Row
from retwin.report.figures.style import colour_of, symbol
from retwin.report.labels import source_name
from retwin.report.sections.roc import selected
from retwin.report.study import Study
from retwin.scores import calibration


def reliability(study: Study) -> Section | None:
    """A diagram for each of the selected sources."""
    sources = selected(study)
    if not sources:
        return None
    keys = [
        Key("diagnoses, in the colour of their source", "ink", "circle"),
        Key("90 % range of perfectly calibrated classifiers", "observed", "bar"),
        Key("perfect calibration", "muted", "dot"),
    ]
    figure = Figure("reliability", [_panel(study, name) for name in sources], keys)
    errors = [
        (study.sources[name].runs("ece"), calibration.calibration_floor(study.probabilities(name)))
        for name in sources
    ]
    values = {"figure": figure, "errors": errors}
    return Section("reliability", "Reliability", values, [figure])


def _panel(study: Study, source: str) -> Panel:
    found = calibration.reliability(study.probabilities(source), study.truth)
    title, colour = source_name(source), colour_of(source)
    breaks = np.full(len(found.confidence), np.nan)
    x, y = np.repeat(found.confidence, 3), np.stack([found.low, found.high, breaks], axis=1).ravel()
    perfect: Any = {"width": 7, "alpha": 0.35, "hover": False}
    share: dict[str, Any] = {"limits": (-0.03, 1.05), "kind": "share", "step": 0.2}
    marks: list[Mark] = [
        Line([0, 1], [0, 1], "perfect calibration", "muted", "dot", width=1, hover=False),
        Line(x, y, "perfectly calibrated", colour, **perfect),
        Points(found.confidence, found.accuracy, title, colour, symbol(source)),
    ]
    row = Row(Axis("share of correct diagnoses", **share), marks)
    alt = f"{title}: share of correct diagnoses against their confidence"
    return Panel(Axis("confidence", **share), [row], alt, title, height=300)
