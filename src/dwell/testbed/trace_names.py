"""Names of trace files in a cell that is written somewhere else."""

from __future__ import annotations

from pathlib import Path

__all__ = ["move_traces"]


def move_traces(values: object, folder: Path) -> None:
    """Put a folder before the names of all trace files in a cell's plain values, in place.

    Names that are absolute stay as they are.
    """
    if isinstance(values, dict):
        trace = values.get("trace")
        if isinstance(trace, dict) and isinstance(trace.get("file"), str):
            trace["file"] = (folder / trace["file"]).as_posix()
        for value in values.values():
            move_traces(value, folder)
    elif isinstance(values, list):
        for value in values:
            move_traces(value, folder)
