"""Feed: the newest items of a stream, for readers at their own pace."""

from __future__ import annotations

import threading
from collections import deque
from itertools import islice
from typing import Generic, NamedTuple, TypeVar

T = TypeVar("T")


class News(NamedTuple, Generic[T]):
    """New items for a reader.

    Parameters
    ----------
    items : list
        Oldest first.
    upto : int
        Total number of items so far; the argument of the reader's next `Feed.since`.
    dropped : int
        Number of items that left the feed before the reader took them.
    """

    items: list[T]
    upto: int
    dropped: int


class Feed(Generic[T]):
    """The last `most` items of a stream; a slow reader misses items and does not delay the writer.

    Attributes
    ----------
    upto : int
        Total number of items so far.
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
        """Add an item; remove the oldest if the feed is full."""
        with self._lock:
            self._items.append(item)
            self.upto += 1

    def since(self, upto: int) -> News[T]:
        """Return the items after the first `upto` that are still in the feed."""
        with self._lock:
            first = self.upto - len(self._items)
            items = list(islice(self._items, max(upto - first, 0), None))
            return News(items, self.upto, max(first - upto, 0))
