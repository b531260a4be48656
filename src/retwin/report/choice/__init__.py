"""The page of an updated twin: the candidates, what was taken, and what was predicted.

Belongs here: its figures, tables and sentences. Not here: numbers, which `evaluation.choice`
computes, and other prose, which is in its template.
"""

from retwin.report.choice.page import fit_page
from retwin.report.choice.tables import (
    comparison_table,
    model_sentences,
    parameter_table,
    term_table,
)

__all__ = ["comparison_table", "fit_page", "model_sentences", "parameter_table", "term_table"]
