"""Which pair of sources the page is about, and which of the two is better."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np

from retwin.catalog import METRICS
from retwin.report.labels import MAIN, order, with_role
from retwin.report.study import Study
from retwin.results import Results
from retwin.results.sources import Comparison
from retwin.scores.comparison import alike, outcome


def outcome_of(comparison: Comparison) -> str:
    """The outcome of a comparison, see `retwin.scores.comparison.outcome`."""
    known = METRICS.get(comparison.metric)
    return outcome(comparison.interval, comparison.p_verdict, known.better if known else 0)


def headline(results: Results) -> tuple[str, str] | None:
    """The pair that the page is about: the updated twin and the plain one, else the first pair.

    Of several updated twins it is the last one in the catalog.
    """
    found = results.comparisons
    names = {name for each in found for name in (each.a, each.b)}
    updated, plain = (with_role(order(names), role) for role in ("updated", "plain"))
    for pair in product(reversed(updated), plain):
        if results.compared(*pair):
            return pair
    return (found[0].a, found[0].b) if found else None


def decisive(found: Mapping[str, Comparison]) -> Comparison | None:
    """The comparison on the first metric with an interval and a direction, if there is one."""
    known = [found[name] for name, each in METRICS.items() if each.better and name in found]
    return next((each for each in known if each.interval is not None), None)


def verdict(study: Study) -> dict[str, Any] | None:
    """The values of up to three sentences; None where no interval is known.

    `first` is the comparison of the headline's pair on the first metric with an interval and a
    direction, `others` those with an outcome on the other main metrics, `rival` that of the best
    other source on comparable data with the updated twin, and `surrogate` that of the updated twin
    with the surrogate alone.
    """
    results = study.results
    pair = headline(results)
    if pair is None:
        return None
    found = results.compared(*pair)
    first = decisive(found)
    if first is None:
        return None
    metric = first.metric
    alone = [results.compared(pair[0], name) for name in with_role(results.sources, "surrogate")]
    others = [each for name, each in found.items() if name in MAIN and name != metric]
    return {
        "first": first,
        "others": {
            result: [each for each in others if outcome_of(each) == result]
            for result in ("better", "worse", "open")
        },
        "rival": _rival(results, metric, pair),
        "surrogate": next(
            (each[metric] for each in alone if metric in each and outcome_of(each[metric])), None
        ),
    }


def _rival(results: Results, metric: str, pair: tuple[str, str]) -> Comparison | None:
    """The comparison of the source with the best mean, if that is better than the updated one.

    Only sources that see the same kind of real data as the updated one take part.
    """
    seen = results.sources[pair[0]].real_data
    rivals = [name for name, each in results.sources.items() if alike(each.real_data, seen)]

    def rank(name: str) -> float:
        value = METRICS[metric].better * results.sources[name].mean(metric)
        return value if math.isfinite(value) else -np.inf

    best = max(rivals, key=rank)
    if best in pair or rank(best) <= rank(pair[0]):
        return None
    return results.compared(best, pair[0]).get(metric)
