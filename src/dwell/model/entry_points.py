"""Classes by name: ours by a dotted path, other packages' by entry points; imported when asked."""

from __future__ import annotations

from collections.abc import Container
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from dwell.errors import DwellError

__all__ = ["class_at", "installed", "loaded"]


def class_at(path: str) -> Any:
    """Import a class of ours.

    Parameters
    ----------
    path : str
        ``module:Class``.
    """
    module, _, attribute = path.partition(":")
    return getattr(import_module(module), attribute)


def installed(group: str, ours: Container[str]) -> dict[str, EntryPoint]:
    """Return what other packages declare in a group, by name; none takes a name of ours."""
    return {one.name: one for one in entry_points(group=group) if one.name not in ours}


def loaded(entry: EntryPoint, what: str, error: type[DwellError]) -> Any:
    """Import what an entry point names.

    Parameters
    ----------
    entry : EntryPoint
    what : str
        What it is, for the message: ``policy``.
    error : type of DwellError

    Raises
    ------
    DwellError
        Of type `error`, if it cannot be imported; the message names the package.
    """
    try:
        return entry.load()
    except Exception as fault:
        package = entry.dist.name if entry.dist is not None else "an unnamed package"
        raise error(
            f"{what} {entry.name!r} of the package {package} ({entry.value}) cannot be imported: "
            f"{type(fault).__name__}: {fault}"
        ) from fault
