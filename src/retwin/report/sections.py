"""The sections of the page, in their order; each is left out when its data are not there."""

from __future__ import annotations

from retwin.report.blocks import SectionMaker
from retwin.report.card import card
from retwin.report.comparisons import comparisons
from retwin.report.confusion import confusion
from retwin.report.costs import time
from retwin.report.decisions import decisions
from retwin.report.discrepancy import discrepancy
from retwin.report.explorer import explorer
from retwin.report.fidelity import fidelity
from retwin.report.learning import learning_curve
from retwin.report.paper import paper
from retwin.report.reliability import reliability
from retwin.report.roc import roc
from retwin.report.scores import further_scores, scores
from retwin.report.simulation import simulation
from retwin.report.surrogate import surrogate

__all__ = ["SECTIONS"]

SECTIONS: tuple[SectionMaker, ...] = (
    scores,
    paper,
    comparisons,
    confusion,
    roc,
    reliability,
    decisions,
    simulation,
    discrepancy,
    fidelity,
    learning_curve,
    explorer,
    surrogate,
    further_scores,
    time,
    card,
)
"""What the page shows, in this order; a new section is one more function in this list."""
