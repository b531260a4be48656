"""The four uses as rows of text: the first screen of the page and of the terminal."""

from __future__ import annotations

from dataclasses import dataclass

from retwin.report.labels import behind, counted, number, percent, percents, quantity, source_name
from retwin.results import Figure, Results, Use
from retwin.scores.uses import COVERAGE, DETECTION, RATE

TITLES = {
    "simulate": "Simulate",
    "training": "Generate training data",
    "diagnose": "Diagnose",
    "monitor": "Monitor",
}
"""Heads of the rows."""
RULE = (
    "“Yes” and “no” need the whole 95 % interval within or outside the requirement; “likely” is a "
    "value within it. The best updated source on these runs is shown: expect a little less."
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


def use_rows(results: Results) -> list[UseRow]:
    """A row for each use of a study."""
    return [
        UseRow(
            TITLES[use.use],
            _state_requirement(use.use, classes=bool(results.classes)),
            use.answer,
            "on emulated data" if results.emulated and use.answer != "cannot say" else "",
            source_name(use.source) if use.source else "",
            _reached(use),
            _missing(use, faults=bool(results.classes)),
        )
        for use in results.uses
    ]


def _state_requirement(use: str, *, classes: bool) -> str:
    """What a use requires, of a study with or without classes."""
    error, bands = "a smaller error than the original twin's", f"90 % bands that hold {BANDS}"
    if not classes and use in ("training", "monitor"):
        return f"{error}, {bands}" if use == "training" else f"{bands}, and records with faults"
    rarely = f"at most {percent(RATE)} of healthy runs called faulty"
    return {
        "simulate": error,
        "training": "a better classifier than from the original twin's data",
        "diagnose": f"{rarely}, {percent(DETECTION)} of faulty ones named",
        "monitor": f"{rarely}, {percent(DETECTION)} of faulty ones found",
    }[use]


def _share(it: Figure) -> str:
    """A share with its interval, the original twin's beside; counts of runs that decide nothing."""
    if it.ends is None or it.ends[1] - it.ends[0] > WIDEST:
        share, plain = (f"{round(each * it.n)} of {it.n}" for each in (it.value, it.plain))
    else:
        share, plain = f"{percent(it.value)} ({percents(it.ends)})", percent(it.plain)
    return f"{share}; original twin {plain}" if it.plain == it.plain else share


BANDS = f"{100 * COVERAGE[0]:.0f} to {percent(COVERAGE[1])}"
"""The shares of samples that a 90 % band may hold."""
WIDEST = 0.3
"""The width of an interval of a share beyond which counts stand in its place."""


def _reached(use: Use) -> str:
    """One or two sentences with intervals, the original twin on the same runs beside."""
    found, texts = use.figures, []
    if "error" in found:
        error, ratio = found["error"], found["ratio"]
        factor, unit = (1.0, "σ") if error.unit == "σ" else quantity(error.unit)
        before, after = (behind(number(factor * v), unit) for v in (error.plain, error.value))
        known = ratio.ends is not None
        within = f" ({percents(ratio.ends)})" if known else ""
        texts.append(f"Error {before} → {after}: {percent(ratio.value)}{within} of the original.")
        if not known:
            texts.append(f"{counted(ratio.n, 'run')} cannot decide this.")
    if "macro_f1" in found:
        score = found["macro_f1"]
        texts.append(f"Macro-F1 {number(score.value, 2)}; original twin {number(score.plain, 2)}.")
        if score.value < score.plain:
            texts.append("The original twin is better.")
    if "coverage" in found:
        band = found["coverage"]
        texts.append(
            f"90 % bands contain {percent(band.value)} ({percents(band.ends)}) of samples."
        )
    for key, what in (
        ("called", "Healthy runs called faulty"),
        ("found", "Faulty runs found"),
        ("named", "Faults named"),
        ("detected", f"With at most {percent(RATE)} false alarms, for certain, faulty runs found"),
    ):
        if key in found and not (key == "named" and use.use == "training"):
            texts.append(f"{what}: {_share(found[key])}.")
    missing = use.missing
    few = next((found[k] for k in ("alarms", "called") if k in found), None)
    if few and missing and missing.what == "healthy" and missing.count:
        texts.append(
            f"{counted(few.n, 'healthy run')} are too few to show that at most {percent(RATE)} are "
            "called faulty."
        )
    joined = " ".join(texts) or "Not measured."
    return joined[:1].upper() + joined[1:]


def _missing(use: Use, *, faults: bool) -> str:
    it = use.missing
    if it is None:
        return "nothing"
    several = it.count or 0
    more = {
        "healthy": f"{several} more healthy run{'s' * (several != 1)}"
        if several
        else "healthy runs",
        "faulty": f"{several} more faulty run{'s' * (several != 1)}" if several else "faulty runs",
        "records": f"{several} more test record{'s' * (several != 1)}" if several else "records",
        "test": "more test runs",
        "runs": f"training it {several} times (give --runs)",
        "faults": "runs with known faults" if faults else "records with known faults",
        "updated": "an updated twin beside the original one",
        "correction": "another correction",
        "source": f"a source within {percent(RATE)} false calls and {percent(DETECTION)} of faults",
        "real": "the same on real measurements",
    }
    return more[it.what]
