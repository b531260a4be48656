"""When to raise an alarm: what a false-alarm rate that is asked for costs in faults not seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from retwin.report.blocks import Block, Calculator, Cell, Column, Prose, Section, Table
from retwin.report.plots import caption
from retwin.report.results import Results
from retwin.report.words import class_name, counted, in_sentence, number, order, source_name

__all__ = ["Decision", "decide", "decisions"]

HEALTHY = "Healthy"
RATES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3)
THOUSAND, BROKEN = 1000, 0.02
"""Of so many trajectories such a share is taken to be faulty, to tell costs."""
MISSED = 50
"""False alarms that a missed fault is taken to cost as much as."""


@dataclass(frozen=True)
class Decision:
    """An alarm is raised where the probability of a fault reaches `threshold`.

    Attributes
    ----------
    rate: of false alarms, as asked for; on average at most so many healthy ones are alarmed at.
    kept: the rate that the threshold keeps to: the next one not above that so few healthy
        trajectories can tell apart.
    threshold: NaN where there are too few healthy trajectories to promise the rate.
    detected, interval: share of faulty trajectories alarmed at, with its 95 % interval (Clopper and
        Pearson).
    named: share of these whose fault is named rightly.
    missed: class that is missed most often; empty for none.
    confused: class and what it is taken for most often, among alarms; empty for none.

    """

    rate: float
    kept: float
    threshold: float
    detected: float
    interval: tuple[float, float]
    named: float
    missed: str
    confused: tuple[str, str] | tuple[()]


def decide(probabilities: NDArray, truth: NDArray, classes: list[str], rate: float) -> Decision:
    """The threshold for a rate of false alarms, and what it detects.

    The threshold comes from the healthy test trajectories alone, by split conformal prediction, so
    the rate holds for further healthy ones; what is detected is counted on the faulty ones.
    `probabilities` (n, classes), `truth` (n,) class indices.
    """
    healthy = classes.index(HEALTHY)
    alarm = 1 - probabilities[:, healthy]
    calm = np.sort(alarm[truth == healthy])
    rank = math.ceil((1 - rate) * (len(calm) + 1) - 1e-9)
    faulty = truth != healthy
    if rank > len(calm) or not faulty.any():
        return Decision(rate, 0.0, math.nan, math.nan, (math.nan, math.nan), math.nan, "", ())
    # Just above: a healthy trajectory like the one that sets the threshold is none to alarm at.
    threshold = float(calm[rank - 1]) if rank else -math.inf
    raised = faulty & (alarm > threshold)
    told = binomtest(int(raised.sum()), int(faulty.sum())).proportion_ci()
    others = np.delete(np.arange(len(classes)), healthy)
    answer = others[probabilities[:, others].argmax(axis=1)]
    missed = np.bincount(truth[faulty & ~raised], minlength=len(classes))
    wrong = raised & (answer != truth)
    pairs = np.bincount(truth[wrong] * len(classes) + answer[wrong], minlength=len(classes) ** 2)
    worst = divmod(int(pairs.argmax()), len(classes))
    return Decision(
        rate,
        1 - rank / (len(calm) + 1),
        threshold,
        float(raised.sum() / faulty.sum()),
        (float(told.low), float(told.high)),
        float((answer == truth)[raised].mean()) if raised.any() else math.nan,
        classes[int(missed.argmax())] if missed.any() else "",
        (classes[worst[0]], classes[worst[1]]) if pairs.any() else (),
    )


def decisions(results: Results) -> Section | None:
    """A row per rate of false alarms, for the source that scores best; and the reader's own."""
    source = _best(results)
    if source is None or HEALTHY not in results.classes:
        return None
    truth = results.truth
    healthy = int((truth == results.classes.index(HEALTHY)).sum())
    if healthy == 0 or healthy == len(truth):
        return None
    found = [_decided(results, source, rate) for rate in RATES]
    blocks: list[Block] = [_table(results, source, healthy, found)]
    few = [each for each in found if math.isnan(each.threshold)]
    if few:
        needed = math.ceil(1 / few[-1].rate) - 1
        blocks.append(
            Prose(
                f"A dash: {healthy} healthy trajectories cannot promise so low a rate; "
                f"{few[-1].rate:.0%} takes {needed} of them at least.",
                quiet=True,
            )
        )
    blocks.append(_calculator(results, source, healthy))
    return Section("decisions", "Decisions", blocks)


def _table(results: Results, source: str, healthy: int, found: Sequence[Decision]) -> Table:
    group = f"Of {THOUSAND}, {BROKEN:.0%} faulty"
    columns = [
        Column("False alarms asked for", numeric=False),
        Column("Alarm above"),
        Column("Faults detected"),
        Column("of these named rightly"),
        Column("Missed most", numeric=False),
        Column("Confused most", numeric=False),
        Column("false alarms", group=group),
        Column("missed faults", group=group),
        Column(f"cost, 1 : {MISSED}", group=group),
    ]
    text = (
        f"Decisions with {in_sentence(source_name(source))}, probabilities averaged over runs. The "
        f"threshold comes from the {counted(healthy, 'healthy test trajectory')} alone (split "
        "conformal prediction): on average over such sets, at most the share asked for of further "
        "healthy trajectories is alarmed at. What is detected is counted on the faulty ones; in "
        "brackets its 95 % interval (Clopper and Pearson). Cost counts a false alarm as 1 and a "
        f"missed fault as {MISSED}."
    )
    title = "What a rate of false alarms costs"
    return Table(title, caption(results, text), columns, [_row(each) for each in found])


def _calculator(results: Results, first: str, healthy: int) -> Calculator:
    """Every decision that so many healthy trajectories can tell apart, source by source.

    There are as many thresholds as healthy trajectories, so the page's script only looks up.
    """
    rates = [rank / (healthy + 1) for rank in range(1, healthy + 1)]
    sources = order([name for name in results.answered if _fair(results, name)])
    content = {
        "healthy": healthy,
        "first": sources.index(first),
        "broken": 100 * BROKEN,
        "missed": MISSED,
        "of": THOUSAND,
        "sources": [
            {
                "name": source_name(name),
                "decisions": [_told(_decided(results, name, rate)) for rate in rates],
            }
            for name in sources
        ],
    }
    text = (
        "Set the rate of false alarms you can live with, how rare faults are on your machine, and "
        "what a fault that is missed costs in false alarms. All rates up to the next that the "
        f"{counted(healthy, 'healthy test trajectory')} can tell apart have one threshold. "
        "The cheapest rate is chosen on this very test set, so its cost is a hopeful figure."
    )
    return Calculator("Your own rate and costs", caption(results, text), content)


def _decided(results: Results, source: str, rate: float) -> Decision:
    shares = results.probabilities(source).mean(axis=0)
    return decide(shares, results.truth, results.classes, rate)


def _told(each: Decision) -> dict[str, Any]:
    """What the page's script shows of a decision: words, and one number to reckon with."""
    cells = _row(each)
    return {
        "rate": each.kept,
        "detected": each.detected,
        "words": [f"{cell.text} {cell.below}".strip() for cell in cells[1:6]],
    }


def _row(each: Decision) -> list[Cell]:
    asked = Cell(f"{each.rate:.0%}")
    if math.isnan(each.threshold):
        return [asked, *[Cell("–")] * 8]
    low, high = each.interval
    alarms = each.kept * THOUSAND * (1 - BROKEN)
    missed = (1 - each.detected) * THOUSAND * BROKEN
    confused = " for ".join(class_name(name) for name in each.confused)
    return [
        asked,
        Cell(number(each.threshold)),
        Cell(number(each.detected, 2), f"[{number(low, 2)} to {number(high, 2)}]"),
        Cell(number(each.named, 2)),
        Cell(class_name(each.missed) or "none"),
        Cell(confused or "none"),
        Cell(number(alarms, 0)),
        Cell(number(missed, 1)),
        Cell(number(alarms + MISSED * missed, 0)),
    ]


def _best(results: Results) -> str | None:
    """The source with the best macro-F1 among those with probabilities, test outputs unseen."""
    usable = [name for name in order(results.answered) if _fair(results, name)]
    return max(usable, key=lambda name: results.sources[name].mean("macro_f1"), default=None)


def _fair(results: Results, source: str) -> bool:
    return results.sources[source].real_data != "transductive"
