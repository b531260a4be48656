"""The figures of docs/results.md, drawn from the tables of benchmarks/results/arm.md.

    python docs/figures/results.py

Takes seconds and writes docs/images/results-*.png. Real robot, set A, where the page says so.
"""

from __future__ import annotations

import re
from pathlib import Path

from matplotlib.axes import Axes
from style import BLUE, GREEN, INK, MUTED, blank, dress, save, title

from retwin.catalog import SOURCES

PAGE = Path(__file__).parents[2] / "benchmarks" / "results" / "arm.md"
NUMBER = r"[+−-]?\d+(?:\.\d+)?"


def main() -> None:
    """Draw all of them."""
    comparison()


def comparison() -> None:
    """Macro-F1 and healthy recall of the sources of the study in command space."""
    rows = scores_of("## The correction in command space", ("macro-F1", "healthy recall"))
    rows = {**scores_of("## The paper's comparison", ("macro-F1", "healthy recall")), **rows}
    figure = blank(7.6, 0.36 * len(rows) + 1.2)
    for column, (axes, name) in enumerate(
        zip(figure.subplots(1, 2, sharey=True), ("macro-F1", "healthy recall"), strict=True)
    ):
        intervals(axes, {row: values[column] for row, values in rows.items()})
        title(axes, name)
        dress(axes, "", "")
        axes.set_xlim(-0.03, 1.03)
    save(
        "results-comparison", figure, "Real robot, set A: 54 trajectories, 10 runs, 95 % intervals"
    )


def intervals(axes: Axes, rows: dict[str, tuple[float, float, float]]) -> None:
    """A point and an interval per row."""
    for place, (name, (value, low, high)) in enumerate(reversed(rows.items())):
        colour = GREEN if "inversion" in name else BLUE if "rg" in name else MUTED
        axes.plot([low, high], [place, place], color=colour, linewidth=3, alpha=0.45)
        axes.plot(value, place, "o", color=colour, markersize=6)
    titles = [SOURCES[name].title for name in reversed(rows)]
    axes.set_yticks(range(len(rows)), titles, fontsize=9, color=INK)


def scores_of(
    heading: str, columns: tuple[str, ...]
) -> dict[str, tuple[tuple[float, float, float], ...]]:
    """Value, low and high per row and column of the first table below a heading with them."""
    part = PAGE.read_text("utf-8").split(f"\n{heading}", 1)[1].split("\n## ", 1)[0]
    for table in re.findall(r"(?:^\|.*\n)+", part, re.M):
        head, _, *body = (
            [cell.strip() for cell in line.strip("|\n ").split("|")] for line in table.splitlines()
        )
        if set(columns) <= set(head):
            return {
                source[1]: tuple(triple(row[head.index(name)]) for name in columns)
                for row in body
                if (source := re.match(r"`(\w+)`", row[0]))
                and "<br>" in row[head.index(columns[0])]
            }
    raise SystemExit(f"no table with {columns} below {heading}")


def triple(cell: str) -> tuple[float, float, float]:
    """The three numbers of "0.83 ± 0.02<br>0.72–0.91"."""
    mean, interval = cell.split("<br>")
    low, high = re.findall(r"\d+\.\d+", interval)
    return float(re.findall(NUMBER, mean)[0]), float(low), float(high)


if __name__ == "__main__":
    main()
