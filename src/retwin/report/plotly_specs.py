"""Figures as plotly's data, which `page.js` draws in the page's style.

`@NAME` stands for a colour of the page.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from retwin.report.figure import (
    Axis,
    Band,
    Bars,
    Dimension,
    Figure,
    Heading,
    Line,
    Mark,
    Matrices,
    Panel,
    Points,
    Row,
    Spans,
)

FORMATS = {"share": ".1f", "percent": ".0%"}
HOVER = {"share": ".3f", "percent": ".1%"}
MAX_POINTS = 4000
"""Samples beyond which a line is drawn as the smallest and the largest value of groups."""
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
    data = _traces(first, panel.x)
    if others:
        y["domain"], x["anchor"] = UPPER, "y2"
        layout["yaxis2"] = _axis(others[0].y) | {"domain": LOWER, "zeroline": True}
        layout["yaxis2"]["zerolinecolor"] = "@rule"
        data += [{**trace, "yaxis": "y2"} for trace in _traces(others[0], panel.x)]
    if shapes := [each for mark in first.marks for each in _shapes(mark)]:
        layout["shapes"] = shapes
    if annotations := [each for mark in first.marks for each in _annotations(mark)]:
        layout["annotations"] = annotations
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


def _traces(row: Row, x: Axis) -> list[dict[str, Any]]:
    drawn = map(_reduced, row.marks)
    return [each for mark in drawn if (each := _trace(mark, x, row.y)) is not None]


def _reduced(mark: Mark) -> Mark:
    """A line or a band of very many samples as its envelope, so that no peak is lost."""
    if not isinstance(mark, Line | Band) or len(np.asarray(mark.x)) <= MAX_POINTS or _breaks(mark):
        return mark
    x = np.asarray(mark.x, dtype=float)
    starts = np.linspace(0, len(x), MAX_POINTS // 2 + 1).astype(int)[:-1]
    if isinstance(mark, Band):
        low = np.fmin.reduceat(np.asarray(mark.low, dtype=float), starts)
        high = np.fmax.reduceat(np.asarray(mark.high, dtype=float), starts)
        return replace(mark, x=x[starts], low=low, high=high)
    y = np.asarray(mark.y, dtype=float)
    ends = [each.reduceat(y, starts) for each in (np.fmin, np.fmax)]
    return replace(mark, x=np.repeat(x[starts], 2), y=np.stack(ends, axis=1).ravel())


def _breaks(mark: Line | Band) -> bool:
    return isinstance(mark, Line) and (mark.step or bool(np.any(np.diff(np.asarray(mark.x)) < 0)))


def _outline(band: Band) -> tuple[list[float | None], list[float | None]]:
    """The outline of each part of a band, with None between parts: a gap where it has no value."""
    x, low, high = (np.asarray(each, dtype=float) for each in (band.x, band.low, band.high))
    known = np.flatnonzero(np.isfinite(low) & np.isfinite(high))
    parts = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
    x_of: list[float | None] = []
    y_of: list[float | None] = []
    for part in parts:
        if len(part):
            between: list[float | None] = [None] if x_of else []
            x_of += [*between, *_numbers(x[part]), *_numbers(x[part[::-1]])]
            y_of += [*between, *_numbers(high[part]), *_numbers(low[part[::-1]])]
    return x_of, y_of


def _trace(mark: Mark, x: Axis, y: Axis) -> dict[str, Any] | None:
    """The trace of a mark; None for a mark that is a shape or an annotation."""
    where = f"%{{y:{HOVER.get(y.kind, '.4g')}}} at %{{x:{HOVER.get(x.kind, '.4g')}}} {x.unit}"
    match mark:
        case Line():
            colour = f"@{mark.colour}" + (f"/{mark.alpha}" if mark.alpha < 1 else "")
            line = {"color": colour, "width": mark.width, "dash": mark.dash}
            shape = {"shape": "hv"} if mark.step else {}
            points = {"x": _numbers(mark.x), "y": _numbers(mark.y)}
            hover = _hover(mark.name, where) if mark.hover else {"hoverinfo": "skip"}
            return _scatter(mark.name, "lines", **points, line={**line, **shape}, **hover)
        case Band():
            x_of, y_of = _outline(mark)
            return _scatter(
                mark.name,
                "lines",
                x=x_of,
                y=y_of,
                fill="toself",
                fillcolor=f"@{mark.colour}/{mark.alpha}",
                line={"width": 0},
                hoverinfo="skip",
            )
        case Points():
            return _points(mark, where)
        case Bars():
            return _bars(mark, where)
    return None


def _bars(mark: Bars, where: str) -> dict[str, Any]:
    """The outline of the bars, filled; the bundle of the page has no trace of its own for bars."""
    x = np.repeat(mark.edges, 2)[1:-1]
    y = np.repeat(mark.heights, 2)
    return _scatter(
        mark.name,
        "lines",
        x=_numbers([x[0], *x, x[-1]]),
        y=_numbers([0.0, *y, 0.0]),
        fill="toself",
        fillcolor=f"@{mark.colour}",
        line={"width": 0, "color": f"@{mark.colour}"},
        **_hover(mark.name, where),
    )


def _points(mark: Points, where: str) -> dict[str, Any]:
    made = _scatter(
        mark.name,
        "lines+markers" if mark.dash else "markers",
        x=_numbers(mark.x),
        y=_numbers(mark.y),
        marker={"color": f"@{mark.colour}", "size": mark.size, "symbol": mark.symbol},
        **_hover(mark.name, "%{text}" if mark.texts else where),
    )
    if mark.texts:
        made["text"] = list(mark.texts)
    if mark.dash:
        made["line"] = {"color": f"@{mark.colour}", "width": 2.2, "dash": mark.dash}
    if mark.low is not None and mark.high is not None:
        middle = np.asarray(mark.x if mark.along == "x" else mark.y, dtype=float)
        made[f"error_{mark.along}"] = {
            "type": "data",
            "symmetric": False,
            "array": _numbers(np.maximum(np.asarray(mark.high) - middle, 0)),
            "arrayminus": _numbers(np.maximum(middle - np.asarray(mark.low), 0)),
            "color": f"@{mark.colour}",
            "thickness": mark.bar_width,
            "width": 0,
        }
    return made


def _scatter(name: str, mode: str, **more: Any) -> dict[str, Any]:
    return {"type": "scatter", "mode": mode, "name": _escaped(name), **more}


def _hover(name: str, text: str) -> dict[str, str]:
    return {"hovertemplate": f"{_escaped(name)}<br>{text.rstrip()}<extra></extra>"}


def _shapes(mark: Mark) -> list[dict[str, Any]]:
    if isinstance(mark, Spans):
        area = {"type": "rect", "yref": "paper", "y0": 0, "y1": 1, "layer": "below"}
        fill = {"fillcolor": f"@{mark.colour}", "line": {"width": 0}}
        return [{**area, **fill, "x0": start, "x1": end} for start, end in mark.intervals]
    if isinstance(mark, Dimension):
        corners = (*mark.start, *mark.end)
        ends = dict(zip(("x0", "y0", "x1", "y1"), corners, strict=True))
        return [{"type": "line", **ends, "line": {"color": f"@{mark.colour}", "width": 4}}]
    return []


def _annotations(mark: Mark) -> list[dict[str, Any]]:
    if isinstance(mark, Heading):
        place = {"x": 0, "xref": "paper", "xanchor": "left", "y": mark.y, "showarrow": False}
        return [{"text": f"<b>{_escaped(mark.text)}</b>", **place, "font": {"color": "@ink"}}]
    if isinstance(mark, Dimension):
        middle = [(a + b) / 2 for a, b in zip(mark.start, mark.end, strict=True)]
        return [
            {
                "text": f"<b>{_escaped(mark.name)}</b>",
                **dict(zip(("x", "y", "ax", "ay"), (*middle, *mark.beside), strict=True)),
                "font": {"color": "@ink", "size": 14},
                "arrowcolor": "@ink",
                "arrowhead": 2,
                "arrowwidth": 1,
                "standoff": 5,
            }
        ]
    return []


def _escaped(text: str) -> str:
    return html.escape(text, quote=False)


def _numbers(values: ArrayLike | Sequence[float]) -> list[float]:
    """Four digits, so that the page stays small."""
    return [float(f"{value:.4g}") for value in np.asarray(values, dtype=float)]
