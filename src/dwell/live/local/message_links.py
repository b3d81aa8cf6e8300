"""Links of messages, emulated in the transports of the processes at their ends.

All processes of a testbed without root share one `LinkFile`: for every direction, what it is like
now (`Conditions`), and its backlog. A message meets a link as in the simulator: it begins its
transmission at max(now, end of the one before it), whichever process sent that, takes its bytes at
the rate, and then a delay that is drawn for it. Delays and losses are drawn by streams of each
process's own.

What differs from the simulator: messages of one sender under one key keep their order (a transport
promises it); on a link that retransmits, a lost message is sent again after the time-out without
taking its share of the rate again; and one that would leave more than `LONGEST_WAIT_S` from now is
lost.
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
# Of a direction: how often its conditions have changed, when it is free, its last arrival.
_CHANGES, _FREE_NS, _LAST_NS = range(3)
_WAY = struct.Struct("<3q")
#: What waits longer for its turn is lost.
LONGEST_WAIT_S = 10.0
#: Instead of the arrival of a message that is lost, and of one that the sender has to hold: the
#: direction lets nothing pass, and loses nothing.
LOST, HELD = -1, -2


class LinkFile:
    """Conditions of the links of a testbed: the side that writes them.

    Parameters
    ----------
    path : Path
        Made anew; beside it, a file for the conditions of every direction.
    nodes : sequence of str
    links : sequence of Link
        Directions that are not among them have no delay, loss or limit.
    seed : int
        Seed of delays and losses, in [0, 2**63).

    Raises
    ------
    LiveError
        If it cannot be written.
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
        """Change some conditions of a direction for messages that begin their way from now on.

        Parameters
        ----------
        **changes
            Fields of `Conditions`.

        Raises
        ------
        LiveError
            If there is no such direction or field, or a value is out of its bounds.
        """
        way = source, target
        if way not in self._conditions:
            raise LiveError(f"{self.path}: no link {source}->{target}")
        self._conditions[way] = changed(f"link {source}->{target}", self._conditions[way], changes)
        kind = self._kinds.get(way)
        retransmit_ms = None if kind is None else kind.retransmit_ms
        state = self._conditions[way], retransmit_ms, kind is not None and kind.in_order
        place = _place(self.nodes, source, target)
        # Whoever sees the number reads the file, or a newer one.
        write_whole(_file_of(self.path, place), pickle.dumps(state), durable=False)
        (count,) = struct.unpack_from("<q", self._map, place)
        struct.pack_into("<q", self._map, place, count + 1)

    def close(self) -> None:
        """Write no more; the files stay."""
        self._map.close()


def _size(count: int) -> int:
    """Return how many bytes the directions between so many nodes take."""
    return _WAY.size * count**2


def _place(nodes: Sequence[str], source: str, target: str) -> int:
    """Return where a direction begins in the file."""
    index = nodes.index(source) * len(nodes) + nodes.index(target)
    return HEAD.size + _WAY.size * index


def _file_of(path: Path, place: int) -> Path:
    return path.with_name(f"{path.name}.{place}")


class Way:
    """A direction of a link, as one process meets it.

    Parameters
    ----------
    place : int
        Where the direction begins in the file.
    memory : mmap
        The file.
    seed : (int, int)
        Seed of this process's draws.
    """

    def __init__(self, path: Path, place: int, memory: mmap.mmap, seed: tuple[int, int]) -> None:
        self._path, self._place, self._memory = path, place, memory
        self._draws = Draws(seed)
        self._retransmit_ms: float | None = None
        self._in_order = False
        self._seen = 0
        # Locks of files do not keep a process's own threads apart.
        self._lock = threading.Lock()
        self._file = os.open(path, os.O_RDWR)

    def begin(self, size_bytes: int, now_ns: int) -> int:
        """Let a message begin its way; returns when it arrives, or `LOST` or `HELD`.

        `now_ns` is of the clock that all processes on this computer share.
        """
        with self._lock:
            self._refresh()
            conditions = self._draws.conditions
            # Attempts that are all lost are none: the message waits as while the link is down.
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
        """Read the conditions where they have changed."""
        (count,) = struct.unpack_from("<q", self._memory, self._place)
        if count == self._seen:
            return
        state = _file_of(self._path, self._place).read_bytes()
        conditions, self._retransmit_ms, self._in_order = pickle.loads(state)  # noqa: S301 (our own)
        self._draws.apply(conditions)
        self._seen = count

    def _later(self, field: int, at_ns: int, more_ns: int, most_ns: int | None = None) -> int:
        """Set an instant that all processes share to max(it, at) + more, and return it."""
        place = self._place + 8 * field
        fcntl.lockf(self._file, fcntl.LOCK_EX, 8, place)
        try:
            (known_ns,) = struct.unpack_from("<q", self._memory, place)
            found = max(known_ns, at_ns) + more_ns
            # What is lost for waiting too long takes no time of those behind it.
            if most_ns is None or found - at_ns <= most_ns:
                struct.pack_into("<q", self._memory, place, found)
            return int(found)
        finally:
            fcntl.lockf(self._file, fcntl.LOCK_UN, 8, place)


class LinkEnds:
    """The directions that begin or end at the node of a process.

    Parameters
    ----------
    path : Path
        As `LinkFile` has written it.
    who, node : str
        Process, and its node. One that is started again draws from the beginning.

    Raises
    ------
    LiveError
        If there is no such file, it is another kind of file, or has no such node.
    """

    def __init__(self, path: Path, who: str, node: str) -> None:
        self._memory, names, seed = open_file(path, _KIND, node, _size)
        self.node = node

        def way(source: str, target: str) -> Way:
            words = f"{who}/{source}/{target}".encode()
            stream = int.from_bytes(hashlib.sha256(words).digest()[:8], "little")
            return Way(path, _place(names, source, target), self._memory, (seed, stream))

        others = [name for name in names if name != node]
        #: Those that begin here, by target, and that end here, by source.
        self.to: Mapping[str, Way] = {name: way(node, name) for name in others}
        self.since: Mapping[str, Way] = {name: way(name, node) for name in others}
