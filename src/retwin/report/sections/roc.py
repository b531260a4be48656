"""ROC over runs, with the classes micro-averaged (the paper's figure 4)."""

from __future__ import annotations

import math

from retwin.report.blocks import Section
from retwin.report.figures.figure import Axis, Band, Figure, Key, Line, Mark, Panel, Row
from retwin.report.figures.style import colour_of, dash
from retwin.report.labels import MANY, mean_and_deviation, order, source_name, with_role
from retwin.report.study import Study
from retwin.scores.roc import micro_roc


def roc(study: Study) -> Section | None:
    """The mean ROC curves over runs, with one standard deviation around them."""
    sources = selected(study)
    if not sources:
        return None
    marks: list[Mark] = [Line([0, 1], [0, 1], "random classifier", "rule", width=1, hover=False)]
    keys = []
    for name in sources:
        curve = micro_roc(study.probabilities(name), study.truth)
        title, colour = source_name(name), colour_of(name)
        if len(curve.areas) > 1:
            marks.append(Band(curve.false_positive, *curve.band, f"{title} ± sd", colour, 0.18))
        marks.append(Line(curve.false_positive, curve.mean, title, colour, dash(name), 2.2))
        keys.append(
            Key(f"{title}: micro AUROC {mean_and_deviation(curve.areas)}", colour, dash(name))
        )
    x, y = (
        Axis(f"{kind} positive rate", limits=(-0.01, 1.01), kind="share", step=0.2)
        for kind in ("false", "true")
    )
    panel = Panel(x, [Row(y, marks)], "Micro-averaged ROC curves", height=460)
    figure = Figure("roc", [panel], keys, narrow=True)
    partial = set(sources) < set(study.diagnosing)
    return Section("roc", "ROC", {"figure": figure, "partial": partial}, [figure])


def selected(study: Study) -> list[str]:
    """All sources with probabilities; of many, the first, the updated ones and the best."""
    sources = study.diagnosing
    chosen = [name for name in sources if name in (*sources[:1], *with_role(sources, "updated"))]
    others = [name for name in sources if name not in chosen]
    areas = {name: study.sources[name].mean("auroc_micro") for name in others}
    best = sorted(others, key=lambda name: -areas[name] if math.isfinite(areas[name]) else 0.0)
    return order([*chosen, *best[: max(0, MANY + 1 - len(chosen))]])
