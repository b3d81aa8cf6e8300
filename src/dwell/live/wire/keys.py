"""Keys of the messages between the processes of a cell, and the form of a channel."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Generic, TypeAlias, TypeVar

import msgspec

from dwell.live.wire.wiring import Kind
from dwell.model import Problem

MAIN, SHADOW = "main", "shadow"
#: Signing name of the controller; other processes sign with the name of their node.
CONTROLLER = "controller"

T = TypeVar("T", bound=msgspec.Struct)
#: Chunks of a key after its word, with its permitted senders: names of nodes, and `CONTROLLER`.
Senders: TypeAlias = Iterable[tuple[tuple[str, ...], Iterable[str]]]


@dataclass(frozen=True, slots=True, eq=False)
class Channel(Generic[T]):
    """One kind of message.

    Parameters
    ----------
    word : str
        First word of its keys.
    payload : type
        Type of the message, or of its header if bytes of a stage follow; `Struct` for no content.
    senders : callable
        Yields the permitted senders, by the chunks of the key after the word. Cell files do not
        list the operators and observers, who send `ASK` and `LOOK`.
    receivers : tuple of str
        Kinds of processes that subscribe to it. `Pulse` subscribes to beats.
    chunks : int
        Number of chunks of its keys after the word.
    signer : callable, optional
        Returns the required signer of a message; None for messages without a signature.
    twice : bool
        Whether it is sent twice, directly and over the detour.
    """

    word: str
    payload: type[T]
    senders: Callable[[Problem], Senders]
    receivers: tuple[Kind, ...] = ()
    chunks: int = 0
    signer: Callable[[Problem, T], str] | None = None
    twice: bool = False


class Keys:
    """Keys of one cell."""

    def __init__(self, cell: str) -> None:
        self.root = f"dwell/{cell}"
        self._below, self._detoured = f"{self.root}/", f"{self.root}/detour/"

    def of(self, channel: Channel[Any], *chunks: str) -> str:
        """Return the key of a message, or a key expression if a chunk is ``*``."""
        return "/".join((self.root, channel.word, *chunks))

    def all(self, channel: Channel[Any]) -> str:
        """Return the key expression of all messages of a channel."""
        return self.of(channel, *["*"] * channel.chunks)

    def relay(self, key: str) -> str:
        """Copy of a message, sent to the relay; ``**`` below the root for all."""
        return f"{self.root}/relay/{key.removeprefix(self._below)}"

    def detour(self, key: str) -> str:
        """Copy of a message, received over the detour."""
        return f"{self._detoured}{key.removeprefix(self._below)}"

    def came_directly(self, key: str) -> bool:
        """Whether a message did not come over the detour."""
        return not key.startswith(self._detoured)

    def word(self, key: str) -> str:
        """Return the word of a channel: the first chunk of a key after any ``detour``."""
        return key.removeprefix(self._below).removeprefix("detour/").partition("/")[0]
