"""The Run: tables, open, save."""

from dwell.record.run import OUTCOMES, SCHEMA_VERSION, Run, open_run, require_free

__all__ = ["OUTCOMES", "SCHEMA_VERSION", "Run", "open_run", "require_free"]
