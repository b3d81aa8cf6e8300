"""Dwell: on which computer each stage of a robot control pipeline runs, decided while it runs."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from dwell.display import Answers, Displayed

if TYPE_CHECKING:
    from dwell.cellfile import load
    from dwell.cellfile.fleet_file import load_fleet
    from dwell.errors import DwellError
    from dwell.estimators.placement_search import search
    from dwell.record import Run, open_run
    from dwell.sim import Realisation, draw, simulate, simulate_realisation
    from dwell.sim.fleet import simulate_fleet
    from dwell.version import __version__ as __version__

__all__ = [
    "DwellError",
    "Realisation",
    "Run",
    "draw",
    "load",
    "load_fleet",
    "open_run",
    "search",
    "simulate",
    "simulate_fleet",
    "simulate_realisation",
]

_HOME = {
    "DwellError": "dwell.errors",
    "load": "dwell.cellfile",
    "load_fleet": "dwell.cellfile.fleet_file",
    "Run": "dwell.record",
    "open_run": "dwell.record",
    "search": "dwell.estimators.placement_search",
    "Realisation": "dwell.sim",
    "draw": "dwell.sim",
    "simulate": "dwell.sim",
    "simulate_fleet": "dwell.sim.fleet",
    "simulate_realisation": "dwell.sim",
    "__version__": "dwell.version",
}


def __getattr__(name: str) -> Any:
    """Import a public name at its first use (PEP 562).

    Raises
    ------
    DwellError
        If it needs a package that is not installed; with the command that installs it.
    """
    if name not in _HOME:
        # The upper flats may add the name (dwell.ros2).
        return import_module("dwell.model.entry_points").added_name(name)
    try:
        return getattr(import_module(_HOME[name]), name)
    except ModuleNotFoundError as error:
        from dwell.errors import missing_package

        raise missing_package(error) or error from error


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})


def _answers() -> Answers:
    """Return what makes summaries and pictures, imported when something is shown."""
    from dwell.report import answer

    return answer


Displayed.shown_by(_answers)
