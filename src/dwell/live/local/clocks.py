"""Clocks that are wrong on purpose: for trials in which nodes' clocks jump or drift.

All nodes of a cell on one computer read one clock, which nobody may set. The processes of a node
that `dwell.live.local.process` starts add to it what a file says of that node, and whoever made the
file changes that while they run.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

from dwell.errors import LiveError
from dwell.live.local.mapped_file import HEAD, make_file, open_file

PPB = 1_000_000_000

_KIND = "clocks"
# Which of the two settings holds. Both: since when, ahead by how much then, and by what rate since.
_TURN = struct.Struct("<Q")
_SETTING = struct.Struct("<qqq")
_NODE_BYTES = _TURN.size + 2 * _SETTING.size


class ClockFile:
    """Faults of the nodes' clocks: the side that writes them.

    A setting is written beside the one that holds, which then gives way to it at once: who reads
    sees the one or the other.

    Parameters
    ----------
    path : Path
        Made anew; processes that have one of this name open keep it.
    nodes : sequence of str
    clock : callable
        The true clock, that of the processes.

    Raises
    ------
    LiveError
        If it cannot be written.
    """

    def __init__(self, path: Path, nodes: Sequence[str], clock: Callable[[], int]) -> None:
        self.path, self.nodes, self._clock = path, tuple(nodes), clock
        self._map = make_file(path, _KIND, self.nodes, _NODE_BYTES * len(self.nodes))

    def set(self, node: str, *, jump_ns: int = 0, drift_ppb: int = 0) -> int:
        """Have a node's clock jump now, and drift from now on; returns its offset, ns.

        Parameters
        ----------
        jump_ns : int
            Added to what it is ahead by already.
        drift_ppb : int
            Instead of the drift before.

        Raises
        ------
        LiveError
            If there is no such node.
        """
        if node not in self.nodes:
            raise LiveError(f"{self.path}: no node {node}; it has {', '.join(self.nodes)}")
        begin = HEAD.size + _NODE_BYTES * self.nodes.index(node)
        turn, since_ns, ahead_ns, ppb = _read(self._map, begin)
        now_ns = self._clock()
        ahead_ns += (now_ns - since_ns) * ppb // PPB + jump_ns
        following = 1 - turn
        place = begin + _TURN.size + following * _SETTING.size
        _SETTING.pack_into(self._map, place, now_ns, ahead_ns, drift_ppb)
        _TURN.pack_into(self._map, begin, following)
        return ahead_ns

    def close(self) -> None:
        """Write no more; the file stays."""
        self._map.close()


def wrong_clock(clock: Callable[[], int], path: Path, node: str) -> Callable[[], int]:
    """Return a node's clock: the true one plus the offset in a `ClockFile`.

    Raises
    ------
    LiveError
        If there is no such file, it is another kind of file, or has no such node.
    """
    content, names, _ = open_file(path, _KIND, node, lambda count: _NODE_BYTES * count)
    begin = HEAD.size + _NODE_BYTES * names.index(node)

    def wrong() -> int:
        now_ns = clock()
        _, since_ns, ahead_ns, ppb = _read(content, begin)
        return now_ns + ahead_ns + (now_ns - since_ns) * ppb // PPB

    return wrong


def _read(content: mmap.mmap, begin: int) -> tuple[int, int, int, int]:
    """Return which setting of a node holds, and the setting."""
    (turn,) = _TURN.unpack_from(content, begin)
    return (turn, *_SETTING.unpack_from(content, begin + _TURN.size + turn * _SETTING.size))
