"""Reports: pages, text for the terminal, traces of jobs; nothing heavy is imported here."""

from dwell.report.comparison_page import comparison_html
from dwell.report.comparison_text import comparison_text
from dwell.report.run_page import run_html
from dwell.report.trace_events import trace_events
from dwell.report.validation_page import validation_html
from dwell.report.validation_text import validation_text

__all__ = [
    "comparison_html",
    "comparison_text",
    "run_html",
    "trace_events",
    "validation_html",
    "validation_text",
]
