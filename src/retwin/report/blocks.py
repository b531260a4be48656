"""What sections hand to their templates: tables, and the section itself."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from retwin.report.figures.figure import Figure, Matrices


@dataclass(frozen=True)
class Forest:
    """A difference and its interval, in percent of the width of an axis with a line at zero."""

    low: float
    at: float
    high: float
    zero: float


@dataclass(frozen=True)
class Link:
    """A link to an anchor of the page."""

    text: str
    anchor: str


@dataclass(frozen=True)
class Cell:
    """A cell: text, a smaller line below it, emphasis, and the source whose colour it has.

    `paper` is the paper's figure, in another small line.
    """

    text: str
    below: str = ""
    best: bool = False
    source: str = ""
    links: Sequence[Link] = ()
    forest: Forest | None = None
    tone: str = ""
    paper: str = ""


@dataclass(frozen=True)
class Column:
    """The heading of a column; `group` spans neighbours of the same group."""

    text: str
    group: str = ""
    numeric: bool = True
    paper: bool = False


def text_column(text: str, group: str = "") -> Column:
    """A column of text."""
    return Column(text, group, numeric=False)


def grouped(group: str, *names: str) -> list[Column]:
    """Columns of numbers under a common heading."""
    return [Column(name, group=group) for name in names]


@dataclass(frozen=True)
class Table:
    """Rows of cells; the first cell of a row heads it, a row of one cell heads those below it."""

    title: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]

    def without_empty(self) -> Table:
        """Without the columns and rows whose cells, except the first, are all empty or dashes."""
        whole = [row for row in self.rows if len(row) == 1 or not all(map(_empty, row[1:]))]
        wide = [row for row in whole if len(row) > 1]
        kept = [
            k for k in range(len(self.columns)) if k == 0 or not all(_empty(r[k]) for r in wide)
        ]
        rows = [row if len(row) == 1 else [row[k] for k in kept] for row in whole]
        return Table(self.title, [self.columns[k] for k in kept], rows)

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Adjacent columns of one group: its name and how many columns it spans."""
        runs: list[tuple[str, int]] = []
        for column in self.columns:
            if runs and column.group and runs[-1][0] == column.group:
                runs[-1] = (column.group, runs[-1][1] + 1)
            else:
                runs.append((column.group, 1))
        return runs


def tabulate(title: str, heads: Iterable[object], rows: Iterable[Iterable[object]]) -> Table:
    """A table whose heads and cells may be plain: texts, or what has one.

    The first plain head is that of a column of text, others are those of columns of numbers.
    """
    columns = [
        each if isinstance(each, Column) else Column(str(each), numeric=place > 0)
        for place, each in enumerate(heads)
    ]
    cells = [[each if isinstance(each, Cell) else Cell(str(each)) for each in row] for row in rows]
    return Table(title, columns, cells)


def _empty(cell: Cell) -> bool:
    return cell.text in ("", "–") and not (cell.links or cell.forest or cell.below)


@dataclass(frozen=True)
class Section:
    """A section of the page, laid out by the template `KEY.html.j2`.

    Attributes
    ----------
    key, title : str
        Its anchor and its heading.
    values : mapping
        The variables of its template.
    figures : sequence of Figure or Matrices
        The figures that its template shows.
    further : sequence of Figure
        Figures that are drawn as PNG only.
    scripts : mapping of str to Any
        What the page's script `NAME.js` reads, by name.

    """

    key: str
    title: str
    values: Mapping[str, Any]
    figures: Sequence[Figure | Matrices] = ()
    further: Sequence[Figure] = ()
    scripts: Mapping[str, Any] = field(default_factory=dict)
