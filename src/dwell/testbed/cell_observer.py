"""What looks on while a cell runs: a class of the cell's own, named by ``live.observer``."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Protocol

from dwell.errors import LiveError

__all__ = ["CellObserver", "load_observer"]


class CellObserver(Protocol):
    """Looks at what a cell controls, in the process that runs the cell.

    It is made as ``Class(folder, begin_ns)``: with the folder of the cell's processes, which stages
    find in the environment variable ``DWELL_WORLD`` as ``folder/world``, and the instant from which
    the cell counts, ns of the monotonic clock.
    """

    def look(self, now_ns: int) -> Mapping[str, float]:
        """Return what there is to see now, by names with units: ``error_mm``; NaN where unknown."""
        ...

    def told(self, origin_ns: int) -> Mapping[str, object]:
        """Return what the run's record shall say, ready for JSON.

        Parameters
        ----------
        origin_ns : int
            First release of the run: where its time begins.
        """
        ...

    def close(self) -> None:
        """Look no more."""
        ...


def load_observer(name: str, beside: Path, folder: Path, begin_ns: int) -> CellObserver:
    """Make an observer.

    Parameters
    ----------
    name : str
        ``package.module:Name``.
    beside : Path
        Folder of the cell file, where its module may be.

    Raises
    ------
    LiveError
        If it cannot be imported or made; the message says what it said.
    """
    module, _, attribute = name.partition(":")
    sys.path.insert(0, str(beside.resolve()))
    try:
        made: CellObserver = getattr(import_module(module), attribute)(folder, begin_ns)
    except Exception as error:
        raise LiveError(f"observer {name}: {type(error).__name__}: {error}") from None
    finally:
        sys.path.remove(str(beside.resolve()))
    return made
