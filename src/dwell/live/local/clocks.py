"""Clocks with emulated errors, for trials in which the clocks of nodes jump or drift.

All nodes of a cell on one computer read the same clock, which must not be set. Processes that
`dwell.live.local.process` starts add their node's offset from a file. The writer of the file can
change the offset at any time.
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
# Index of the valid setting; then two settings: start, offset at the start, drift since then.
_TURN = struct.Struct("<Q")
_SETTING = struct.Struct("<qqq")
_NODE_BYTES = _TURN.size + 2 * _SETTING.size


class ClockFile:
    """Writer of the errors of the nodes' clocks; replaces an existing file.

    A new setting is written next to the valid setting, and then becomes valid at once, so a reader
    gets either of them complete. `clock` is the true clock of the processes. Raises a LiveError if
    the file cannot be written.
    """

    def __init__(self, path: Path, nodes: Sequence[str], clock: Callable[[], int]) -> None:
        self.path, self.nodes, self._clock = path, tuple(nodes), clock
        self._map = make_file(path, _KIND, self.nodes, _NODE_BYTES * len(self.nodes))

    def set(self, node: str, *, jump_ns: int = 0, drift_ppb: int = 0) -> int:
        """Add a jump to a node's clock, and replace its drift; return its offset, ns.

        Raises a LiveError if the node is unknown.
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
        """Close the map; the file stays."""
        self._map.close()


def wrong_clock(clock: Callable[[], int], path: Path, node: str) -> Callable[[], int]:
    """Return a node's clock: the true clock plus the offset in a `ClockFile`.

    Raises a LiveError if the file is missing, of another kind, or lacks the node.
    """
    content, names, _ = open_file(path, _KIND, node, lambda count: _NODE_BYTES * count)
    begin = HEAD.size + _NODE_BYTES * names.index(node)

    def wrong() -> int:
        now_ns = clock()
        _, since_ns, ahead_ns, ppb = _read(content, begin)
        return now_ns + ahead_ns + (now_ns - since_ns) * ppb // PPB

    return wrong


def _read(content: mmap.mmap, begin: int) -> tuple[int, int, int, int]:
    """Return the index of a node's valid setting, and the setting."""
    (turn,) = _TURN.unpack_from(content, begin)
    return (turn, *_SETTING.unpack_from(content, begin + _TURN.size + turn * _SETTING.size))
