"""Classes by name: ours by a dotted path, other packages' by entry points; imported when asked."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from dwell.errors import DwellError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


def class_at(path: str) -> Any:
    """Import a class of ours from ``module:Class``."""
    module, _, attribute = path.partition(":")
    return getattr(import_module(module), attribute)


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
