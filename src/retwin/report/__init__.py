"""A study's results as one self-contained HTML page, and its figures as PNG.

Belongs here: sections, templates, figures. Not here: numbers, which `scores` and `evaluation`
compute; the report reads results and runs nothing.
"""

from retwin.report.page import write_report

__all__ = ["write_report"]
