"""The sections of the page, each a function from the study to its values, tables and figures.

A section is None where its data are missing. Its sentences stand in `templates/KEY.html.j2`. A new
section is one module, one template, and one line of `SECTIONS`.
"""

from __future__ import annotations

from collections.abc import Callable

from retwin.report.blocks import Section
from retwin.report.sections.card import card
from retwin.report.sections.comparisons import comparisons
from retwin.report.sections.confusion import confusion
from retwin.report.sections.costs import time
from retwin.report.sections.decisions import decisions
from retwin.report.sections.delta import delta
from retwin.report.sections.discrepancy import discrepancy
from retwin.report.sections.explorer import explorer
from retwin.report.sections.fidelity import fidelity
from retwin.report.sections.learning import learning
from retwin.report.sections.paper import paper
from retwin.report.sections.reliability import reliability
from retwin.report.sections.residuals import residuals
from retwin.report.sections.roc import roc
from retwin.report.sections.scores import further_scores, scores
from retwin.report.sections.simulation import simulation
from retwin.report.sections.surrogate import surrogate
from retwin.report.study import Study

__all__ = ["SECTIONS", "sections_of"]

SECTIONS: tuple[Callable[[Study], Section | None], ...] = (
    scores,
    paper,
    comparisons,
    confusion,
    roc,
    reliability,
    decisions,
    simulation,
    residuals,
    delta,
    discrepancy,
    fidelity,
    learning,
    explorer,
    surrogate,
    further_scores,
    time,
    card,
)
"""In the order of the page."""


def sections_of(study: Study) -> list[Section]:
    """Every section whose data are there."""
    return [section for make in SECTIONS if (section := make(study)) is not None]
