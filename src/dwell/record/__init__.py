"""The Run: tables, open, save; the journal of one that is still going on."""

from dwell.record.journal import Columns, Journal
from dwell.record.run import OUTCOMES, SCHEMA_VERSION, Run, open_run, require_free, seal_run

__all__ = [
    "OUTCOMES",
    "SCHEMA_VERSION",
    "Columns",
    "Journal",
    "Run",
    "open_run",
    "require_free",
    "seal_run",
]
