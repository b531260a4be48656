"""The page of an identification: parameters, what is open, errors before and after, residuals.

Belongs here: its figures, tables and texts. Not here: numbers, which `evaluation.identification`
computes, and prose, which is in its template.
"""

from retwin.report.identification.page import identification_page

__all__ = ["identification_page"]
