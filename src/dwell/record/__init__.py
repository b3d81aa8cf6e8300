"""Records of runs: schema and tables, files of finished runs, and journals of live runs."""

from dwell.model.table_columns import Feature
from dwell.record.fleet_run import FleetRun, is_fleet, open_fleet
from dwell.record.journal import Journal
from dwell.record.moves import Move, moves, moves_in
from dwell.record.run import Run, is_run, open_run, require_free, seal_run
from dwell.record.schema import (
    OUTCOME_SENTENCES,
    OUTCOMES,
    REASON_SENTENCES,
    SCHEMA_VERSION,
    Columns,
    Row,
    Types,
    Values,
    column_types,
    frame_of,
    row_of,
    shown_reason,
)
from dwell.record.table_arrays import Names, TableArrays, arrays_of

__all__ = [
    "OUTCOMES",
    "OUTCOME_SENTENCES",
    "REASON_SENTENCES",
    "SCHEMA_VERSION",
    "Columns",
    "Feature",
    "FleetRun",
    "Journal",
    "Move",
    "Names",
    "Row",
    "Run",
    "TableArrays",
    "Types",
    "Values",
    "arrays_of",
    "column_types",
    "frame_of",
    "is_fleet",
    "is_run",
    "moves",
    "moves_in",
    "open_fleet",
    "open_run",
    "require_free",
    "row_of",
    "seal_run",
    "shown_reason",
]
