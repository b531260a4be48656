"""What a diagnoser's probabilities are worth: how often it is right when it says so."""

from __future__ import annotations

import html
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.report.blocks import Key, Panel, Plot, Section
from retwin.report.plots import axis, caption, short, spec
from retwin.report.results import Results
from retwin.report.roc import telling
from retwin.report.words import mean_and_spread, number, slot, source_name, symbol

__all__ = ["Reliability", "ece_floor", "reliabilities", "reliability"]

BINS = 10
"""As many as the ECE has."""
IN_A_BIN = 5
"""Trajectories that a bin of the picture has at least."""
DRAWS = 1000


@dataclass(frozen=True)
class Reliability:
    """Answers in bins of equal mass by their confidence, means over runs: all (bins,).

    `low` and `high` are where 90 % of perfectly calibrated classifiers lie that are as confident
    on as few trajectories (consistency bars, Bröcker and Smith, Weather and Forecasting 2007).
    """

    confidence: NDArray
    right: NDArray
    low: NDArray
    high: NDArray


def reliabilities(results: Results) -> dict[str, Reliability]:
    """Of the telling sources."""
    return {
        source: _reliability(results.probabilities(source), results.truth)
        for source in telling(results)
    }


def _reliability(probabilities: NDArray, truth: NDArray) -> Reliability:
    """Of (runs, n, classes). A drawn classifier has one chance per trajectory in all runs.

    Runs answer the same trajectories, so chances of their own in each would make too little of
    how few trajectories there are.
    """
    chance = np.random.default_rng(0).random((DRAWS, len(truth)))
    bins = max(1, min(BINS, len(truth) // IN_A_BIN))
    confidence, right, drawn = [], [], []
    for answers in probabilities:
        sure = answers.max(axis=1)
        hit = answers.argmax(axis=1) == truth
        parts = np.array_split(np.argsort(sure, kind="stable"), bins)
        confidence.append([sure[part].mean() for part in parts])
        right.append([hit[part].mean() for part in parts])
        drawn.append([(chance[:, part] < sure[part]).mean(axis=1) for part in parts])
    low, high = np.quantile(np.mean(drawn, axis=0), [0.05, 0.95], axis=1)
    return Reliability(np.mean(confidence, axis=0), np.mean(right, axis=0), low, high)


def ece_floor(probabilities: NDArray, *, draws: int = 200, bins: int = 10) -> float:
    """ECE that a perfectly calibrated classifier with these confidences would still show.

    Whether each answer is right is drawn with its confidence as the chance; the mean of the
    top-label ECE over equal-mass bins is the floor, which comes from few trajectories alone.
    """
    rng = np.random.default_rng(0)
    floors = []
    for confidence in np.sort(probabilities.max(axis=2), axis=1):
        right = rng.random((draws, len(confidence))) < confidence
        gaps = np.zeros(draws)
        for bin_ in np.array_split(np.arange(len(confidence)), bins):
            if len(bin_):
                gap = right[:, bin_].mean(axis=1) - confidence[bin_].mean()
                gaps += len(bin_) / len(confidence) * np.abs(gap)
        floors.append(gaps.mean())
    return float(np.mean(floors))


def reliability(results: Results) -> Section | None:
    """Reliability diagrams, a panel per source."""
    found = reliabilities(results)
    if not found:
        return None
    keys = [
        Key("answers, in the colour of their source", "ink", "circle"),
        Key("where 90 % of perfectly calibrated classifiers lie", "observed", "bar"),
        Key("as sure as right", "muted", "dot"),
    ]
    text = (
        "How often an answer is right, against how sure the classifier was of it, in bins of "
        "equally many answers, mean over runs. Points below the line: too sure; above: not sure "
        "enough. Only points outside their bar say so: the bar holds 90 % of classifiers that are "
        "perfectly calibrated and answer as few trajectories."
    )
    panels = [_panel(results, source, each) for source, each in found.items()]
    return Section(
        "reliability", "Reliability", [Plot("reliability", caption(results, text), panels, keys)]
    )


def _panel(results: Results, source: str, found: Reliability) -> Panel:
    name, colour = source_name(source), f"@c{slot(source)}"
    x = short(found.confidence)
    data: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "lines",
            "name": "as sure as right",
            "x": [0, 1],
            "y": [0, 1],
            "line": {"color": "@muted", "width": 1, "dash": "dot"},
            "hoverinfo": "skip",
        },
        {
            "type": "scatter",
            "mode": "lines",
            "name": "perfectly calibrated",
            "x": [each for value in x for each in (value, value, None)],
            "y": [
                each
                for ends in zip(short(found.low), short(found.high), strict=True)
                for each in (*ends, None)
            ],
            "line": {"color": f"{colour}/0.35", "width": 7},
            "hoverinfo": "skip",
        },
        {
            "type": "scatter",
            "mode": "markers",
            "name": html.escape(name, quote=False),
            "x": x,
            "y": short(found.right),
            "marker": {"color": colour, "size": 9, "symbol": symbol(source)},
            "hovertemplate": "right %{y:.2f} where sure by %{x:.2f}<extra></extra>",
        },
    ]
    share = {"range": [-0.03, 1.05], "dtick": 0.2, "tickformat": ".1f"}
    ece = results.sources[source].scores.get("ece", [])
    note = f"ECE {mean_and_spread(ece)}; floor {number(ece_floor(results.probabilities(source)))}."
    picture = spec(data, axis("confidence", **share), axis("share that is right", **share))
    alt = f"{name}: share of right answers against their confidence"
    return Panel(picture, alt, name, note if ece else "", height=300)
