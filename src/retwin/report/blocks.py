"""What a page is made of: sections of prose, tables, plots, matrices and folded lists.

A section is made by a small function `(Results) -> Section | None`; None when its data are not
there. The template shows each block by its `kind`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from retwin.report.results import Results

__all__ = [
    "Block",
    "Calculator",
    "Cell",
    "Column",
    "Command",
    "Explorer",
    "Facts",
    "Fold",
    "Forest",
    "Key",
    "Link",
    "Matrices",
    "Matrix",
    "Panel",
    "Plot",
    "Prose",
    "Section",
    "SectionMaker",
    "Table",
]


@dataclass(frozen=True)
class Prose:
    """A paragraph; `quiet` for notes."""

    text: str
    quiet: bool = False
    kind: ClassVar[str] = "prose"


@dataclass(frozen=True)
class Forest:
    """A difference and its interval on an axis, all as shares of the axis' width in percent."""

    low: float
    at: float
    high: float
    zero: float


@dataclass(frozen=True)
class Link:
    """To a place on the page, by its anchor."""

    text: str
    anchor: str


@dataclass(frozen=True)
class Cell:
    """One cell: text, a smaller line under it, emphasis, whose colour it has, links, a picture."""

    text: str
    below: str = ""
    best: bool = False
    source: str = ""
    links: Sequence[Link] = ()
    forest: Forest | None = None
    tone: str = ""


@dataclass(frozen=True)
class Column:
    """Heading of a column; `group` spans neighbours of the same group."""

    text: str
    group: str = ""
    numeric: bool = True
    paper: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of cells; the first cell of a row heads it, a row of one cell heads those below it."""

    title: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    kind: ClassVar[str] = "table"

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Runs of columns of one group: its name and how many columns it spans."""
        runs: list[tuple[str, int]] = []
        for column in self.columns:
            if runs and column.group and runs[-1][0] == column.group:
                runs[-1] = (column.group, runs[-1][1] + 1)
            else:
                runs.append((column.group, 1))
        return runs


@dataclass(frozen=True)
class Key:
    """Entry of a legend: text, colour token, and mark (a line's dash, a symbol, `bar`)."""

    text: str
    colour: str
    mark: str = "solid"


@dataclass(frozen=True)
class Panel:
    """One plotly picture: `data` and `layout`, in which `@name` stands for a colour.

    `narrow` is what of the layout is otherwise where there is little room.
    """

    spec: dict[str, Any]
    alt: str
    title: str = ""
    note: str = ""
    height: int = 340
    narrow: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Plot:
    """A figure of one or more panels; `name` is also that of its PNG.

    A narrow figure has its caption beside it where the screen is wide enough.
    """

    name: str
    caption: str
    panels: Sequence[Panel]
    keys: Sequence[Key] = ()
    narrow: bool = False
    kind: ClassVar[str] = "plot"


@dataclass(frozen=True)
class Matrix:
    """Confusion counts of one source, with each row's shares in whole percent."""

    title: str
    source: str
    below: str
    counts: Sequence[Sequence[int]]
    shares: Sequence[Sequence[int]]


@dataclass(frozen=True)
class Matrices:
    """Confusion matrices side by side."""

    name: str
    caption: str
    classes: Sequence[str]
    matrices: Sequence[Matrix]
    kind: ClassVar[str] = "matrices"


@dataclass(frozen=True)
class Facts:
    """Pairs of a term and what it is, under a heading."""

    title: str
    pairs: Sequence[tuple[str, str]]
    kind: ClassVar[str] = "facts"


@dataclass(frozen=True)
class Command:
    """What is typed into a terminal, to be copied."""

    title: str
    text: str
    kind: ClassVar[str] = "command"


@dataclass(frozen=True)
class Calculator:
    """A form in which a reader sets rates and costs; `content` is what its script looks up."""

    title: str
    caption: str
    content: dict[str, Any]
    kind: ClassVar[str] = "calculator"


@dataclass(frozen=True)
class Explorer:
    """What a reader picks from; `content` is drawn by the page's script."""

    caption: str
    content: dict[str, Any]
    keys: Sequence[Key] = ()
    kind: ClassVar[str] = "explorer"


@dataclass(frozen=True)
class Fold:
    """A list that opens on demand."""

    summary: str
    items: Sequence[str]
    kind: ClassVar[str] = "fold"


Block = Prose | Table | Plot | Matrices | Facts | Command | Fold | Calculator | Explorer


@dataclass(frozen=True)
class Section:
    """A heading, its anchor, and what stands under it."""

    key: str
    title: str
    blocks: Sequence[Block]


SectionMaker = Callable[[Results], Section | None]
