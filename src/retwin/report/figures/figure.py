"""What a figure shows: arrays, labels and units, prepared once for the page and for the PNG.

Colours are names: `c0` to `c7` of the palette, or those of `retwin.report.figures.style.CHROME`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Line:
    """A line through points (n,), NaN for a break; `filled` down to zero."""

    x: ArrayLike
    y: ArrayLike
    name: str
    colour: str
    dash: str = "solid"
    width: float = 1.8
    filled: bool = False
    hover: bool = True
    alpha: float = 1


@dataclass(frozen=True)
class Band:
    """The area between two lines over x (n,)."""

    x: ArrayLike
    low: ArrayLike
    high: ArrayLike
    name: str
    colour: str
    alpha: float = 0.2


@dataclass(frozen=True)
class Points:
    """Symbols at (x, y), with intervals `ends` (n, 2) along an axis, and a line if it has a dash.

    `texts` are shown where a reader points at them.
    """

    x: ArrayLike
    y: ArrayLike
    name: str
    colour: str
    symbol: str = "circle"
    ends: Sequence[tuple[float, float]] = ()
    along: Literal["x", "y"] = "x"
    texts: Sequence[str] = ()
    dash: str = ""
    size: int = 9
    bar_width: float = 2

    @property
    def intervals(self) -> NDArray | None:
        """How far the intervals reach below and above the points (2, n); None without."""
        if not self.ends:
            return None
        middle = np.asarray(self.x if self.along == "x" else self.y, dtype=float)
        low, high = np.transpose(self.ends)
        return np.maximum([middle - low, high - middle], 0)


@dataclass(frozen=True)
class Spans:
    """Intervals (n, 2) of x that are shaded, from the bottom to a share of the height."""

    intervals: Sequence[tuple[float, float]]
    colour: str = "grid"
    alpha: float = 1
    height: float = 1
    outline: float = 0


@dataclass(frozen=True)
class Dimension:
    """A thick line from `start` to `end` with a name so many pixels beside its middle."""

    start: tuple[float, float]
    end: tuple[float, float]
    name: str
    beside: tuple[float, float]
    colour: str = "c1"


@dataclass(frozen=True)
class Heading:
    """A bold text at the left end of the x axis, at `y`."""

    text: str
    y: float


Mark = Line | Band | Points | Spans | Dimension | Heading


@dataclass(frozen=True)
class Axis:
    """An axis.

    Attributes
    ----------
    label, unit : str
        The quantity, and its unit or "".
    limits : (float, float)
        First and last value; None for what the marks need.
    kind : str
        "number"; "share", with one decimal; "percent"; "log"; "names", whose `ticks` are texts.
    step : float
        Distance of ticks.
    ticks : mapping of float to str
        The ticks.
    count : int
        Ticks at most, where neither is given.
    from_zero : bool
        Whether the axis begins at 0.
    bare : bool
        Whether ticks have no labels.

    """

    label: str
    unit: str = ""
    limits: tuple[float, float] | None = None
    kind: Literal["number", "share", "percent", "log", "names"] = "number"
    step: float | None = None
    ticks: Mapping[float, str] = field(default_factory=dict)
    count: int = 6
    from_zero: bool = False
    bare: bool = False

    @property
    def title(self) -> str:
        """The quantity with its unit."""
        return self.label if self.unit in ("", "1") else f"{self.label}, {self.unit}"


@dataclass(frozen=True)
class Row:
    """Marks on a y axis."""

    y: Axis
    marks: Sequence[Mark]

    @property
    def drawn(self) -> list[Mark]:
        """The marks, with no more samples than can be seen."""
        return list(map(envelope, self.marks))


@dataclass(frozen=True)
class Panel:
    """One or two rows of marks above a common x axis; `height` in pixels of the page.

    `alt` describes the panel to readers who do not see it. Where there is little room, the tick
    labels of the y axis are left out if `narrow_bare`.
    """

    x: Axis
    rows: Sequence[Row]
    alt: str
    title: str = ""
    height: int = 340
    narrow_bare: bool = False


@dataclass(frozen=True)
class Key:
    """An entry of the legend: a text, a colour, and a mark (a dash, a symbol, `bar`)."""

    text: str
    colour: str
    mark: str = "solid"


@dataclass(frozen=True)
class Figure:
    """Panels under a legend.

    Attributes
    ----------
    name : str
        That of its PNG, and of its element on the page.
    panels : sequence of Panel
        The panels, in the order in which they are read.
    keys : sequence of Key
        The entries of the legend; none for a figure without a legend.
    source : str
        The source that it is about; "" for several.
    columns : int
        Panels side by side in the PNG, at most.
    narrow : bool
        Whether its caption stands beside it on the page where there is room.
    title : str
        A heading of the PNG.

    """

    name: str
    panels: Sequence[Panel]
    keys: Sequence[Key] = ()
    source: str = ""
    columns: int = 3
    narrow: bool = False
    title: str = ""


@dataclass(frozen=True)
class Matrix:
    """Confusion counts of one source, their shares of each row, and how many are correct."""

    title: str
    source: str
    counts: Sequence[Sequence[int]]
    shares: NDArray
    correct: int
    total: int


@dataclass(frozen=True)
class Matrices:
    """Confusion matrices side by side."""

    name: str
    classes: Sequence[str]
    matrices: Sequence[Matrix]


def draw_bands(x: ArrayLike, quantiles: ArrayLike, colour: str, alpha: float = 0.4) -> list[Mark]:
    """The 90 % and 50 % bands of draws, from quantiles (5, n) at 5, 25, 50, 75 and 95 %."""
    rows = np.asarray(quantiles)
    return [
        Band(x, rows[0], rows[4], "90 % of the draws", colour, 0.2),
        Band(x, rows[1], rows[3], "50 % of the draws", colour, alpha),
    ]


def outline(edges: NDArray, shares: NDArray) -> tuple[NDArray, NDArray]:
    """The outline (x, y) of a histogram's shares (n,) between edges (n + 1,), from zero to zero."""
    return np.repeat(edges, 2), np.concatenate([[0.0], np.repeat(shares, 2), [0.0]])


def bar(edges: NDArray, shares: NDArray, name: str, colour: str) -> Line:
    """A filled histogram."""
    return Line(*outline(edges, shares), name, colour, width=0, filled=True)


def record_panel(
    times: NDArray, name: str, unit: str, marks: Sequence[Mark], title: str = "", height: int = 300
) -> Panel:
    """A channel over time, by default with its name as the title."""
    title, count = title or name, 4 if height < 300 else 8
    x = Axis("time", "s", (float(times[0]), float(times[-1])), count=count)
    return Panel(x, [Row(Axis(name, unit), marks)], f"{title} over time", title, height=height)


def envelope(mark: Mark, *, max_points: int = 4000) -> Mark:
    """A line or a band of very many samples as its extremes in groups, so that no peak is lost.

    Parameters
    ----------
    max_points : int, default 4000
        Samples beyond which a line is drawn as the smallest and the largest value of groups.

    """
    if not isinstance(mark, Line | Band) or len(np.asarray(mark.x)) <= max_points:
        return mark
    x = np.asarray(mark.x, dtype=float)
    if np.any(np.diff(x) < 0):
        return mark
    starts = np.linspace(0, len(x), max_points // 2 + 1).astype(int)[:-1]

    def extremes(least: ArrayLike, greatest: ArrayLike) -> list[NDArray]:
        pairs = ((np.fmin, least), (np.fmax, greatest))
        return [each.reduceat(np.asarray(values, float), starts) for each, values in pairs]

    if isinstance(mark, Band):
        low, high = extremes(mark.low, mark.high)
        return replace(mark, x=x[starts], low=low, high=high)
    y = np.stack(extremes(mark.y, mark.y), axis=1).ravel()
    return replace(mark, x=np.repeat(x[starts], 2), y=y)
