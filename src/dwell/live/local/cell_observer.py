"""Observer of a cell that runs: a class of the cell's own, named by ``live.observer``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from dwell.errors import LiveError
from dwell.model import Problem
from dwell.model.user_classes import import_user_module


class CellObserver(Protocol):
    """Looks at what a cell controls, in the process that runs the cell.

    It is made as ``Class(folder, begin_ns)``: with the folder of the cell's processes, which stages
    find in the environment variable ``DWELL_WORLD`` as ``folder/world``, and the instant from which
    the cell counts, ns of the monotonic clock.
    """

    def look(self, now_ns: int) -> Mapping[str, float]:
        """Return values seen now, by names with units: ``error_mm``; NaN where unknown."""

    def told(self, origin_ns: int) -> Mapping[str, object]:
        """Return notes for the run's record, ready for JSON.

        Parameters
        ----------
        origin_ns : int
            First release of the run: where its time begins.
        """

    def close(self) -> None:
        """Look no more."""


def load_observer(name: str, problem: Problem, folder: Path, begin_ns: int) -> CellObserver:
    """Make an observer.

    Parameters
    ----------
    name : str
        ``package.module:Name``.
    problem : Problem
        Its module may be in the folder of the cell file.

    Raises
    ------
    LiveError
        If it cannot be imported or made; the message says what it said.
    """
    who = f"observer {name}"
    module, _, attribute = name.partition(":")
    found = import_user_module(module, problem.folder, who, LiveError)
    try:
        made: CellObserver = getattr(found, attribute)(folder, begin_ns)
    except Exception as error:
        raise LiveError(f"{who}: {type(error).__name__}: {error}") from None
    return made
