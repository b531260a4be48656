"""Plotly pictures as plain data; `@name` stands for a colour that the page looks up."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from retwin.catalog import METRICS
from retwin.report.blocks import Key, Panel, Plot
from retwin.report.curves import Latent
from retwin.report.results import Results
from retwin.report.words import (
    mean_and_spread,
    number,
    order,
    slot,
    source_name,
    span,
    symbol,
)

__all__ = [
    "FONT",
    "axis",
    "caption",
    "latent_names",
    "latent_plot",
    "missing",
    "published_value",
    "scores_plot",
    "short",
    "spec",
]

FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"


def caption(results: Results, text: str) -> str:
    """What to see; with emulated data it begins by saying so."""
    return f"Emulated data, no real measurements. {text}" if results.emulated else text


def axis(title: str, **more: Any) -> dict[str, Any]:
    """An axis in the page's style; `more` as plotly names it."""
    return {
        "title": {
            "text": html.escape(title, quote=False),
            "standoff": 8,
            "font": {"size": 13},
        },
        "gridcolor": "@grid",
        "linecolor": "@rule",
        "zeroline": False,
        "fixedrange": True,
        "automargin": True,
        "ticks": "outside",
        "tickcolor": "@rule",
        "ticklen": 4,
        **more,
    }


def spec(data: list[dict[str, Any]], x: dict[str, Any], y: dict[str, Any]) -> dict[str, Any]:
    """A picture of these traces and axes."""
    layout = {
        "xaxis": x,
        "yaxis": y,
        "font": {"family": FONT, "size": 13, "color": "@muted"},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "margin": {"l": 8, "r": 12, "t": 8, "b": 8},
        "showlegend": False,
        "dragmode": False,
        "hoverlabel": {"font": {"family": FONT, "size": 13}},
    }
    return {"data": data, "layout": layout}


def published_value(text: str) -> tuple[float, float] | None:
    """Mean and spread from a text like `0.753 ± 0.026`; None if it is no score."""
    found = re.fullmatch(r"\s*([01]?\.\d+)\s*(?:±\s*([01]?\.\d+))?\s*", text)
    return (float(found[1]), float(found[2] or 0)) if found else None


def scores_plot(results: Results, metrics: Sequence[str]) -> Plot | None:
    """Means, intervals and the paper's numbers on one axis; only for scores within 0 and 1."""
    sources = order(list(results.sources))
    bounded = [name for name in metrics if name not in ("rmse", "nrmse", "crps")]
    if not bounded:
        return None
    data: list[dict[str, Any]] = []
    gap = 0.76 / max(len(sources), 2)
    lanes = [gap * (place + 0.5) - 0.3 for place in range(len(sources))]
    for place, source in enumerate(sources):
        data += _score_traces(results, source, bounded, (lanes[place], gap))
    y = axis("", range=[len(bounded) - 0.5, -0.55], showgrid=False, ticks="", showline=False)
    y["tickvals"] = [i + lane for i in range(len(bounded)) for lane in lanes]
    y["ticktext"] = [html.escape(source_name(name)) for name in sources] * len(bounded)
    x = axis("score", range=[-0.01, 1.02], tickformat=".1f", dtick=0.2)
    keys = [Key(source_name(name), f"c{slot(name)}", symbol(name)) for name in sources]
    text = "Dots are means over runs, bars the 95 % bootstrap interval over test trajectories"
    if any(trace["name"].endswith("(paper)") for trace in data):
        keys.append(Key("paper’s mean ± sd over its runs", "muted", "diamond"))
        text += "; open diamonds are the paper’s numbers, in the colour of their source"
    picture = spec(data, x, y)
    picture["layout"]["annotations"] = [
        _lane_title(METRICS[name].title, i) for i, name in enumerate(bounded)
    ]
    height = 70 + len(bounded) * (30 + 24 * max(len(sources), 2))
    alt = "Scores of every source as dots with intervals"
    panel = Panel(picture, alt, height=height, narrow={"yaxis": {**y, "showticklabels": False}})
    see = (
        ". Look at the order of the sources and at how far apart they lie; bars that overlap do "
        "not settle a comparison, the paired differences do."
    )
    return Plot("scores", caption(results, text + see), [panel], keys)


def _lane_title(text: str, place: int) -> dict[str, Any]:
    """A score's name above its lanes, which leaves a narrow screen all of its width."""
    return {
        "text": f"<b>{html.escape(text, quote=False)}</b>",
        "x": 0,
        "xref": "paper",
        "xanchor": "left",
        "y": place - 0.42,
        "showarrow": False,
        "font": {"color": "@ink"},
    }


def _score_traces(
    results: Results, source: str, metrics: Sequence[str], lane: tuple[float, float]
) -> list[dict[str, Any]]:
    """Of one source: `lane` is how far below a metric's place it is drawn, and how wide it is."""
    one, colour = results.sources[source], f"@c{slot(source)}"
    name = html.escape(source_name(source), quote=False)
    shown = [metric for metric in metrics if metric in one.scores]
    means = [one.mean(metric) for metric in shown]
    ends = [one.interval(m) or (mean, mean) for m, mean in zip(shown, means, strict=True)]
    traces: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "markers",
            "name": name,
            "x": means,
            "y": [metrics.index(metric) + lane[0] for metric in shown],
            "error_x": {
                "type": "data",
                "symmetric": False,
                "array": [max(end[1] - mean, 0) for end, mean in zip(ends, means, strict=True)],
                "arrayminus": [
                    max(mean - end[0], 0) for end, mean in zip(ends, means, strict=True)
                ],
                "color": colour,
                "thickness": 2,
                "width": 0,
            },
            "marker": {"color": colour, "size": 10, "symbol": symbol(source)},
            "text": [f"{mean_and_spread(one.scores[m])} [{span(one.interval(m))}]" for m in shown],
            "hovertemplate": f"{name}<br>%{{text}}<extra></extra>",
        }
    ]
    told = results.published.get(source, {})
    paper = {m: published_value(told[m]) for m in metrics if m in told}
    below = lane[0] + 0.35 * lane[1]
    marks = [(*value, metrics.index(m) + below) for m, value in paper.items() if value is not None]
    for known in ([mark for mark in marks if mark[1]], [mark for mark in marks if not mark[1]]):
        traces += _paper_trace(name, colour, known)
    return traces


def _paper_trace(
    name: str, colour: str, marks: Sequence[tuple[float, float, float]]
) -> list[dict[str, Any]]:
    """The paper's (mean, spread, height) as open diamonds; marks without a spread have no bar."""
    if not marks:
        return []
    means, spreads, heights = (list(each) for each in zip(*marks, strict=True))
    bars = {"type": "data", "array": spreads, "color": colour, "thickness": 1, "width": 3}
    return [
        {
            "type": "scatter",
            "mode": "markers",
            "name": f"{name} (paper)",
            "x": means,
            "y": heights,
            "error_x": bars if any(spreads) else {"visible": False},
            "marker": {"color": colour, "size": 9, "symbol": "diamond-open"},
            "hovertemplate": f"{name}, paper<br>%{{x:.3f}}<extra></extra>",
        }
    ]


def latent_names(name: str) -> tuple[str, str]:
    """Title of a panel and quantity on its axis."""
    if name.startswith("delay"):
        return f"TDe{name[5:].replace('_', ' ')}", "delay"
    for start, title, what in (("offset_", "TPE", "offset"), ("noise_", "Noise", "noise")):
        if name.startswith(start):
            rest = name[len(start) :].replace("_", " ")
            return f"{title} {rest}", f"{what} {rest}"
    return name.replace("_", " "), name.replace("_", " ")


def missing(latent: Latent) -> str:
    """How many values the range leaves out."""
    seen, said = latent.outside
    if not seen and not said:
        return f"All {latent.counts[0]} observed and {latent.counts[1]} generated values are shown."
    return (
        f"Outside the range shown: {seen} of {latent.counts[0]} observed, "
        f"{said} of {latent.counts[1]} generated."
    )


def latent_plot(
    results: Results, source: str, name: str, text: str, shown: Sequence[Latent]
) -> Plot:
    """Observed as bars, generated as a stepped line, a panel per latent."""
    keys = [Key("observed", "observed", "bar"), Key("generated", f"c{slot(source)}")]
    panels = [_latent_panel(each, f"@c{slot(source)}") for each in shown]
    return Plot(name, caption(results, text), panels, keys, narrow=len(panels) == 1)


def _latent_panel(latent: Latent, colour: str) -> Panel:
    title, what = latent_names(latent.name)
    unit = f", {latent.unit}" if latent.unit else ""
    edges = short(latent.edges, 5)
    data: list[dict[str, Any]] = [
        {
            "type": "bar",
            "name": "observed",
            "x": short((latent.edges[1:] + latent.edges[:-1]) / 2, 5),
            "y": short(latent.observed, 5),
            "width": float(np.diff(latent.edges).mean()),
            "marker": {"color": "@observed", "line": {"width": 0}},
            "hovertemplate": "observed<br>%{y:.1%} near %{x:.3g}<extra></extra>",
        },
        {
            "type": "scatter",
            "mode": "lines",
            "name": "generated",
            "x": [edges[0], *edges],
            "y": [0, *short(latent.predicted, 5), 0],
            "line": {"shape": "hv", "color": colour, "width": 2.2},
            "hovertemplate": "generated<br>%{y:.1%} from %{x:.3g}<extra></extra>",
        },
    ]
    # A step to each bin's share at its left edge: the first point only lifts the line from zero.
    x = axis(f"{what}{unit}", range=[edges[0], edges[-1]], nticks=7)
    y = axis("share per bin", tickformat=".0%", rangemode="tozero", nticks=6)
    alt = f"{title}, observed and generated, {number(edges[0], 1)} to {number(edges[-1], 1)}{unit}"
    return Panel(spec(data, x, y), alt, title, missing(latent), height=300)


def short(values: Any, digits: int = 4) -> list[float]:
    """Numbers with as many digits as a picture needs, so that the page stays small."""
    return [float(f"{value:.{digits}g}") for value in np.asarray(values, dtype=float)]
