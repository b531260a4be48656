"""When to raise an alarm: what a false-alarm rate that is asked for costs in faults not seen."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from retwin.report.blocks import Cell, Column, Prose, Section, Table
from retwin.report.plots import caption
from retwin.report.results import Results
from retwin.report.words import class_name, counted, in_sentence, number, order, source_name

__all__ = ["Decision", "decide", "decisions"]

HEALTHY = "Healthy"
RATES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3)
THOUSAND, BROKEN = 1000, 0.02
"""Of so many trajectories such a share is taken to be faulty, to tell costs."""


@dataclass(frozen=True)
class Decision:
    """An alarm is raised where the probability of a fault reaches `threshold`.

    Attributes
    ----------
    rate: of false alarms, as asked for; on average at most so many healthy ones are alarmed at.
    threshold: NaN where there are too few healthy trajectories to promise the rate.
    detected, interval: share of faulty trajectories alarmed at, with its 95 % interval (Clopper and
        Pearson).
    named: share of these whose fault is named rightly.
    missed: class that is missed most often; empty for none.
    confused: class and what it is taken for most often, among alarms; empty for none.

    """

    rate: float
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
        return Decision(rate, math.nan, math.nan, (math.nan, math.nan), math.nan, "", ())
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
        threshold,
        float(raised.sum() / faulty.sum()),
        (float(told.low), float(told.high)),
        float((answer == truth)[raised].mean()) if raised.any() else math.nan,
        classes[int(missed.argmax())] if missed.any() else "",
        (classes[worst[0]], classes[worst[1]]) if pairs.any() else (),
    )


def decisions(results: Results) -> Section | None:
    """A row per rate of false alarms, for the source that scores best."""
    source = _best(results)
    if source is None or HEALTHY not in results.classes:
        return None
    truth = results.truth
    healthy = int((truth == results.classes.index(HEALTHY)).sum())
    if healthy == 0 or healthy == len(truth):
        return None
    shares = results.probabilities(source).mean(axis=0)
    found = [decide(shares, truth, results.classes, rate) for rate in RATES]
    columns = [
        Column("False alarms asked for", numeric=False),
        Column("Alarm above"),
        Column("Faults detected"),
        Column("of these named rightly"),
        Column("Missed most", numeric=False),
        Column("Confused most", numeric=False),
        Column("false alarms", group=f"Of {THOUSAND}, {BROKEN:.0%} faulty"),
        Column("missed faults", group=f"Of {THOUSAND}, {BROKEN:.0%} faulty"),
    ]
    text = (
        f"Decisions with {in_sentence(source_name(source))}, probabilities averaged over runs. The "
        f"threshold comes from the {counted(healthy, 'healthy test trajectory')} alone (split "
        "conformal prediction): on average over such sets, at most the share asked for of further "
        "healthy trajectories is alarmed at. What is detected is counted on the faulty ones; in "
        "brackets its 95 % interval (Clopper and Pearson)."
    )
    few = [each for each in found if math.isnan(each.threshold)]
    blocks: list = [Table(caption(results, text), columns, [_row(each) for each in found])]
    if few:
        needed = math.ceil(1 / few[-1].rate) - 1
        blocks.append(
            Prose(
                f"A dash: {healthy} healthy trajectories cannot promise so low a rate; "
                f"{few[-1].rate:.0%} takes {needed} of them at least.",
                quiet=True,
            )
        )
    return Section("decisions", "Decisions", blocks)


def _row(each: Decision) -> list[Cell]:
    asked = Cell(f"{each.rate:.0%}")
    if math.isnan(each.threshold):
        return [asked, *[Cell("–")] * 7]
    low, high = each.interval
    confused = " for ".join(class_name(name) for name in each.confused)
    return [
        asked,
        Cell(number(each.threshold)),
        Cell(number(each.detected, 2), f"[{number(low, 2)} to {number(high, 2)}]"),
        Cell(number(each.named, 2)),
        Cell(class_name(each.missed) or "none"),
        Cell(confused or "none"),
        Cell(number(each.rate * THOUSAND * (1 - BROKEN), 0)),
        Cell(number((1 - each.detected) * THOUSAND * BROKEN, 1)),
    ]


def _best(results: Results) -> str | None:
    """The source with the best macro-F1 among those with probabilities, test outputs unseen."""
    usable = [
        name
        for name in order(list(results.sources))
        if results.probabilities(name).size
        and np.isfinite(results.probabilities(name)).all()
        and results.sources[name].real_data != "transductive"
    ]
    return max(usable, key=lambda name: results.sources[name].mean("macro_f1"), default=None)
