"""A study's results as one self-contained HTML page, and its figures as PNG."""

from retwin.report.page import write_report

__all__ = ["write_report"]
