"""What every transport does, whatever carries the messages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

#: `control` is for what is small and must not wait; `images` for payloads, newest first.
Lane: TypeAlias = Literal["control", "images"]


@dataclass(frozen=True, slots=True)
class Arrival:
    """One message as it arrives.

    Parameters
    ----------
    header : bytes
        Empty where none was sent.
    """

    key: str
    payload: bytes
    header: bytes = b""


Receive: TypeAlias = Callable[[Arrival], None]


class Transport(Protocol):
    """Carries messages by key between the processes of a cell.

    A message is delivered at most once, to every subscriber whose key expression matches and that
    can be reached, or is lost without a word; messages of one sender under one key and on one lane
    arrive in order.
    Nobody is handed what it has put itself, nor what was put before it subscribed. Keys and key
    expressions that are none raise a LiveError.
    """

    def put(
        self, key: str, payload: bytes | memoryview, header: bytes = b"", *, lane: Lane = "control"
    ) -> None:
        """Send a message; returns at once, whatever the receivers do.

        Does nothing once it is closed.
        """
        ...

    def subscribe(self, key: str, receive: Receive) -> None:
        """Have `receive` called with every message under a key expression (``*``, ``**``).

        It is called from a thread of the transport's, one message after another for one lane, and
        must not block.
        """
        ...

    def close(self) -> None:
        """Send and deliver nothing more; safe to call twice."""
        ...
