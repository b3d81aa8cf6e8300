"""Classes by name: Dwell's by a dotted path, other packages' by entry points.

A class is imported at its first use.
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


#: Groups of entry points by which upper flats and other distributions extend Dwell: commands and
#: groups of commands; pages (`dwell.report.added`); warnings of `dwell check` about a cell; checks
#: of `dwell doctor` for a cell or None and a keyring; names in Dwell's packages, as
#: ``study.validate``.
COMMANDS = "dwell.commands"
PAGES = "dwell.pages"
WARNINGS = "dwell.warnings"
CHECKS = "dwell.checks"
NAMES = "dwell.names"
#: Names that dwell-lab adds.
OF_LAB = ("study.Validation", "study.validate")


def class_at(path: str) -> Any:
    """Import a class of Dwell from ``module:Class``."""
    module, _, attribute = path.partition(":")
    return getattr(import_module(module), attribute)


def added(group: str) -> dict[str, Any]:
    """Import and return the objects of a group of entry points, sorted by name."""
    return {name: entry.load() for name, entry in sorted(_declared(group).items())}


def added_name(name: str) -> Any:
    """Return the object that a distribution adds under a name, as ``study.validate``.

    Raises
    ------
    MissingPartError
        If dwell-lab adds the name and is not installed; the message has the command to install it.
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
    """Return Dwell's names, then the names of other packages in a group, sorted."""
    mine = tuple(ours)
    return (*mine, *sorted(_declared(group).keys() - set(mine)))


def class_named(name: str, path: str | None, group: str, what: str, error: type[DwellError]) -> Any:
    """Import the class of a name, Dwell's or else another package's; None if the name is unknown.

    `path` is the path of Dwell's class (see `class_at`), None if Dwell has no such class. `group`
    is the group of entry points of other packages, and `what` the kind of class for the message,
    as ``policy``. Raises an `error` that names the package if its class cannot be imported.
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
    """Find the entry points of a group; a search of the whole path takes milliseconds."""
    from importlib.metadata import entry_points

    return {one.name: one for one in entry_points(group=group)}
