"""Confusion matrices: what is taken for what (the paper's figure 3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from retwin.report.blocks import Matrices, Matrix, Section
from retwin.report.plots import caption
from retwin.report.results import Results
from retwin.report.words import class_name, order, source_name

__all__ = ["confusion", "recalls"]


def confusion(results: Results) -> Section | None:
    """Confusion matrices side by side (the paper's figure 3)."""
    shown = []
    for source in order(list(results.sources)):
        counts = results.sources[source].confusion
        if counts is None or not results.classes:
            continue
        shares = [[round(100 * share) for share in row] for row in recalls(counts)]
        right = sum(counts[i][i] for i in range(len(counts)))
        total = sum(map(sum, counts))
        below = f"{right} of {total} right ({100 * right / max(total, 1):.0f} %)"
        shown.append(Matrix(source_name(source), source, below, counts, shares))
    if not shown:
        return None
    runs = f"summed over {results.runs} runs" if results.runs > 1 else "of the one run"
    text = (
        f"Counts {runs}, an empty field for none; rows are the true class, columns the answer, "
        "colour the share of the row. A good classifier has only its diagonal; the first row shows "
        "false alarms on healthy trajectories."
    )
    if results.published:
        text += " The paper’s figure 3."
    if any("teady_state_error" in name for name in results.classes):
        text += " M1 is motor 1; bias is a steady-state error."
    names = [class_name(name) for name in results.classes]
    block = Matrices("confusion", caption(results, text), names, shown)
    return Section("confusion", "Confusions", [block])


def recalls(counts: Sequence[Sequence[int]]) -> list[list[float]]:
    """Share of its row that each count is; a class without trajectories has none."""
    table = np.asarray(counts, dtype=float)
    rows: list[list[float]] = (table / np.maximum(table.sum(axis=1, keepdims=True), 1)).tolist()
    return rows
