"""The protocol of transports, whatever carries the messages.

A key is chunks with ``/`` between them; in an expression that subscribers match keys with, a chunk
``*`` stands for any one chunk and ``**`` for any number of them. That is the part of Zenoh's key
expressions that is used here.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Literal, Protocol, TypeAlias

from dwell.errors import LiveError

#: `control` is for what is small and must not wait; `images` for payloads, newest first.
Lane: TypeAlias = Literal["control", "images"]

# What Zenoh forbids, and `@` in front, which no wildcard of Zenoh's would match. Names of cells and
# tasks are chunks as they are, with single spaces between their words.
_WORD = r"[^/*$?#\s]+"
_CHUNK = re.compile(rf"(?!@){_WORD}(?: {_WORD})*")


@dataclass(frozen=True, slots=True)
class Arrival:
    """A message as it arrives.

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

    def subscribe(self, key: str, receive: Receive) -> None:
        """Have `receive` called with every message under a key expression (``*``, ``**``).

        It is called from a thread of the transport's, one message after another for one lane, and
        must not block.
        """

    def close(self) -> None:
        """Send and deliver nothing more; safe to call twice."""


@lru_cache(1_024)
def require_key(key: str) -> None:
    """Raise a LiveError unless a message can be sent under a key."""
    for chunk in key.split("/"):
        if not _CHUNK.fullmatch(chunk):
            raise LiveError(
                f"key {key!r}: chunk {chunk!r} is empty, starts with @, or has one of * $ ? # or "
                "white space other than single spaces between words"
            )


def require_expression(expression: str) -> None:
    """Raise a LiveError unless an expression can be subscribed to."""
    chunks = expression.split("/")
    for chunk in chunks:
        if chunk not in ("*", "**") and not _CHUNK.fullmatch(chunk):
            raise LiveError(
                f"key expression {expression!r}: chunk {chunk!r} is neither a plain name nor * "
                "nor **"
            )
    for one, other in pairwise(chunks):
        if one == "**" and other in ("*", "**"):
            raise LiveError(f"key expression {expression!r}: write */** and not {one}/{other}")
