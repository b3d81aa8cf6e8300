"""Names of trace files in a cell that is written somewhere else."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path


def rename_traces(values: object, renamed: Callable[[str], str]) -> None:
    """Give all trace files in a cell's plain values another name, in place."""
    if isinstance(values, dict):
        trace = values.get("trace")
        if isinstance(trace, dict) and isinstance(trace.get("file"), str):
            trace["file"] = renamed(trace["file"])
        for value in values.values():
            rename_traces(value, renamed)
    elif isinstance(values, list):
        for value in values:
            rename_traces(value, renamed)


def move_traces(values: object, folder: Path) -> None:
    """Put a folder before the names of all trace files in a cell's plain values, in place.

    Names that are absolute stay as they are.
    """
    rename_traces(values, lambda name: (folder / name).as_posix())
