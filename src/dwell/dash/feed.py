"""Feed: the last of a stream of items, for readers who may fall behind."""

from __future__ import annotations

import threading
from collections import deque
from itertools import islice
from typing import Generic, NamedTuple, TypeVar

T = TypeVar("T")


class News(NamedTuple, Generic[T]):
    """Items that a reader has not had.

    Parameters
    ----------
    items : list
        Oldest first.
    upto : int
        How many the feed has had in all: what the reader asks with the next time.
    dropped : int
        Items between the reader's last and the first of these, which are gone.
    """

    items: list[T]
    upto: int
    dropped: int


class Feed(Generic[T]):
    """Keeps the last `most` items; a writer never waits for a reader.

    Attributes
    ----------
    upto : int
        How many items it has had.
    """

    def __init__(self, most: int) -> None:
        self._items: deque[T] = deque(maxlen=most)
        self.upto = 0
        self._lock = threading.Lock()

    @property
    def last(self) -> T | None:
        """The newest item; None before the first."""
        return self._items[-1] if self._items else None

    def append(self, item: T) -> None:
        """Add an item; the oldest makes room."""
        with self._lock:
            self._items.append(item)
            self.upto += 1

    def since(self, upto: int) -> News[T]:
        """Return the items after the first `upto` ones, as far as they are kept."""
        with self._lock:
            first = self.upto - len(self._items)
            items = list(islice(self._items, max(upto - first, 0), None))
            return News(items, self.upto, max(first - upto, 0))
