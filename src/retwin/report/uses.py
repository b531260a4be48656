"""The four uses as rows of text: the first screen of the page and of the terminal."""

from __future__ import annotations

from dataclasses import dataclass

from retwin.report.assets import sentences
from retwin.report.labels import source_name
from retwin.results import Results
from retwin.scores.uses import COVERAGE, DETECTION, RATE

TITLES = {
    "simulate": "Simulate",
    "training": "Generate training data",
    "diagnose": "Diagnose",
    "monitor": "Monitor",
}
"""Heads of the rows."""
RULE = (
    "“Yes” and “no”: the whole 95 % interval is within or outside the requirement, from enough "
    "records and trainings. “Likely”: the value is within it. “Cannot say”: it is outside and its "
    "interval is not, nothing was measured, or no outcome of so few runs could show it. The best "
    "source on these runs is shown, which makes it look a little better than it is."
)
"""The one rule, as a sentence."""


@dataclass(frozen=True)
class UseRow:
    """A row: the use, what it requires, its answer and where that holds ("" on real measurements),
    its best source ("" without one), what it reaches and lacks.
    """

    title: str
    required: str
    answer: str
    scope: str
    source: str
    reached: str
    missing: str


def use_rows(results: Results, *, widest: float = 0.3) -> list[UseRow]:
    """A row for each use of a study.

    Parameters
    ----------
    widest : float, default 0.3
        The width of an interval of a share beyond which counts stand in its place.

    """
    limits = {"rate": RATE, "detection": DETECTION, "coverage": COVERAGE, "widest": widest}
    limits |= {"classes": bool(results.classes), "emulated": results.emulated}
    rows = []
    for use in results.uses:
        texts = sentences("uses", use=use, **limits)
        emulated = results.emulated and use.answer != "cannot say"
        scope = "on emulated data" if emulated else ""
        source = source_name(use.source) if use.source else ""
        required, reached, missing = texts
        rows.append(UseRow(TITLES[use.use], required, use.answer, scope, source, reached, missing))
    return rows
