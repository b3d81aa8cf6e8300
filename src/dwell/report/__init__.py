"""Reports: pages, text for the terminal, traces of jobs."""

from dwell.report.comparison_page import comparison_html

__all__ = ["comparison_html"]
