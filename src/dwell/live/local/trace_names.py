"""Names of trace files in a cell file that is written to another folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path


def rename_traces(values: object, renamed: Callable[[str], str]) -> None:
    """Rename all trace files in the document of a cell, in place."""
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
    """Make the names of all trace files in the document of a cell relative to a folder, in place.

    Absolute names do not change.
    """
    rename_traces(values, lambda name: (folder / name).as_posix())
