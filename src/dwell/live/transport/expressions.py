"""Keys of messages, and the expressions that subscribers match them with.

A key is chunks with ``/`` between them; in an expression a chunk ``*`` stands for any one chunk and
``**`` for any number of them. That is the part of Zenoh's key expressions that is used here.
"""

from __future__ import annotations

import re
from itertools import pairwise

from dwell.errors import LiveError

# What Zenoh forbids, and `@` in front, which no wildcard of Zenoh's would match.
_CHUNK = re.compile(r"[^/*$?#@\s][^/*$?#\s]*")


def require_key(key: str) -> None:
    """Raise a LiveError unless a message can be sent under a key."""
    for chunk in key.split("/"):
        if not _CHUNK.fullmatch(chunk):
            raise LiveError(
                f"key {key!r}: chunk {chunk!r} is empty, starts with @, or has white space or one "
                "of * $ ? #"
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
