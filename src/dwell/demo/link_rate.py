"""How the connections of one direction of a link share its rate.

Bytes take their share as they come, and not only once their message is whole: what a sender spreads
over time does not pile up here. Who finds no room is not read from.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Generic, Literal, Protocol, TypeAlias, TypeVar

__all__ = ["SHARINGS", "Fair", "InOrder", "Rate", "Sharing"]

#: `fifo`: one queue for all connections; `fair`: each its own, and equal shares of the rate, as
#: Linux's fq_codel does it on a network card.
Sharing: TypeAlias = Literal["fifo", "fair"]
SHARINGS: tuple[Sharing, ...] = ("fifo", "fair")

Then: TypeAlias = Callable[[int], None]
# Below that, bytes are what is left of rounding.
NOTHING = 1e-6
READ_BYTES = 65_536
SEGMENT_BYTES = 1448

S = TypeVar("S")
S_contra = TypeVar("S_contra", contravariant=True)


class Clockwork(Protocol):
    """What has something done at an instant."""

    def at(self, instant_ns: int, action: Callable[[int], None], /) -> None: ...


class Rate(Protocol[S_contra]):
    """Lets bytes of several connections pass at a rate."""

    def put(self, stream: S_contra, size_bytes: int, now_ns: int, then: Then | None = None) -> None:
        """Queue bytes of a connection; `then` is told when the last of them has passed."""
        ...

    def full(self, stream: S_contra) -> bool:
        """Whether a connection has to wait with more."""
        ...

    @property
    def chunk_bytes(self) -> int:
        """What is to be read at a time: of a slow link so much that others get their turn."""
        ...

    def change(self, rate_mbps: float, now_ns: int) -> None:
        """Have another rate from now on."""
        ...

    def leave(self, stream: S_contra) -> None:
        """Forget a connection."""
        ...


class _Base(Generic[S]):
    def __init__(
        self, clockwork: Clockwork, queue_bytes: int, resume: Callable[[S | None], None]
    ) -> None:
        self._clockwork, self._queue_bytes, self._resume = clockwork, queue_bytes, resume
        self._ns_per_byte = 0.0

    @property
    def chunk_bytes(self) -> int:
        """Bytes that pass in a millisecond."""
        if self._ns_per_byte == 0:
            return READ_BYTES
        return max(SEGMENT_BYTES, min(round(1e6 / self._ns_per_byte), READ_BYTES))


class InOrder(_Base[S]):
    """One queue: what comes first leaves first.

    Parameters
    ----------
    clockwork : Clockwork
    queue_bytes : int
        Beyond that nobody is read from.
    resume : callable
        Told when there is room again: for a connection, or for all of them (None).
    """

    def __init__(
        self, clockwork: Clockwork, queue_bytes: int, resume: Callable[[S | None], None]
    ) -> None:
        super().__init__(clockwork, queue_bytes, resume)
        self._free_ns = 0
        self._full = False

    def put(self, stream: S, size_bytes: int, now_ns: int, then: Then | None = None) -> None:
        """Queue bytes; `then` is told at once, as nothing can come in between."""
        self._free_ns = max(now_ns, self._free_ns) + round(size_bytes * self._ns_per_byte)
        resume_ns = self._free_ns - round(self._queue_bytes * self._ns_per_byte)
        if resume_ns > now_ns and not self._full:
            self._full = True
            self._clockwork.at(resume_ns, self._empties)
            self._resume(None)
        if then is not None:
            then(self._free_ns)

    def _empties(self, _instant_ns: int) -> None:
        self._full = False
        self._resume(None)

    def full(self, stream: S) -> bool:
        """Whether there is no room for anybody."""
        return self._full

    def change(self, rate_mbps: float, now_ns: int) -> None:
        """Have another rate for what comes from now on."""
        self._ns_per_byte = 8e3 / rate_mbps

    def leave(self, stream: S) -> None:
        """Do nothing: what it has queued keeps its place."""


class Fair(_Base[S]):
    """A queue for each connection; those that are not empty share the rate equally at any instant.

    Parameters
    ----------
    clockwork : Clockwork
    queue_bytes : int
        Of each connection.
    resume : callable
        See `InOrder`.
    """

    def __init__(
        self, clockwork: Clockwork, queue_bytes: int, resume: Callable[[S | None], None]
    ) -> None:
        super().__init__(clockwork, queue_bytes, resume)
        self._lines: dict[S, deque[tuple[float, Then | None]]] = {}
        # Of the first of each line: how much of it is left.
        self._heads: dict[S, float] = {}
        self._waiting: dict[S, int] = {}
        self._full: set[S] = set()
        self._at_ns = 0.0
        self._planned_ns: int | None = None

    def put(self, stream: S, size_bytes: int, now_ns: int, then: Then | None = None) -> None:
        """Queue bytes of a connection behind its own."""
        self._advance(now_ns)
        line = self._lines.get(stream)
        if line is None:
            line = self._lines[stream] = deque()
            self._heads[stream] = size_bytes
        line.append((size_bytes, then))
        self._waiting[stream] = self._waiting.get(stream, 0) + size_bytes
        self._advance(now_ns)  # it may have passed already: nothing, or at no rate
        if self._waiting.get(stream, 0) > self._queue_bytes and stream not in self._full:
            self._full.add(stream)
            self._resume(stream)
        self._plan()

    def full(self, stream: S) -> bool:
        """Whether the connection's own queue is full."""
        return stream in self._full

    def change(self, rate_mbps: float, now_ns: int) -> None:
        """Have another rate from now on, for what waits, too."""
        self._advance(now_ns)
        self._ns_per_byte = 8e3 / rate_mbps
        self._advance(now_ns)
        self._planned_ns = None
        self._plan()

    def leave(self, stream: S) -> None:
        """Forget what it has queued."""
        for kept in (self._lines, self._heads, self._waiting):
            kept.pop(stream, None)
        self._full.discard(stream)

    def _advance(self, now_ns: int) -> None:
        """Let pass what has passed by now."""
        while self._heads:
            each_ns = len(self._heads) * self._ns_per_byte
            least = min(self._heads.values())
            end_ns = self._at_ns + least * each_ns
            if end_ns > now_ns:
                passed = (now_ns - self._at_ns) / each_ns
                for stream in self._heads:
                    self._heads[stream] -= passed
                break
            self._at_ns = end_ns
            for stream in self._heads:
                self._heads[stream] -= least
            for stream in [name for name, left in self._heads.items() if left <= NOTHING]:
                if stream in self._lines:  # what was told before may have closed it
                    self._pass(stream)
        self._at_ns = now_ns

    def _pass(self, stream: S) -> None:
        """The first of a connection's line has passed."""
        line = self._lines[stream]
        size, then = line.popleft()
        self._waiting[stream] -= round(size)
        if line:
            self._heads[stream] = line[0][0]
        else:
            for kept in (self._lines, self._heads, self._waiting):
                del kept[stream]
        if stream in self._full and self._waiting.get(stream, 0) <= self._queue_bytes:
            self._full.discard(stream)
            self._resume(stream)
        if then is not None:
            then(round(self._at_ns))

    def _plan(self) -> None:
        """Look again when the next has passed."""
        if not self._heads:
            return
        each_ns = len(self._heads) * self._ns_per_byte
        next_ns = int(self._at_ns + min(self._heads.values()) * each_ns) + 1
        if self._planned_ns is None or next_ns < self._planned_ns:
            self._planned_ns = next_ns
            self._clockwork.at(next_ns, self._look)

    def _look(self, instant_ns: int) -> None:
        if self._planned_ns == instant_ns:
            self._planned_ns = None
        self._advance(max(instant_ns, round(self._at_ns)))
        self._plan()
