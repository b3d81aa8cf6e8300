"""Transport: the interface between the roles of a cell and the network.

A key is a sequence of chunks with ``/`` between them. In the key expression of a subscriber a chunk
``*`` matches any single chunk, and ``**`` any number of chunks. This is a subset of Zenoh's key
expressions.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Literal, Protocol, TypeAlias

from dwell.errors import LiveError

#: `control` carries small, urgent messages; `images` carries large payloads, newest first.
Lane: TypeAlias = Literal["control", "images"]

# Excludes the characters that Zenoh forbids, and a leading `@`, which Zenoh's wildcards do not
# match. Names of cells and tasks are chunks, with single spaces between their words.
_WORD = r"[^/*$?#\s]+"
_CHUNK = re.compile(rf"(?!@){_WORD}(?: {_WORD})*")


@dataclass(frozen=True, slots=True)
class Arrival:
    """A received message; `header` is empty if it was sent without a header."""

    key: str
    payload: bytes
    header: bytes = b""


Receive: TypeAlias = Callable[[Arrival], None]


class Transport(Protocol):
    """Carries messages by key between the processes of a cell.

    A message is delivered at most once to every reachable subscriber with a matching key
    expression, or is lost without an error. Messages of one sender, key and lane arrive in order.
    A process does not receive its own messages, nor messages from before its subscription. Invalid
    keys and key expressions raise a LiveError.
    """

    def put(
        self, key: str, payload: bytes | memoryview, header: bytes = b"", *, lane: Lane = "control"
    ) -> None:
        """Send a message and return without waiting for receivers; no effect after `close`."""

    def subscribe(self, key: str, receive: Receive) -> None:
        """Call `receive` with every message under a key expression (``*``, ``**``).

        A thread of the transport calls it, with one message at a time per lane. It must not block.
        """

    def close(self) -> None:
        """Stop sending and delivering messages; safe to call twice."""


@lru_cache(1_024)
def require_key(key: str) -> None:
    """Raise a LiveError if a key is invalid."""
    for chunk in key.split("/"):
        if not _CHUNK.fullmatch(chunk):
            raise LiveError(
                f"key {key!r}: chunk {chunk!r} is empty, starts with @, or has one of * $ ? # or "
                "white space other than single spaces between words"
            )


def require_expression(expression: str) -> None:
    """Raise a LiveError if a key expression is invalid."""
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
