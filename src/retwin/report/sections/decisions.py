"""Alarm thresholds: what a requested false-alarm rate costs in faults that are missed."""

from __future__ import annotations

import math
from typing import Any

from retwin.data.trajectories import HEALTHY
from retwin.report.blocks import Cell, Column, Section, Table
from retwin.report.labels import class_name, number, source_name, span
from retwin.report.study import Study
from retwin.scores.decisions import Decision, decide

__all__ = ["decisions"]

RATES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3)
"""The requested false-alarm rates."""
TRAJECTORIES, FAULTY, MISSED = 1000, 0.02, 50
"""The example: trajectories, share of faulty ones, cost of a missed fault in false alarms."""


def decisions(study: Study) -> Section | None:
    """A row per false-alarm rate for the source with the best macro-F1, and a calculator.

    A threshold belongs to one model, so these are the decisions of the model of the first run.
    """
    sources = [name for name in study.diagnosing if study.sources[name].real_data != "transductive"]
    best = max(sources, key=lambda name: study.sources[name].mean("macro_f1"), default=None)
    if best is None or HEALTHY not in study.results.classes:
        return None
    healthy = int((study.truth == study.results.classes.index(HEALTHY)).sum())
    if healthy in (0, len(study.truth)):
        return None
    found = [_decide(study, best, rate) for rate in RATES]
    short = [each.requested for each in found if math.isnan(each.threshold)]
    values = {
        "source": best,
        "healthy": healthy,
        "table": _table(found),
        "missed": MISSED,
        "lowest": short[-1] if short else None,
        "needed": math.ceil(1 / short[-1]) - 1 if short else 0,
    }
    scripts = {"calculator": _calculator(study, sources, best, healthy)}
    return Section("decisions", "Decisions", values, scripts=scripts)


def _decide(study: Study, source: str, rate: float) -> Decision:
    first = study.probabilities(source)[0]
    return decide(first, study.truth, study.results.classes, rate)


def _table(found: list[Decision]) -> Table:
    group = f"Of {TRAJECTORIES}, {FAULTY:.0%} faulty"
    columns = [
        Column("Requested false-alarm rate", numeric=False),
        Column("Alarm threshold"),
        Column("Its false alarms"),
        Column("Faults detected"),
        Column("Detected at the rate"),
        Column("of these, correct class"),
        Column("Most often missed", numeric=False),
        Column("Most often confused", numeric=False),
        Column("false alarms", group=group),
        Column("missed faults", group=group),
        Column(f"cost, 1 : {MISSED}", group=group),
    ]
    return Table("Cost of a false-alarm rate", columns, [_row(each) for each in found])


def _row(each: Decision) -> list[Cell]:
    requested = Cell(f"{each.requested:.0%}")
    if math.isnan(each.threshold):
        return [requested, *[Cell("–")] * 10]
    cost = each.cost(trajectories=TRAJECTORIES, faulty=FAULTY, missed=MISSED)
    return [
        requested,
        Cell(number(each.threshold)),
        Cell(span(each.false_alarms, 2)),
        Cell(number(each.detected, 2), f"[{span(each.interval, 2)}]"),
        Cell(span(each.at_rate, 2)),
        Cell(number(each.identified, 2)),
        Cell(class_name(each.most_missed) or "none"),
        Cell(" as ".join(map(class_name, each.most_confused)) or "none"),
        Cell(number(cost.false_alarms, 0)),
        Cell(number(cost.missed_faults, 1)),
        Cell(number(cost.total, 0)),
    ]


def _calculator(study: Study, sources: list[str], first: str, healthy: int) -> dict[str, Any]:
    """Every distinct decision of each source: there are as many as healthy trajectories."""
    rates = [rank / (healthy + 1) for rank in range(1, healthy + 1)]
    return {
        "healthy": healthy,
        "first": sources.index(first),
        "faulty": 100 * FAULTY,
        "missed": MISSED,
        "trajectories": TRAJECTORIES,
        "sources": [
            {
                "name": source_name(name),
                "decisions": [_entry(_decide(study, name, rate)) for rate in rates],
            }
            for name in sources
        ],
    }


def _entry(each: Decision) -> dict[str, Any]:
    """The numbers that costs are computed from, and the texts of the table's cells."""
    cells = _row(each)[1:8]
    return {
        "rate": each.guaranteed,
        "detected": each.detected,
        "texts": [f"{cell.text} {cell.below}".strip() for cell in cells],
    }
