"""What may be said: which source is better, and the sentences at the top of the page."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from retwin.catalog import METRICS
from retwin.report.parts import Comparison
from retwin.report.results import Results
from retwin.report.words import (
    MAIN,
    counted,
    in_sentence,
    number,
    signed,
    source_name,
    span,
)

__all__ = ["between", "headline", "outcome", "verdict"]


def outcome(comparison: Comparison) -> str:
    """`better` or `worse` when the interval leaves zero out, `open` when not, else nothing."""
    interval = comparison.interval
    direction = METRICS[comparison.metric].better if comparison.metric in METRICS else 0
    if interval is None or direction == 0:
        return ""
    if interval[0] <= 0 <= interval[1]:
        return "open"
    return "better" if (interval[0] > 0) == (direction > 0) else "worse"


def verdict(results: Results) -> list[str]:
    """Up to three plain sentences; "better" only where the bootstrap interval leaves zero out."""
    pair = headline(results.comparisons)
    if pair is None:
        return []
    found = {each.metric: each for each in between(results.comparisons, *pair)}
    metric = next((name for name in METRICS if name in found and outcome(found[name])), None)
    if metric is None:
        return []
    sentences = [_first(results, found[metric])]
    others = [each for name, each in found.items() if name in MAIN and name != metric]
    sentences += _second(others)
    rival = _leading(results, metric, pair)
    if rival is not None:
        sentences.append(rival)
    alone = between(results.comparisons, pair[0], "ibg")
    sentences += [_third(each) for each in alone if each.metric == metric and outcome(each)]
    return sentences[:3]


def _leading(results: Results, metric: str, pair: tuple[str, str]) -> str | None:
    """Which other source has the best mean, if any is ahead of the headline's."""
    best = max(results.sources, key=lambda name: _rank(results, name, metric))
    if best in pair or _rank(results, best, metric) <= _rank(results, pair[0], metric):
        return None
    found = [e for e in between(results.comparisons, best, pair[0]) if e.metric == metric]
    if not found:
        return None
    gap = f"{signed(found[0].mean_diff)}, 95 % interval {span(found[0].interval, sign=True)}"
    sure = "is ahead" if outcome(found[0]) == "better" else "has the best mean, undecided"
    return (
        f"Of all sources, {in_sentence(source_name(best))} {sure}: "
        f"{in_sentence(METRICS[metric].title)} "
        f"{number(results.sources[best].mean(metric))} ({gap})."
    )


def _rank(results: Results, source: str, metric: str) -> float:
    """The more, the better; a target to meet ranks nobody."""
    value = METRICS[metric].better * results.sources[source].mean(metric)
    return value if np.isfinite(value) else -np.inf


def headline(found: Sequence[Comparison]) -> tuple[str, str] | None:
    """The updated twin against the plain one, else the first pair in the file."""
    for updated, plain in product(("ibg_rg_command", "ibg_rg"), ("dt", "twin")):
        if between(found, updated, plain):
            return updated, plain
    return (found[0].a, found[0].b) if found else None


def between(found: Sequence[Comparison], a: str, b: str) -> list[Comparison]:
    """What is known of this pair, a minus b, score by score."""
    return [each.seen_from(a) for each in found if {each.a, each.b} == {a, b}]


def _first(results: Results, found: Comparison) -> str:
    a, b = (in_sentence(source_name(each)) for each in (found.a, found.b))
    means = [
        number(results.sources[each].mean(found.metric)) if each in results.sources else "–"
        for each in (found.a, found.b)
    ]
    count = results.data.test.n or len(results.data.test.labels)
    on = counted(count, "test trajectory") if count else "the test trajectories"
    what = f"{in_sentence(METRICS[found.metric].title)} {means[0]} against {means[1]}"
    difference = (
        f"difference {signed(found.mean_diff)}, 95 % interval {span(found.interval, sign=True)}"
    )
    result = outcome(found)
    doing, by = ("training", "on") if results.classes else ("simulation", "by")
    if result == "open":
        return (
            f"On {on}, {doing} {by} {a} cannot be told apart from {doing} {by} {b}: {what}, "
            f"and the interval of the difference includes zero ({difference})."
        )
    return f"On {on}, {doing} {by} {a} is {result} than {by} {b}: {what} ({difference})."


def _second(found: Sequence[Comparison]) -> list[str]:
    """The other main scores of the same pair, grouped by what their intervals say."""
    said = []
    for result, words in (("better", "also better"), ("worse", "worse"), ("open", "undecided")):
        each = [
            f"{in_sentence(METRICS[one.metric].title)} "
            f"({signed(one.mean_diff)}, {span(one.interval, sign=True)})"
            for one in found
            if outcome(one) == result
        ]
        if each:
            said.append(f"{words}: {', '.join(each)}")
    text = "; ".join(said)
    return [f"{text[0].upper()}{text[1:]}."] if text else []


def _third(found: Comparison) -> str:
    """What the residual model adds to the surrogate alone."""
    meaning = {
        "better": "so the residual model itself helps",
        "worse": "so the residual model itself does harm",
        "open": "so it is not shown that the residual model itself helps",
    }[outcome(found)]
    name = in_sentence(METRICS[found.metric].title)
    gap = f"{signed(found.mean_diff)} ({span(found.interval, sign=True)})"
    return (
        f"Against {in_sentence(source_name('ibg'))}, given the same commands, the "
        f"difference in {name} is {gap}, {meaning}."
    )
