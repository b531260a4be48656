"""Figures as plotly's data, which `page.js` draws in the page's style.

`@NAME` stands for a colour of the page.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Iterator
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from retwin.report.figures.figure import (
    Axis,
    Band,
    Dimension,
    Figure,
    Heading,
    Line,
    Mark,
    Matrices,
    Panel,
    Points,
    Spans,
)

FORMATS = {"share": ".1f", "percent": ".0%"}
HOVER = {"share": ".3f", "percent": ".1%"}
UPPER, LOWER = [0.38, 1], [0, 0.3]
"""The parts of the height that two rows take."""


def figure_specs(figures: Iterable[Figure | Matrices]) -> dict[str, Any]:
    """Plotly's data by the id of the element that shows them."""
    return {
        f"plot-{figure.name}-{place}": panel_spec(panel)
        for figure in figures
        if isinstance(figure, Figure)
        for place, panel in enumerate(figure.panels)
    }


def panel_spec(panel: Panel) -> dict[str, Any]:
    """Data and layout of a panel; `narrow` holds what of the layout differs on a narrow screen."""
    first, *others = panel.rows
    x, y = _axis(panel.x), _axis(first.y)
    layout: dict[str, Any] = {"xaxis": x, "yaxis": y}
    if others:
        y["domain"], x["anchor"] = UPPER, "y2"
        lower = {"domain": LOWER, "zeroline": True, "zerolinecolor": "@rule"}
        layout["yaxis2"] = _axis(others[0].y) | lower
    parts: dict[str, list[dict[str, Any]]] = {"data": [], "shapes": [], "annotations": []}
    for row, own in zip(panel.rows, ({}, {"yaxis": "y2"}), strict=False):
        for mark in row.drawn:
            for kind, part in _parts(mark, panel.x, row.y):
                parts[kind].append(part | (own if kind == "data" else {}))
    data = parts.pop("data")
    layout |= {kind: found for kind, found in parts.items() if found}
    narrow = {"yaxis": {**y, "showticklabels": False}} if panel.narrow_bare else {}
    return {"data": data, "layout": layout, "height": panel.height, "narrow": narrow}


def _axis(axis: Axis) -> dict[str, Any]:
    # 5000 rather than 5k.
    made: dict[str, Any] = {"title": {"text": _escaped(axis.title)}, "minexponent": 5}
    if axis.limits is not None:
        made["range"] = _numbers(axis.limits)
    if axis.kind == "log":
        made["type"] = "log"
    if axis.kind == "names":
        made |= {"showgrid": False, "ticks": "", "showline": False}
    if axis.kind in FORMATS:
        made["tickformat"] = FORMATS[axis.kind]
    if axis.bare:
        made["showticklabels"] = False
    if axis.from_zero:
        made["rangemode"] = "tozero"
    if axis.ticks:
        made["tickvals"] = list(axis.ticks)
        made["ticktext"] = [_escaped(text) for text in axis.ticks.values()]
    elif axis.step is not None:
        made["dtick"] = axis.step
    else:
        made["nticks"] = axis.count
    return made


def _parts(mark: Mark, x: Axis, y: Axis) -> Iterator[tuple[str, dict[str, Any]]]:
    """What a mark adds to the data, the shapes and the annotations."""
    where = f"%{{y:{HOVER.get(y.kind, '.4g')}}} at %{{x:{HOVER.get(x.kind, '.4g')}}} {x.unit}"
    match mark:
        case Line():
            colour = _colour(mark.colour, mark.alpha)
            line = {"color": colour, "width": mark.width, "dash": mark.dash}
            more = {"fill": "tozeroy", "fillcolor": colour} if mark.filled else {}
            more |= _hover(mark.name, where) if mark.hover else {"hoverinfo": "skip"}
            yield "data", _trace(mark.name, mark.x, mark.y, line=line, **more)
        case Band():
            fill = {"fill": "toself", "fillcolor": _colour(mark.colour, mark.alpha)}
            line = {"width": 0}
            yield "data", _trace(mark.name, *_outline(mark), **fill, line=line, hoverinfo="skip")
        case Points():
            yield "data", _points(mark, where)
        case Spans():
            for start, end in mark.intervals:
                line = {"width": mark.outline, "color": f"@{mark.colour}"}
                look = {"fillcolor": _colour(mark.colour, mark.alpha), "line": line}
                area = {"yref": "paper", "y0": 0, "y1": mark.height, "x0": start, "x1": end}
                yield "shapes", {"type": "rect", "layer": "below", **area, **look}
        case Dimension():
            (x0, y0), (x1, y1) = mark.start, mark.end
            line = {"color": f"@{mark.colour}", "width": 4}
            yield "shapes", {"type": "line", "x0": x0, "y0": y0, "x1": x1, "y1": y1, "line": line}
            ends = {"x": (x0 + x1) / 2, "y": (y0 + y1) / 2, "ax": mark.beside[0]}
            arrow = {"arrowcolor": "@ink", "arrowhead": 2, "arrowwidth": 1, "standoff": 5}
            yield "annotations", _text(mark.name, size=14) | ends | {"ay": mark.beside[1]} | arrow
        case Heading():
            place = {"x": 0, "xref": "paper", "xanchor": "left", "y": mark.y, "showarrow": False}
            yield "annotations", _text(mark.text) | place


def _points(mark: Points, where: str) -> dict[str, Any]:
    colour = f"@{mark.colour}"
    marker = {"color": colour, "size": mark.size, "symbol": mark.symbol}
    more: dict[str, Any] = _hover(mark.name, "%{text}" if mark.texts else where)
    if mark.texts:
        more["text"] = list(mark.texts)
    if mark.dash:
        more["line"] = {"color": colour, "width": 2.2, "dash": mark.dash}
    if mark.intervals is not None:
        below, above = map(_numbers, mark.intervals)
        look = {"color": colour, "thickness": mark.bar_width, "width": 0}
        ends = {"type": "data", "symmetric": False, "array": above, "arrayminus": below}
        more[f"error_{mark.along}"] = ends | look
    mode = "lines+markers" if mark.dash else "markers"
    return _trace(mark.name, mark.x, mark.y, mode, marker=marker, **more)


def _outline(band: Band) -> tuple[ArrayLike, ArrayLike]:
    """The outline of each part of a band, with NaN between parts: a gap where it has no value."""
    x, low, high = (np.asarray(each, dtype=float) for each in (band.x, band.low, band.high))
    known = np.flatnonzero(np.isfinite(low) & np.isfinite(high))
    if not len(known):
        return [], []
    parts = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
    x_of = [np.concatenate([x[part], x[part[::-1]], [np.nan]]) for part in parts]
    y_of = [np.concatenate([high[part], low[part[::-1]], [np.nan]]) for part in parts]
    return np.concatenate(x_of)[:-1], np.concatenate(y_of)[:-1]


def _trace(
    name: str, x: ArrayLike, y: ArrayLike, mode: str = "lines", **more: Any
) -> dict[str, Any]:
    made = {"type": "scatter", "mode": mode, "name": _escaped(name)}
    return made | {"x": _numbers(x), "y": _numbers(y)} | more


def _colour(name: str, alpha: float) -> str:
    return f"@{name}/{alpha}" if alpha < 1 else f"@{name}"


def _hover(name: str, text: str) -> dict[str, str]:
    return {"hovertemplate": f"{_escaped(name)}<br>{text.rstrip()}<extra></extra>"}


def _text(text: str, **look: int) -> dict[str, Any]:
    return {"text": f"<b>{_escaped(text)}</b>", "font": {"color": "@ink", **look}}


def _escaped(text: str) -> str:
    return html.escape(text, quote=False)


def _numbers(values: ArrayLike) -> list[float | None]:
    """Four digits, so that the page stays small; None for a break."""
    every = np.asarray(values, dtype=float).tolist()
    return [float(f"{each:.4g}") if isfinite(each) else None for each in every]
