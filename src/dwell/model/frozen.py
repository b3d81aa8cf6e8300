"""An immutable mapping: the one container of the model that is not a tuple."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import islice
from typing import NoReturn, Protocol, TypeVar

from dwell.model.bounds import require

#: Names that are shown of many.
SHOWN = 6

K = TypeVar("K")
V = TypeVar("V")


class FrozenDict(dict[K, V]):
    """A ``dict`` that cannot be changed after it is made; it hashes and pickles.

    A subclass of ``dict`` and not a wrapper, because every decision looks things up in it.
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
        """Hash by content, whatever the order."""
        return hash(frozenset(self.items()))

    def __reduce__(self) -> tuple[type, tuple[dict[K, V]]]:
        """Pickle and copy through the constructor, which is allowed to fill it."""
        return type(self), (dict(self),)


class Named(Protocol):
    """An item that carries its own key as its name."""

    @property
    def name(self) -> str:
        """The name."""
        ...


def require_names(path: str, items: Mapping[str, Named]) -> None:
    """Raise a ProblemError unless every key is the name of its item."""
    for key, item in items.items():
        require(item.name == key, f"{path}.{key}", item.name, f"named as its key, {key!r}")


def shortened(names: Collection[str], between: str = ", ") -> str:
    """Return names as text, the first few of many."""
    more = len(names) - SHOWN
    shown = between.join(islice(names, SHOWN))
    return f"{shown}{between}{more} more" if more > 0 else shown or "none"
