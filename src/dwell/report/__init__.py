"""Reports: pages, text for the terminal, files for papers; nothing heavy is imported here."""

from dwell.report.campaign_page import campaign_html
from dwell.report.comparison_page import comparison_html, comparison_text
from dwell.report.run_page import run_html
from dwell.report.study_page import study_html
from dwell.report.trace_events import trace_events
from dwell.report.validation_page import validation_html, validation_text

__all__ = [
    "campaign_html",
    "comparison_html",
    "comparison_text",
    "run_html",
    "study_html",
    "trace_events",
    "validation_html",
    "validation_text",
]
