"""Dwell: on which computer each stage of a robot control pipeline runs, decided while it runs."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import lazy_loader

from dwell.display import Answers, Displayed

# A name is imported when it is used; the stub lists ours.
_ours, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Import a public name at its first use (PEP 562).

    Raises
    ------
    DwellError
        If it needs a package that is not installed; with the command that installs it.
    """
    if name not in __all__:
        # The upper flats may add the name (dwell.ros2).
        return import_module("dwell.model.entry_points").added_name(name)
    try:
        return _ours(name)
    except ModuleNotFoundError as error:
        from dwell.errors import missing_package

        raise missing_package(error) or error from error


def _answers() -> Answers:
    """Return what makes summaries and pictures, imported when something is shown."""
    from dwell.report import answer

    return answer


Displayed.shown_by(_answers)
