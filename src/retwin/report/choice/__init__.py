"""The page of an updated twin: the candidates, what was taken, and what was predicted.

Belongs here: its figures and tables. Not here: numbers, which `evaluation.choice` computes, and
prose, which is in its template.
"""

from retwin.report.choice.page import fit_page

__all__ = ["fit_page"]
