"""How much real data does it take: scores against healthy calibration trajectories."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Sequence
from typing import Any

from retwin.report.blocks import Key, Panel, Plot, Section
from retwin.report.parts import CurvePoint, Interval
from retwin.report.plots import axis, caption, spec
from retwin.report.results import Results
from retwin.report.words import dash, order, slot, source_name, symbol

__all__ = ["learning_curve", "learning_curves"]

Point = tuple[int, float, float, float]
"""Healthy trajectories, and a score with the ends of its interval."""


def learning_curves(results: Results) -> dict[str, dict[str, list[Point]]]:
    """Points by the score's name and source, in order; what nothing is known of is left out."""
    scores: dict[str, Callable[[CurvePoint], tuple[float | None, Interval | None]]] = {
        "macro-F1": lambda each: (_mean(each.macro_f1), each.macro_f1_interval),
        "healthy recall": lambda each: (_mean(each.healthy_recall), each.healthy_recall_interval),
        "RMSE": lambda each: (_mean(each.rmse), each.rmse_interval),
        "coverage of the 90 % band": lambda each: (each.coverage90, each.coverage90_interval),
    }
    found: dict[str, dict[str, list[Point]]] = {}
    names = {each.source for each in results.learning_curve}
    for title, read in scores.items():
        for source in order(sorted(names)):
            for each in sorted(results.learning_curve, key=lambda point: point.healthy):
                value, ends = read(each)
                if each.source != source or value is None:
                    continue
                low, high = (value if end is None else end for end in ends or (None, None))
                point = (each.healthy, value, low, high)
                found.setdefault(title, {}).setdefault(source, []).append(point)
    return found


def learning_curve(results: Results) -> Section | None:
    """Macro-F1, healthy recall and coverage of each source against the data it was given."""
    curves = learning_curves(results)
    if not curves:
        return None
    keys = [
        Key(source_name(name), f"c{slot(name)}", dash(name)) for name in next(iter(curves.values()))
    ]
    text = (
        "Scores against the healthy real trajectories that each source was calibrated on, mean "
        "over runs and folds, with the 95 % bootstrap interval over test trajectories. Fewer ones "
        "are a part of the more. A curve that has flattened says that more real data of this kind "
        "would not help; bands that should hold 90 % of the points and hold fewer were drawn from "
        "too little."
    )
    panels = [_panel(title, lines) for title, lines in curves.items()]
    plot = Plot("learning", caption(results, text), panels, keys)
    return Section("learning", "How much real data", [plot])


def _mean(values: Sequence[float]) -> float | None:
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


def _panel(title: str, lines: dict[str, list[Point]]) -> Panel:
    counts = sorted({point[0] for points in lines.values() for point in points})
    ticks = {"tickvals": counts, "ticktext": [str(count) for count in counts]}
    x = axis("healthy trajectories", type="log", **ticks)
    share = {"range": [-0.02, 1.02], "dtick": 0.2, "tickformat": ".1f"}
    y = axis(title, **({"rangemode": "tozero"} if title == "RMSE" else share))
    data = [_trace(source, points) for source, points in lines.items()]
    return Panel(spec(data, x, y), f"{title} against calibration trajectories", title, height=320)


def _trace(source: str, points: Sequence[Point]) -> dict[str, Any]:
    colour, name = f"@c{slot(source)}", html.escape(source_name(source), quote=False)
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": name,
        # Side by side, so that bars do not cover each other.
        "x": [round(count * 1.02 ** (slot(source) - 3), 4) for count, *_ in points],
        "y": [value for _, value, _, _ in points],
        "error_y": {
            "type": "data",
            "symmetric": False,
            "array": [max(0.0, high - value) for _, value, _, high in points],
            "arrayminus": [max(0.0, value - low) for _, value, low, _ in points],
            "color": colour,
            "thickness": 1.4,
            "width": 0,
        },
        "line": {"color": colour, "width": 2.2, "dash": dash(source)},
        "marker": {"color": colour, "size": 7, "symbol": symbol(source)},
        "text": [f"{count}: {value:.3f}" for count, value, _, _ in points],
        "hovertemplate": f"{name}<br>%{{text}}<extra></extra>",
    }
