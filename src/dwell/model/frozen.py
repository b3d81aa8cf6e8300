"""An immutable mapping, used throughout the model."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import islice
from typing import NoReturn, Protocol, TypeVar

from dwell.model.bounds import require

#: Largest number of names in a shortened list.
SHOWN = 6

K = TypeVar("K")
V = TypeVar("V")


class FrozenDict(dict[K, V]):
    """An immutable ``dict``; it can be hashed and pickled.

    A subclass of ``dict`` is faster than a wrapper, and every decision reads such mappings.
    """

    __slots__ = ()

    def _immutable(self, *_args: object, **_kwargs: object) -> NoReturn:
        raise TypeError(f"{type(self).__name__} cannot be changed; make a new one, as dict(...)")

    __setitem__ = _immutable
    __delitem__ = _immutable
    __ior__ = _immutable
    clear = _immutable
    pop = _immutable
    popitem = _immutable
    setdefault = _immutable
    update = _immutable

    def __hash__(self) -> int:  # type: ignore[override]
        """Hash the content independently of its order."""
        return hash(frozenset(self.items()))

    def __reduce__(self) -> tuple[type, tuple[dict[K, V]]]:
        """Pickle and copy through the constructor."""
        return type(self), (dict(self),)


class Named(Protocol):
    """An item whose name is its key."""

    @property
    def name(self) -> str:
        """The name."""
        ...


def require_names(path: str, items: Mapping[str, Named]) -> None:
    """Raise a ProblemError unless every key is the name of its item."""
    for key, item in items.items():
        require(item.name == key, f"{path}.{key}", item.name, f"named as its key, {key!r}")


def shortened(names: Collection[str], between: str = ", ") -> str:
    """Return names as text; a long list is cut after a few."""
    more = len(names) - SHOWN
    shown = between.join(islice(names, SHOWN))
    return f"{shown}{between}{more} more" if more > 0 else shown or "none"
