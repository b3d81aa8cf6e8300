"""Cell files, and the traces they name, read into a Problem; nothing heavy is imported here."""

from dwell.cellfile.cell import from_document, from_record, load, load_without_traces
from dwell.cellfile.json_schema import schema

__all__ = ["from_document", "from_record", "load", "load_without_traces", "schema"]
