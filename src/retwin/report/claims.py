"""What is claimed of the updated twin, each claim with its light and the rule behind it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from retwin.catalog import METRICS
from retwin.report.results import Results
from retwin.report.verdict import between, headline, outcome
from retwin.report.words import duration, in_sentence, number, signed, source_name, span

__all__ = ["Claim", "claims"]

BAND = (0.85, 0.95)
RECALL = 0.9
SOON, LATE = 600.0, 3600.0
LIGHTS = {"better": "holds", "open": "open", "worse": "fails"}


@dataclass(frozen=True)
class Claim:
    """`light` is "holds", "open" or "fails"; `found` what was measured, `rule` when it is which."""

    title: str
    light: str
    found: str
    rule: str


def claims(results: Results) -> list[Claim]:
    """Of the updated twin against the plain one; what was not measured is not claimed."""
    pair = headline(results.comparisons)
    if pair is None:
        return []
    makers: tuple[Callable[[Results, tuple[str, str]], Claim | None], ...] = (
        _accuracy,
        _calibration,
        _false_alarms,
        _time,
    )
    return [claim for make in makers if (claim := make(results, pair)) is not None]


def _accuracy(results: Results, pair: tuple[str, str]) -> Claim | None:
    told = {each.metric: each for each in between(results.comparisons, *pair)}
    metric = next((name for name in METRICS if name in told), None)
    if metric is None:
        return None
    found = told[metric]
    light = LIGHTS.get(outcome(found))
    if light is None:
        return None
    name = METRICS[metric].title
    return Claim(
        "Accuracy",
        light,
        f"{name} {signed(found.mean_diff)} against {in_sentence(source_name(pair[1]))}, 95 % "
        f"interval {span(found.interval, sign=True)}",
        f"holds if the interval of the difference in {in_sentence(name)} is on the better side of "
        "zero, fails on the worse one",
    )


def _calibration(results: Results, pair: tuple[str, str]) -> Claim | None:
    told = results.fidelity.get(pair[0])
    figure = told.figures.get("coverage90") if told else None
    source = results.sources[pair[0]]
    value = figure.value if figure is not None else source.mean("coverage90")
    ends = figure.ends if figure is not None else source.interval("coverage90")
    if value is None or not math.isfinite(value):
        return None
    low, high = BAND
    reaches = ends is not None and ends[0] <= high and ends[1] >= low
    light = "holds" if low <= value <= high else "open" if reaches else "fails"
    return Claim(
        "Calibration",
        light,
        f"90 % bands hold {number(value, 2)} of the measured points{_within(ends)}",
        f"holds from {low:.2f} to {high:.2f}, open if the interval reaches there",
    )


def _false_alarms(results: Results, pair: tuple[str, str]) -> Claim | None:
    source = results.sources[pair[0]]
    recall, ends = source.mean("healthy_recall"), source.interval("healthy_recall")
    if not math.isfinite(recall):
        return None
    reaches = ends is not None and ends[1] >= RECALL
    light = "holds" if recall >= RECALL else "open" if reaches else "fails"
    return Claim(
        "False alarms",
        light,
        f"{number(recall, 2)} of the healthy trajectories are recognised{_within(ends)}",
        f"holds from {RECALL:.2f}, open if the interval reaches there",
    )


def _time(results: Results, pair: tuple[str, str]) -> Claim | None:
    source = results.sources[pair[0]]
    parts = [part for part in (source.update_s, source.generate_s) if part is not None]
    if not parts:
        return None
    whole = sum(parts)
    light = "holds" if whole <= SOON else "open" if whole <= LATE else "fails"
    made = f" and {source.generated} trajectories generated" if source.generated else ""
    return Claim(
        "Time",
        light,
        f"Updated{made} in {duration(whole)} on one core",
        f"holds up to {duration(SOON)}, fails beyond {duration(LATE)}",
    )


def _within(ends: tuple[float, float] | None) -> str:
    return "" if ends is None else f", 95 % interval {number(ends[0], 2)} to {number(ends[1], 2)}"
