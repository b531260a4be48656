"""ROC over runs, with the classes micro-averaged (the paper's figure 4)."""

from __future__ import annotations

import html
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.report.blocks import Key, Panel, Plot, Section
from retwin.report.parts import Source
from retwin.report.plots import axis, caption, short, spec
from retwin.report.results import Results
from retwin.report.words import MANY, dash, mean_and_spread, order, slot, source_name

__all__ = ["Roc", "micro_roc", "roc", "roc_curves", "telling"]

GRID = np.linspace(0, 1, 201)


@dataclass(frozen=True)
class Roc:
    """Micro-averaged ROC over runs: false positive rate, mean true positive rate, its spread."""

    rate: NDArray
    mean: NDArray
    spread: NDArray
    areas: NDArray

    @property
    def band(self) -> tuple[NDArray, NDArray]:
        """Mean ± one standard deviation, inside [0, 1]."""
        return np.clip(self.mean - self.spread, 0, 1), np.clip(self.mean + self.spread, 0, 1)


def micro_roc(probabilities: NDArray, truth: NDArray) -> Roc:
    """ROC of (runs, n, classes) with every (trajectory, class) pair taken as one decision."""
    positive = (truth[:, None] == np.arange(probabilities.shape[2])).ravel()
    curves, areas = [], []
    for scores in probabilities:
        false, true = _roc(scores.ravel(), positive)
        areas.append(np.trapezoid(true, false))
        # Where the curve rises straight up, its upper end counts.
        last = np.append(np.flatnonzero(np.diff(false)), len(false) - 1)
        curves.append(np.interp(GRID, false[last], true[last]))
    stacked = np.array(curves)
    spread = stacked.std(axis=0, ddof=1) if len(stacked) > 1 else np.zeros(len(GRID))
    return Roc(GRID, stacked.mean(axis=0), spread, np.array(areas))


def _roc(scores: NDArray, positive: NDArray) -> tuple[NDArray, NDArray]:
    falling = np.argsort(-scores, kind="stable")
    ends = np.append(np.flatnonzero(np.diff(scores[falling])), len(scores) - 1)
    true = np.cumsum(positive[falling])[ends]
    false = ends + 1 - true
    return np.r_[0, false] / max(false[-1], 1), np.r_[0, true] / max(true[-1], 1)


def roc_curves(results: Results) -> dict[str, Roc]:
    """Micro-averaged ROC of the telling sources."""
    return {
        source: micro_roc(results.probabilities(source), results.truth)
        for source in telling(results)
    }


def telling(results: Results) -> list[str]:
    """All sources with probabilities; of many, the plain twin, the updated ones and the best."""
    sources = order(results.answered)
    chosen = [name for name in sources if name in (*sources[:1], "ibg_rg", "ibg_rg_command")]
    others = [name for name in sources if name not in chosen]
    best = sorted(others, key=lambda name: -_or_zero(results.sources[name]))
    return order([*chosen, *best[: max(0, MANY + 1 - len(chosen))]])


def _or_zero(source: Source) -> float:
    mean = source.mean("auroc_micro")
    return mean if math.isfinite(mean) else 0.0


def roc(results: Results) -> Section | None:
    """ROC with bands (the paper's figure 4)."""
    curves = roc_curves(results)
    if not curves:
        return None
    return Section("roc", "ROC", [_plot(results, curves)])


def _plot(results: Results, curves: dict[str, Roc]) -> Plot:
    """Micro-averaged ROC: the mean over runs and one standard deviation around it."""
    data: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "lines",
            "name": "chance",
            "x": [0, 1],
            "y": [0, 1],
            "line": {"color": "@rule", "width": 1},
            "hoverinfo": "skip",
        }
    ]
    keys = []
    for source, curve in curves.items():
        data += _traces(source, curve)
        area = mean_and_spread(curve.areas)
        keys.append(Key(f"{source_name(source)}: area {area}", f"c{slot(source)}", dash(source)))
    x = axis("false positive rate", range=[-0.01, 1.01], dtick=0.2)
    y = axis("true positive rate", range=[-0.01, 1.01], dtick=0.2)
    text = (
        f"Micro-averaged ROC, mean over {results.runs} runs; shading: ± one standard deviation. "
        "The further up and to the left, the better a source’s classifier separates the classes "
        "at any threshold; where bands overlap, chance in training can swap the sources."
        if results.runs > 1
        else "Micro-averaged ROC of the one run, so there is no band. The further up and to the "
        "left, the better a source’s classifier separates the classes at any threshold."
    )
    panel = Panel(spec(data, x, y), "Micro-averaged ROC curves", height=460)
    if set(curves) < set(results.answered):
        text += " Of all sources, the plain twin, the updated ones and the best are drawn."
    return Plot("roc", caption(results, text), [panel], keys, narrow=True)


def _traces(source: str, curve: Roc) -> list[dict[str, Any]]:
    colour = f"@c{slot(source)}"
    low, high = (short(edge) for edge in curve.band)
    x = short(curve.rate)
    name = html.escape(source_name(source), quote=False)
    traces: list[dict[str, Any]] = []
    if len(curve.areas) > 1:
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": f"{name} ± sd",
                "x": x + x[::-1],
                "y": high + low[::-1],
                "fill": "toself",
                "fillcolor": f"{colour}/0.18",
                "line": {"width": 0},
                "hoverinfo": "skip",
            }
        )
    traces.append(
        {
            "type": "scatter",
            "mode": "lines",
            "name": name,
            "x": x,
            "y": short(curve.mean),
            "line": {"color": colour, "width": 2.2, "dash": dash(source)},
            "hovertemplate": f"{name}<br>%{{y:.3f}} at %{{x:.2f}}<extra></extra>",
        }
    )
    return traces
