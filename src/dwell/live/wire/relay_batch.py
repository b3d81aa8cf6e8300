"""Relay batch: small messages that the relay sends together.

A receiver rejects a batch above a length limit (`MAX_CONTROL_BYTES`). Limits per key and per batch
leave room for other senders if one sends too much or too often.
"""

from __future__ import annotations

from collections import Counter

from dwell.live.wire.messages import MAX_HEADER_BYTES

#: Largest number of messages in a batch; more are dropped.
MOST_MESSAGES = 1_000
#: Largest size of a batch with its keys; two batches together are still below the limit.
MOST_BYTES = 100_000
#: Largest number of messages with one key, to leave room for other keys.
MOST_OF_A_KEY = 32
#: Longest message and key of a batch. `Carried` limits keys to the same length.
LONGEST_MESSAGE = MAX_HEADER_BYTES
LONGEST_KEY = 400


class RelayBatch:
    """See the module; at most `most` messages, with `newest` only the newest of each key."""

    def __init__(self, most: int = MOST_MESSAGES, *, newest: bool = False) -> None:
        self._most, self._newest = most, newest
        # By key and number; the number is always 0 if only the newest of a key counts.
        self._messages: dict[tuple[str, int], bytes] = {}
        self._of_key: Counter[str] = Counter()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._messages)

    def add(self, key: str, payload: bytes) -> bool:
        """Add a message; return False if it is dropped."""
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
        """Return the messages, oldest first, and clear the batch."""
        taken = [(key, payload) for (key, _), payload in self._messages.items()]
        self._messages.clear()
        self._of_key.clear()
        self._bytes = 0
        return taken
