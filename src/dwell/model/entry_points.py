"""Classes by name: ours by a dotted path, those of other packages by entry points.

They are imported when they are needed.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from dwell.errors import INSTALL_LAB, DwellError, MissingPartError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


#: Groups of what the upper flats, and other distributions, add: commands and groups of commands;
#: pages (`dwell.report.added`); warnings of `dwell check`, of a cell; what `dwell doctor` looks at,
#: for a cell or None and a keyring; names in our packages, as ``study.validate``.
COMMANDS = "dwell.commands"
PAGES = "dwell.pages"
WARNINGS = "dwell.warnings"
CHECKS = "dwell.checks"
NAMES = "dwell.names"
#: Names that dwell-lab adds.
OF_LAB = ("study.Validation", "study.validate")


def class_at(path: str) -> Any:
    """Import a class of ours from ``module:Class``."""
    module, _, attribute = path.partition(":")
    return getattr(import_module(module), attribute)


def added(group: str) -> dict[str, Any]:
    """Return all that a group of entry points adds, by name in order; all of it is imported."""
    return {name: entry.load() for name, entry in sorted(_declared(group).items())}


def added_name(name: str) -> Any:
    """Return the object that a distribution adds to ours under a name, as ``study.validate``.

    Raises
    ------
    MissingPartError
        If dwell-lab adds it, which is not installed; with the command that installs it.
    AttributeError
        If nothing adds the name.
    """
    entry = _declared(NAMES).get(name)
    if entry is not None:
        return entry.load()
    if name in OF_LAB:
        raise MissingPartError(f"{name} of the package dwell needs dwell-lab; {INSTALL_LAB}")
    raise AttributeError(f"module 'dwell' has no attribute {name!r}")


def names_with(ours: Iterable[str], group: str) -> tuple[str, ...]:
    """Return our names, then those that other packages declare in a group, by name."""
    mine = tuple(ours)
    return (*mine, *sorted(_declared(group).keys() - set(mine)))


def class_named(name: str, path: str | None, group: str, what: str, error: type[DwellError]) -> Any:
    """Import the class of a name: ours, or else another package's.

    Parameters
    ----------
    path : str, optional
        Path of our class, as `class_at` takes it; None where no class of ours has the name.
    group : str
        Group of the entry points of other packages.
    what : str
        Kind of the class, for the message: ``policy``.

    Returns
    -------
    type or None
        None where there is none of that name.

    Raises
    ------
    DwellError
        An `error`, if the class of another package cannot be imported; the message names the
        package.
    """
    if path is not None:
        return class_at(path)
    entry = _declared(group).get(name)
    if entry is None:
        return None
    try:
        return entry.load()
    except Exception as fault:
        package = entry.dist.name if entry.dist is not None else "an unnamed package"
        raise error(
            f"{what} {entry.name!r} of the package {package} ({entry.value}) cannot be imported: "
            f"{type(fault).__name__}: {fault}"
        ) from fault


def _declared(group: str) -> Mapping[str, EntryPoint]:
    return _found(group, tuple(sys.path))


@lru_cache(maxsize=8)
def _found(group: str, path: tuple[str, ...]) -> Mapping[str, EntryPoint]:
    """Look for entry points: milliseconds, in which all that is on the path is looked through."""
    from importlib.metadata import entry_points

    return {one.name: one for one in entry_points(group=group)}
