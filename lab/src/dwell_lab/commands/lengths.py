"""Length of the runs of a testbed."""

from __future__ import annotations

from pathlib import Path

import dwell
from dwell.cli.options import require_one_length


def seconds_of_runs(cell: Path, windows: int | None, seconds: float | None) -> float:
    """Return the duration of each run on a testbed; 120 s if neither length is given.

    Raises
    ------
    typer.BadParameter
        If both are given.
    """
    require_one_length(windows, seconds)
    if windows is None:
        return 120.0 if seconds is None else seconds
    from dwell_lab.testbed.run import length_s

    return length_s(dwell.load(cell), windows)
