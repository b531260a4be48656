"""Figures as SVG: files in light colours, and panels that a page shows until scripts draw them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.report.figure import (
    Axis,
    Band,
    Dimension,
    Figure,
    Heading,
    Key,
    Line,
    Mark,
    Matrices,
    Matrix,
    Panel,
    Points,
    Row,
    Spans,
    envelope,
)
from retwin.report.style import CHROME, DASHES, colour_of, hexadecimal

STROKES = dict(zip(DASHES, ("none", "7 4", "2 3", "8 3 2 3"), strict=True))
"""Lengths of strokes and gaps."""
LETTER = 6.8
"""The mean width of a letter, in pixels."""
CELL = 26
"""The side of a cell of a matrix, in pixels."""
Scale = Callable[[ArrayLike], NDArray]
"""From values of an axis to half pixels."""


def svg_file(shown: Figure | Matrices, *, emulated: bool) -> str:
    """The figure as the text of an SVG file; a heading marks emulated data."""
    own = shown.title if isinstance(shown, Figure) else ""
    heading = "EMULATED data: no real measurements" if emulated else own
    if isinstance(shown, Matrices):
        names, columns = list(shown.classes), 3
        margin = 30 + LETTER * max(map(len, names))
        width = tall = round(CELL * len(names) + margin + 40)
        drawn = [(tall, _matrix(each, names, margin)) for each in shown.matrices]
        keys: Sequence[Key] = ()
    else:
        keys, columns = shown.keys, min(shown.columns, len(shown.panels))
        width = 720 if columns == 1 else 360
        drawn = [(each.height, _panel(each, width)) for each in shown.panels]
    columns = min(columns, len(drawn))
    whole, y = columns * width, 26 if heading else 4
    parts = ['<rect width="100%" height="100%" fill="var(--paper)"/>']
    parts += [_text(8, 17, heading, font_weight="bold")] if heading else []
    for start in range(0, len(drawn), columns):
        line = drawn[start : start + columns]
        for place, (_, inner) in enumerate(line):
            parts.append(f'<g transform="translate({place * width} {y})">{"".join(inner)}</g>')
        y += max(height for height, _ in line)
    legend, y = _legend(keys, whole, y)
    made = _element(whole, y, [*parts, *legend])
    return re.sub(r"var\(--(\w+)\)", lambda found: hexadecimal(found[1]), made)


def svg_panel(panel: Panel, width: int) -> str:
    """A panel without its title, as an SVG element in the colours of the page's style."""
    return _element(width, panel.height, _panel(replace(panel, title=""), width))


def _element(width: int, height: int, parts: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
        f'height="{height}" font-family="sans-serif" font-size="12">{"".join(parts)}</svg>'
    )


def _text(x: float, y: float, text: str, colour: str = "ink", **look: object) -> str:
    given = "".join(f' {name.replace("_", "-")}="{value}"' for name, value in look.items())
    return f'<text x="{x:.0f}" y="{y:.0f}" fill="var(--{colour})"{given}>{escape(text)}</text>'


def _legend(keys: Sequence[Key], width: int, y: int) -> tuple[list[str], int]:
    """The entries, in lines that are as wide as the figure, and where they end."""
    parts, x = [], 8.0
    for key in keys:
        room = 44 + LETTER * len(key.text)
        if x > 8 and x + room > width:
            x, y = 8.0, y + 18
        colour = f"var(--{key.colour})"
        if key.mark == "bar":
            fade = 1 if key.colour in CHROME else 0.4
            mark = f'<rect y="-8" width="26" height="8" fill="{colour}" opacity="{fade}"/>'
        elif key.mark in STROKES:
            mark = f'<path d="M0-4h26" {_stroke(key.colour, 2, key.mark)}/>'
        else:
            mark = _symbol(key.mark, 13, -4, 5, key.colour)
        parts.append(f'<g transform="translate({x:.0f} {y + 14})">{mark}</g>')
        parts.append(_text(x + 32, y + 14, key.text))
        x += room
    return parts, y + 24 * bool(keys)


def _matrix(matrix: Matrix, names: Sequence[str], margin: float) -> list[str]:
    """Counts on cells that are coloured by their share, below a title."""
    parts = [_text(8, 14, matrix.title, font_weight="bold")]
    tone, end = f"var(--{colour_of(matrix.source)})", 24 + CELL * len(names)
    for row, name in enumerate(names):
        y, x = 24 + CELL * row, margin + CELL * (row + 0.5) + 4
        parts.append(_text(margin - 6, y + 17, name, "muted", text_anchor="end"))
        turn = f"rotate(-90 {x:.0f} {end + 6})"
        parts.append(_text(x, end + 6, name, "muted", text_anchor="end", transform=turn))
        for column, count in enumerate(matrix.counts[row]):
            share, left = float(matrix.shares[row][column]), margin + CELL * column
            look = f'fill="{tone}" fill-opacity="{share:.2f}" stroke="var(--grid)"'
            parts.append(f'<rect x="{left:.0f}" y="{y}" width="{CELL}" height="{CELL}" {look}/>')
            if count:
                ink = "paper" if share >= 0.6 else "ink"
                parts.append(_text(left + CELL / 2, y + 17, str(count), ink, text_anchor="middle"))
    return parts


def _panel(panel: Panel, width: int) -> list[str]:
    """A title above one or two rows of marks, with their axes."""
    top = 22 if panel.title else 8
    parts = [_text(8, 14, panel.title, font_weight="bold")] if panel.title else []
    bottom = panel.height - (8 if panel.x.bare else 42)
    shares = (0.62, 0.3) if len(panel.rows) > 1 else (1.0,)
    limits = _limits(panel.x, [row for each in panel.rows for row in _values(each, "x")])
    spans = [_limits(row.y, _values(row, "y")) for row in panel.rows]
    labels = [_ticks(row.y, ends) for row, ends in zip(panel.rows, spans, strict=True)]
    longest = max((len(text) for each in labels for text in each.values()), default=0)
    titled = any(row.y.title for row in panel.rows)
    left = round(14 + 18 * titled + LETTER * longest)
    wide, y = width - left - 14, float(top)
    for place, (row, ends, ticks) in enumerate(zip(panel.rows, spans, labels, strict=True)):
        last, high = place == len(shares) - 1, round(shares[place] * (bottom - top))
        y = bottom - high if last else y
        across, up = _scale(panel.x, limits, 2 * wide), _scale(row.y, ends, -2 * high)
        for at, name in ticks.items():
            level = y + float(up(at)) / 2
            if row.y.kind != "names":
                parts.append(f'<path d="M{left} {level:.1f}h{wide}" {_stroke("grid", 1)}/>')
            parts.append(_text(left - 5, level + 4, name, "muted", text_anchor="end"))
        for at, name in _ticks(panel.x, limits).items():
            x = left + float(across(at)) / 2
            parts.append(f'<path d="M{x:.1f} {y:.0f}v{high}" {_stroke("grid", 1)}/>')
            if last:
                parts.append(_text(x, y + high + 15, name, "muted", text_anchor="middle"))
        marks = "".join(part for mark in row.marks for part in _mark(mark, across, up, wide, high))
        parts.append(
            f'<svg x="{left}" y="{y:.0f}" width="{wide}" height="{high}" '
            f'viewBox="0 0 {2 * wide} {2 * high}" font-size="24">{marks}</svg>'
        )
        parts.append(f'<path d="M{left} {y:.0f}v{high}h{wide}" {_stroke("rule", 1)}/>')
        middle = y + high / 2
        turn = {"text_anchor": "middle", "transform": f"rotate(-90 14 {middle:.0f})"}
        parts.append(_text(14, middle, row.y.title, "muted", **turn))
    parts.append(_text(left + wide / 2, bottom + 32, panel.x.title, "muted", text_anchor="middle"))
    return parts


def _values(row: Row, which: str) -> list[NDArray]:
    """What an axis has to show of the marks."""
    found: list[ArrayLike] = []
    for mark in row.marks:
        match mark:
            case Line() | Points():
                found.append(mark.x if which == "x" else mark.y)
                found += [mark.ends] if isinstance(mark, Points) and mark.along == which else []
                found += [[0.0]] if which == "y" and isinstance(mark, Line) and mark.filled else []
            case Band():
                found += [mark.x] if which == "x" else [mark.low, mark.high]
    return [np.asarray(each, float).ravel() for each in found]


def _limits(axis: Axis, values: Sequence[NDArray]) -> tuple[float, float]:
    """The ends of an axis, on a logarithmic one as logarithms: those it has, or room for values."""
    if axis.limits is not None:
        return axis.limits
    every = np.concatenate([np.zeros(0), *values])
    every = every[np.isfinite(every) & ((every > 0) | (axis.kind != "log"))]
    every = np.log10(every) if axis.kind == "log" else every
    low, high = (every.min(), every.max()) if len(every) else (0.0, 1.0)
    room = 0.05 * (high - low) or max(0.05 * abs(high), 1e-9)
    return 0.0 if axis.from_zero else float(low - room), float(high + room)


def _scale(axis: Axis, ends: tuple[float, float], length: float) -> Scale:
    """From values to places along an axis of that length, a negative one upwards."""
    low, high = ends

    def place(values: ArrayLike) -> NDArray:
        given = np.asarray(values, float)
        if axis.kind == "log":
            given = np.log10(np.where(given > 0, given, np.nan))
        share = np.clip((given - low) / ((high - low) or 1.0), -5, 5)
        return length * share - min(length, 0)

    return place


def _ticks(axis: Axis, ends: tuple[float, float]) -> dict[float, str]:
    """The labels of an axis by their values."""
    low, high = sorted(ends)
    if axis.bare:
        return {}
    if axis.ticks:
        inner = math.log10 if axis.kind == "log" else float
        return {at: name for at, name in axis.ticks.items() if low <= inner(at) <= high}
    if axis.kind == "log":
        return {10.0**k: f"{10.0**k:g}" for k in range(math.ceil(low), math.floor(high) + 1)}
    rough = (high - low) / max(axis.count - 1, 1) or 1.0
    size = 10.0 ** math.floor(math.log10(rough))
    step = axis.step or size * next(each for each in (1, 2, 2.5, 5, 10, 20) if each * size >= rough)
    digits = next(k for k in range(12) if k == 11 or math.isclose(round(step, k), step))
    count = range(math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6) + 1)
    if axis.kind == "percent":
        return {k * step: f"{k * step:.0%}" for k in count}
    return {k * step: f"{k * step + 0.0:.{digits}f}".replace("-", "−") for k in count}


def _mark(mark: Mark, across: Scale, up: Scale, wide: int, high: int) -> Iterator[str]:
    """A mark in half pixels, of an area of that width and height in pixels."""
    mark = envelope(mark, 2 * wide)
    match mark:
        case Line():
            x, y = across(mark.x), up(mark.y)
            if mark.filled:
                base = np.full(len(x), float(up(0.0)))
                yield f'<path d="{_area(x, base, y)}" fill="var(--{mark.colour})"/>'
            else:
                look = _stroke(mark.colour, 2 * mark.width, mark.dash)
                yield f'<path d="{_path(x, y)}" {look} stroke-opacity="{mark.alpha}"/>'
        case Band():
            shape = _area(across(mark.x), up(mark.low), up(mark.high))
            yield f'<path d="{shape}" fill="var(--{mark.colour})" fill-opacity="{mark.alpha}"/>'
        case Points():
            yield from _points(mark, across, up)
        case Spans():
            look = f'fill="var(--{mark.colour})" fill-opacity="{mark.alpha}"'
            look += f' stroke="var(--{mark.colour})" stroke-width="{2 * mark.outline}"'
            tall = 2 * high * mark.height
            for start, end in across(np.reshape(mark.intervals, (-1, 2))):
                place = f'x="{start:.0f}" y="{2 * high - tall:.0f}" width="{end - start:.1f}"'
                yield f'<rect {place} height="{tall:.0f}" {look}/>'
        case Dimension():
            x, y = across([mark.start[0], mark.end[0]]), up([mark.start[1], mark.end[1]])
            yield f'<path d="{_path(x, y)}" {_stroke(mark.colour, 8)}/>'
            beside = x.mean() + 2 * mark.beside[0], y.mean() + 2 * mark.beside[1]
            yield _text(*beside, mark.name, font_weight="bold", text_anchor="middle")
        case Heading():
            yield _text(8, float(up(mark.y)) + 8, mark.text, font_weight="bold")


def _points(mark: Points, across: Scale, up: Scale) -> Iterator[str]:
    x, y = across(mark.x), up(mark.y)
    if mark.dash:
        yield f'<path d="{_path(x, y)}" {_stroke(mark.colour, 4, mark.dash)}/>'
    ends = np.reshape(mark.ends, (-1, 2)).T if mark.ends else np.zeros((2, 0))
    low, high = (across if mark.along == "x" else up)(ends)
    both = zip(low, high, y if mark.along == "x" else x, strict=False)
    bars = [
        f"M{a:.0f} {at:.0f}H{b:.0f}" if mark.along == "x" else f"M{at:.0f} {a:.0f}V{b:.0f}"
        for a, b, at in both
        if math.isfinite(a + b + at)
    ]
    if bars:
        yield f'<path d="{"".join(bars)}" {_stroke(mark.colour, 2 * mark.bar_width)}/>'
    for left, top in zip(x, y, strict=True):
        if math.isfinite(left + top):
            yield _symbol(mark.symbol, left, top, mark.size, mark.colour)


def _symbol(name: str, x: float, y: float, size: float, colour: str) -> str:
    """A symbol of that radius, by plotly's names."""
    look = f'fill="var(--{"paper" if name.endswith("-open") else colour})"'
    look += f' stroke="var(--{colour})"'
    if name == "circle":
        return f'<circle cx="{x:.0f}" cy="{y:.0f}" r="{size}" {look}/>'
    shape = f"h{2 * size}v{2 * size}h-{2 * size}z"
    if name == "square":
        return f'<path d="M{x - size:.0f} {y - size:.0f}{shape}" {look}/>'
    return f'<path d="M{x:.0f} {y - size:.0f}l{size} {size}-{size} {size}-{size}-{size}z" {look}/>'


def _stroke(colour: str, width: float, dash: str = "solid") -> str:
    dashes = "" if dash == "solid" else f' stroke-dasharray="{STROKES[dash]}"'
    return f'fill="none" stroke="var(--{colour})" stroke-width="{width:g}"{dashes}'


def _parts(*rows: NDArray) -> Iterator[NDArray]:
    """The columns (2, n) of numbers between those where a row lacks one, as whole half pixels."""
    both = np.stack(rows)
    known = np.flatnonzero(np.isfinite(both).all(axis=0))
    for part in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
        if len(part):
            yield np.rint(both[:, part]).astype(int)


def _path(x: NDArray, y: NDArray) -> str:
    """A line through points, in steps."""
    made = []
    for points in _parts(x, y):
        steps = np.diff(points).T
        moved = steps[steps.any(axis=1)].ravel().tolist()
        made.append(f"M{points[0, 0]} {points[1, 0]}l" + "".join(f"{each:+d}" for each in moved))
    return "".join(each.removesuffix("l") for each in made)


def _area(x: NDArray, low: NDArray, high: NDArray) -> str:
    """The area between two lines."""
    made = []
    for left, under, over in _parts(x, low, high):
        made.append(_path(np.append(left, left[::-1]), np.append(over, under[::-1])) + "z")
    return "".join(made)
