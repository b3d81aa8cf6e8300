"""Relay batch: small messages that the detour carries together.

The receiver of a bundle reads a bounded length of it (`MAX_CONTROL_BYTES`), or nothing. So a sender
that sends too much, or too often, must leave room for the messages of others.
"""

from __future__ import annotations

from collections import Counter

from dwell.live.wire.messages import MAX_HEADER_BYTES

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
        # By key and number; one number is enough where the newest of a key counts.
        self._messages: dict[tuple[str, int], bytes] = {}
        self._of_key: Counter[str] = Counter()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._messages)

    def add(self, key: str, payload: bytes) -> bool:
        """Add a message; False where it is not carried on."""
        if len(key) > LONGEST_KEY or len(payload) > LONGEST_MESSAGE:
            return False
        place = key, 0 if self._newest else self._of_key[key]
        before = self._messages.get(place)
        grown = len(payload) + (len(key.encode()) if before is None else -len(before))
        most = before is None and len(self._messages) >= self._most
        if most or place[1] >= MOST_OF_A_KEY or self._bytes + grown > MOST_BYTES:
            return False
        self._bytes += grown
        self._of_key[key] += 1
        self._messages[place] = payload
        return True

    def taken(self) -> list[tuple[str, bytes]]:
        """Return the messages, oldest first, and be empty."""
        taken = [(key, payload) for (key, _), payload in self._messages.items()]
        self._messages.clear()
        self._of_key.clear()
        self._bytes = 0
        return taken
