"""Confusion matrices (the paper's figure 3)."""

from __future__ import annotations

import numpy as np

from retwin.report.blocks import Section
from retwin.report.figures.figure import Matrices, Matrix
from retwin.report.labels import class_name, source_name
from retwin.report.study import Study
from retwin.scores.classification import row_shares


def confusion(study: Study) -> Section | None:
    """The confusion matrices of all sources side by side."""
    classes = study.results.classes
    shown = [
        Matrix(
            source_name(name), name, counts, row_shares(counts), np.trace(counts), np.sum(counts)
        )
        for name, source in study.sources.items()
        if (counts := source.confusion) and classes
    ]
    if not shown:
        return None
    figure = Matrices("confusion", [class_name(name) for name in classes], shown)
    biased = any("teady_state_error" in name for name in classes)
    return Section("confusion", "Confusions", {"figure": figure, "biased": biased}, [figure])
