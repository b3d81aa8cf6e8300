"""Relay batch: small messages that the detour carries together.

The receiver of a bundle reads a bounded length of it (`MAX_CONTROL_BYTES`), or nothing. So a sender
that sends too much, or too often, must leave room for the messages of others.
"""

from __future__ import annotations

from collections import Counter

from dwell.live.messages import MAX_HEADER_BYTES

#: In one bundle at most; more within the time that it is gathered in are dropped.
MOST_MESSAGES = 1_000
#: Of all of them, keys included: two bundles put together are still read.
MOST_BYTES = 100_000
#: Of one key: no sender's messages take the room of all others.
MOST_OF_A_KEY = 32
#: Longer ones are not carried. `Carried` takes no longer keys either.
LONGEST_MESSAGE = MAX_HEADER_BYTES
LONGEST_KEY = 400


class RelayBatch:
    """See the module.

    Parameters
    ----------
    most : int
        Messages in it.
    newest : bool
        Whether only the newest of each key counts.
    """

    def __init__(self, most: int = MOST_MESSAGES, *, newest: bool = False) -> None:
        self._most, self._newest = most, newest
        self._messages: list[tuple[str, bytes]] = []
        self._places: dict[str, int] = {}
        self._of_key: Counter[str] = Counter()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._messages)

    def add(self, key: str, payload: bytes) -> bool:
        """Add a message; False where it is not carried on."""
        if len(key) > LONGEST_KEY or len(payload) > LONGEST_MESSAGE:
            return False
        place = self._places.get(key) if self._newest else None
        if place is not None:
            grown = len(payload) - len(self._messages[place][1])
            if self._bytes + grown > MOST_BYTES:
                return False
            self._bytes += grown
            self._messages[place] = key, payload
            return True
        added = len(key.encode()) + len(payload)
        full = len(self._messages) >= self._most or self._bytes + added > MOST_BYTES
        if full or self._of_key[key] >= MOST_OF_A_KEY:
            return False
        self._bytes += added
        self._of_key[key] += 1
        self._places[key] = len(self._messages)
        self._messages.append((key, payload))
        return True

    def taken(self) -> list[tuple[str, bytes]]:
        """Return the messages, oldest first, and be empty."""
        taken, self._messages = self._messages, []
        self._places.clear()
        self._of_key.clear()
        self._bytes = 0
        return taken
