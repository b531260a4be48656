"""The sections of the page, each a function from the study to its values, tables and figures.

A section is None where its data are missing. Its sentences stand in `templates/KEY.html.j2`. A new
section is one module, one template, and one name in `SECTIONS`.
"""

from __future__ import annotations

from importlib import import_module

from retwin.report.blocks import Section
from retwin.report.study import Study

__all__ = ["SECTIONS", "sections_of"]

SECTIONS = (
    "scores",
    "records",
    "paper",
    "comparisons",
    "confusion",
    "roc",
    "reliability",
    "decisions",
    "simulation",
    "residuals",
    "delta",
    "discrepancy",
    "fidelity",
    "learning",
    "explorer",
    "surrogate",
    "time",
    "card",
)
"""The modules of the sections, in the order of the page; each has a function of its name."""


def sections_of(study: Study) -> list[Section]:
    """Every section whose data are there."""
    made = (getattr(import_module(f"{__name__}.{name}"), name)(study) for name in SECTIONS)
    return [section for section in made if section is not None]
