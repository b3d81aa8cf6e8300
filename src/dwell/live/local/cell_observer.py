"""Observer of a running cell: a user's class, which ``live.observer`` names."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from dwell.errors import LiveError
from dwell.model import Problem
from dwell.model.user_classes import import_user_module


class CellObserver(Protocol):
    """Observes the world that a cell controls, in the process that runs the cell.

    Dwell makes it as ``Class(folder, begin_ns)``, with the folder of the cell's processes and the
    begin of the cell in ns of the monotonic clock. Stages get ``folder/world`` in the environment
    variable ``DWELL_WORLD``.
    """

    def look(self, now_ns: int) -> Mapping[str, float]:
        """Return present values by names with units, such as ``error_mm``; NaN if unknown."""

    def told(self, origin_ns: int) -> Mapping[str, object]:
        """Return notes for the run's record as JSON values; `origin_ns` is the first release."""

    def close(self) -> None:
        """End the observation."""


def load_observer(name: str, problem: Problem, folder: Path, begin_ns: int) -> CellObserver:
    """Make the observer ``package.module:Name``, whose module may be next to the cell file.

    Raises a LiveError with the reason if it cannot be imported or made.
    """
    who = f"observer {name}"
    module, _, attribute = name.partition(":")
    found = import_user_module(module, problem.folder, who, LiveError)
    try:
        made: CellObserver = getattr(found, attribute)(folder, begin_ns)
    except Exception as error:
        raise LiveError(f"{who}: {type(error).__name__}: {error}") from None
    return made
