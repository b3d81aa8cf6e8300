"""Emulated links of messages, in the transports of the processes at both ends.

All processes of a testbed without root share a `LinkFile`, with the present `Conditions` and the
backlog of each direction. Links work as in the simulator: the transmission of a message begins at
max(now, end of the previous transmission of any process), takes its bytes at the rate, and then a
sampled delay. Each process samples delays and losses from its own streams.

Three differences from the simulator: messages of a sender and key stay in order, as transports
guarantee it. On a link that retransmits, a lost message is sent again after the time-out without
another share of the rate. A message that would wait longer than `LONGEST_WAIT_S` is lost.
"""

from __future__ import annotations

import fcntl
import hashlib
import math
import mmap
import os
import pickle
import struct
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dwell.errors import LiveError
from dwell.files import write_whole
from dwell.live.local.conditions import (
    MOST_ATTEMPTS,
    Conditions,
    Draws,
    changed,
    transmission_ns,
)
from dwell.live.local.mapped_file import HEAD, make_file, open_file
from dwell.model import Link

_KIND = "links"
# Fields of a direction: number of changes of its conditions, end of its last transmission, its
# last arrival.
_CHANGES, _FREE_NS, _LAST_NS = range(3)
_WAY = struct.Struct("<3q")
#: Longest wait of a message for its transmission.
LONGEST_WAIT_S = 10.0
#: Arrival times of a lost message, and of a message that the sender has to hold while a direction
#: is down but loses nothing.
LOST, HELD = -1, -2


class LinkFile:
    """Writer of the conditions of a testbed's links.

    It replaces the file `path`, and writes one file per direction next to it. Directions without a
    link have no delay, loss or limit. `seed` is in [0, 2**63). Raises a LiveError if a file cannot
    be written.
    """

    def __init__(
        self, path: Path, nodes: Sequence[str], links: Sequence[Link] = (), *, seed: int = 0
    ) -> None:
        self.path, self.nodes = path, tuple(nodes)
        self._kinds = {(link.source, link.target): link for link in links}
        self._conditions: dict[tuple[str, str], Conditions] = {}
        self._map = make_file(path, _KIND, self.nodes, _size(len(self.nodes)), seed)
        for source in self.nodes:
            for target in self.nodes:
                if source != target:
                    self._conditions[source, target] = Conditions()
                    self.set(source, target)

    def set(self, source: str, target: str, **changes: Any) -> None:
        """Change some `Conditions` of a direction for all later messages.

        Raises a LiveError if the direction is unknown, or a value is out of bounds.
        """
        way = source, target
        if way not in self._conditions:
            raise LiveError(f"{self.path}: no link {source}->{target}")
        self._conditions[way] = changed(f"link {source}->{target}", self._conditions[way], changes)
        kind = self._kinds.get(way)
        retransmit_ms = None if kind is None else kind.retransmit_ms
        state = self._conditions[way], retransmit_ms, kind is not None and kind.in_order
        place = _place(self.nodes, source, target)
        # Write the file before the number: a reader of the number gets this file or a newer one.
        write_whole(_file_of(self.path, place), pickle.dumps(state), durable=False)
        (count,) = struct.unpack_from("<q", self._map, place)
        struct.pack_into("<q", self._map, place, count + 1)

    def close(self) -> None:
        """Close the map; the files stay."""
        self._map.close()


def _size(count: int) -> int:
    """Return the bytes of all directions between a number of nodes."""
    return _WAY.size * count**2


def _place(nodes: Sequence[str], source: str, target: str) -> int:
    """Return the offset of a direction in the file."""
    index = nodes.index(source) * len(nodes) + nodes.index(target)
    return HEAD.size + _WAY.size * index


def _file_of(path: Path, place: int) -> Path:
    return path.with_name(f"{path.name}.{place}")


class Way:
    """A direction of a link in a process.

    `memory` is the mapped file, `place` the offset of the direction in it, and `seed` the seed of
    this process's samples.
    """

    def __init__(self, path: Path, place: int, memory: mmap.mmap, seed: tuple[int, int]) -> None:
        self._path, self._place, self._memory = path, place, memory
        self._draws = Draws(seed)
        self._retransmit_ms: float | None = None
        self._in_order = False
        self._seen = 0
        # File locks do not exclude other threads of the same process.
        self._lock = threading.Lock()
        self._file = os.open(path, os.O_RDWR)

    def begin(self, size_bytes: int, now_ns: int) -> int:
        """Start a message on the link; return its arrival time, or `LOST` or `HELD`.

        All processes on this computer share the clock of `now_ns`.
        """
        with self._lock:
            self._refresh()
            conditions = self._draws.conditions
            # A link that loses all messages behaves like a link that is down.
            if conditions.down or conditions.loss == 1:
                return LOST if self._retransmit_ms is None else HELD
            sent_ns, took_ns = now_ns, transmission_ns(size_bytes, conditions.rate_mbps)
            if math.isfinite(conditions.rate_mbps):
                sent_ns = self._later(_FREE_NS, now_ns, took_ns, round(LONGEST_WAIT_S * 1e9))
            if sent_ns - now_ns > LONGEST_WAIT_S * 1e9:
                return LOST
            for _ in range(MOST_ATTEMPTS):
                if not self._draws.lose():
                    arrival_ns = sent_ns + self._draws.delay_ns()
                    return self._later(_LAST_NS, arrival_ns, 0) if self._in_order else arrival_ns
                if self._retransmit_ms is None:
                    return LOST
                sent_ns += round(self._retransmit_ms * 1e6) + took_ns
            return LOST

    def _refresh(self) -> None:
        """Read the conditions if they have changed."""
        (count,) = struct.unpack_from("<q", self._memory, self._place)
        if count == self._seen:
            return
        state = _file_of(self._path, self._place).read_bytes()
        conditions, self._retransmit_ms, self._in_order = pickle.loads(state)  # noqa: S301 (our own)
        self._draws.apply(conditions)
        self._seen = count

    def _later(self, field: int, at_ns: int, more_ns: int, most_ns: int | None = None) -> int:
        """Set a shared time to max(time, at) + more, and return it."""
        place = self._place + 8 * field
        fcntl.lockf(self._file, fcntl.LOCK_EX, 8, place)
        try:
            (known_ns,) = struct.unpack_from("<q", self._memory, place)
            found = max(known_ns, at_ns) + more_ns
            # A message that is lost for its long wait does not delay later messages.
            if most_ns is None or found - at_ns <= most_ns:
                struct.pack_into("<q", self._memory, place, found)
            return int(found)
        finally:
            fcntl.lockf(self._file, fcntl.LOCK_UN, 8, place)


class LinkEnds:
    """Directions that begin or end at the node of a process.

    A restarted process repeats its samples from the beginning. Raises a LiveError if the `LinkFile`
    is missing, of another kind, or lacks the node.
    """

    def __init__(self, path: Path, who: str, node: str) -> None:
        self._memory, names, seed = open_file(path, _KIND, node, _size)
        self.node = node

        def way(source: str, target: str) -> Way:
            words = f"{who}/{source}/{target}".encode()
            stream = int.from_bytes(hashlib.sha256(words).digest()[:8], "little")
            return Way(path, _place(names, source, target), self._memory, (seed, stream))

        others = [name for name in names if name != node]
        #: Outgoing directions by target, and incoming directions by source.
        self.to: Mapping[str, Way] = {name: way(node, name) for name in others}
        self.since: Mapping[str, Way] = {name: way(name, node) for name in others}
