"""Alarm thresholds: what a requested false-alarm rate costs in faults that are missed."""

from __future__ import annotations

import math
from typing import Any

from retwin.data.trajectories import HEALTHY
from retwin.report.blocks import Cell, Section, Table, grouped, tabulate, text_column
from retwin.report.labels import class_name, distinct, number, percent, percents, source_name
from retwin.report.study import Study
from retwin.report.verdict import headline
from retwin.scores.decisions import Decision, certain_decision
from retwin.scores.uses import RATE

RATES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3)
"""False-alarm rates that the page shows."""
TRAJECTORIES, FAULTY, MISSED = 1000, 0.02, 50
"""The example: trajectories, share of faulty ones, cost of a missed fault in false alarms."""
DETECTED = ("Faults detected", "Detected at the rate", "of these, correct class")
COST = grouped(f"Of {TRAJECTORIES}, {100 * FAULTY:.0f} % faulty", f"cost, 1 : {MISSED}")
"""Heads of columns of both tables."""


def _alarms(study: Study, source: str) -> tuple[float, Decision] | None:
    """The rate that the page chooses, and the decision at it of the model of the first run.

    NaN if the healthy trajectories promise none of `RATES`; None without probabilities of them.
    """
    classes = study.results.classes
    if source not in study.diagnosing or HEALTHY not in classes:
        return None
    if study.healthy.all() or not study.healthy.any():
        return None
    first = study.probabilities(source)[0]
    for rate in (each for each in RATES if each >= RATE):
        safe = certain_decision(first, study.truth, classes, rate)
        found = safe or study.decision(source, rate)
        if math.isfinite(found.threshold):
            return rate, found
    return math.nan, study.decision(source, RATES[-1])


def decisions(study: Study) -> Section | None:
    """All sources at one rate, one source at all rates, and a calculator.

    The rate and the source are those of the first page; without its source there, it is the one
    with the best macro-F1.

    A threshold belongs to one model, so these are the decisions of the model of the first run.
    """
    sources = [name for name in study.diagnosing if study.sources[name].real_data != "transductive"]
    pair = headline(study.results)
    best = max(sources, key=lambda name: study.sources[name].mean("macro_f1"), default=None)
    best = pair[0] if pair is not None and pair[0] in sources else best
    chosen = None if best is None else _alarms(study, best)
    if best is None or chosen is None:
        return None
    found = [study.decision(best, rate) for rate in RATES]
    short = [each.requested for each in found if math.isnan(each.threshold)]
    healthy, (rate, decision) = int(study.healthy.sum()), chosen
    rate = decision.guaranteed if math.isfinite(rate) else rate
    values = {
        "source": best,
        "healthy": healthy,
        "rate": rate,
        "chosen": decision,
        "all": None if math.isnan(rate) else _all_sources(study, sources, rate),
        "table": _table(best, [each for each in found if math.isfinite(each.threshold)]),
        "missed": MISSED,
        "lowest": short[-1] if short else None,
        "needed": math.ceil(1 / short[-1]) - 1 if short else 0,
    }
    scripts = {"calculator": _calculator(study, sources, best, healthy) | {"rate": 100 * rate}}
    return Section("decisions", "Decisions", values, scripts=scripts)


def _all_sources(study: Study, sources: list[str], rate: float) -> Table:
    """A row per source at the same false-alarm rate."""
    heads = ["Source", *DETECTED, *map(text_column, ("Most often missed", "Most often confused"))]
    rows = []
    for name in sources:
        each = study.decision(name, rate)
        cells = *_detected(each), *_errors(each), _cost(each)
        rows.append([Cell(source_name(name), source=name), *cells])
    return tabulate("All sources at the same false-alarm rate", [*heads, *COST], rows)


def _table(source: str, found: list[Decision]) -> Table:
    """A row per false-alarm rate."""
    heads = ["Requested false-alarm rate", "Alarm threshold", "Its false alarms", *DETECTED, *COST]
    digits = distinct(each.threshold for each in found)
    title = f"Cost of a false-alarm rate, {source_name(source)}"
    rows = [
        [
            percent(each.requested),
            number(each.threshold, digits),
            percents(each.false_alarms),
            *_detected(each),
            _cost(each),
        ]
        for each in found
    ]
    return tabulate(title, heads, rows)


def _detected(each: Decision) -> list[object]:
    """The cells of `DETECTED`."""
    shown = Cell(percent(each.detected), f"[{percents(each.interval)}]")
    return [shown, percents(each.at_rate), percent(each.identified)]


def _errors(each: Decision) -> list[str]:
    """The fault that is most often missed, and the diagnosis that is most often wrong."""
    errors = class_name(each.most_missed), " as ".join(map(class_name, each.most_confused))
    return [error or "none" for error in errors]


def _cost(each: Decision) -> str:
    """The cell of `COST`."""
    return number(each.cost(trajectories=TRAJECTORIES, faulty=FAULTY, missed=MISSED).total, 0)


def _calculator(study: Study, sources: list[str], first: str, healthy: int) -> dict[str, Any]:
    """Every distinct decision of each source: there are as many as healthy trajectories."""
    rates = [rank / (healthy + 1) for rank in range(1, healthy + 1)]
    decided = {name: [study.decision(name, rate) for rate in rates] for name in sources}
    return {
        "healthy": healthy,
        "first": sources.index(first),
        "faulty": 100 * FAULTY,
        "missed": MISSED,
        "trajectories": TRAJECTORIES,
        "sources": [
            {
                "name": source_name(name),
                "decisions": [_entry(each, distinct(e.threshold for e in found)) for each in found],
            }
            for name, found in decided.items()
        ],
    }


def _entry(each: Decision, digits: int) -> dict[str, Any]:
    """The numbers that costs are computed from, and the texts of the table's cells."""
    threshold = number(each.threshold, digits)
    row = [threshold, percents(each.false_alarms), *_detected(each), *_errors(each)]
    (cells,) = tabulate("", [], [row]).rows
    return {
        "rate": each.guaranteed,
        "detected": each.detected,
        "texts": [f"{cell.text} {cell.below}".strip() for cell in cells],
    }
