"""Messages that a link loses, left out before they are on it: a testbed's links carry TCP.

Nobody can take one message out of a TCP connection on its way: a lost packet is sent again, and
holds up everything behind it. A loss that is meant for messages is therefore drawn by a decorator
of the transport, before a message is on any link.

A message that is for one node, which its key names (`target_of`), is drawn by who sends it. All
others go to several nodes by one put; they are drawn by each process that receives them, by the
node that sent them, which they carry before their header.
"""

from __future__ import annotations

import json
import mmap
import random
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

from dwell.errors import LiveError
from dwell.files import write_whole
from dwell.live.transport.transport import Arrival, Lane, Receive, Transport

__all__ = ["LossFile", "Losses", "LossyTransport", "target_of", "without_source"]

_MAGIC = b"dwelloss"
# Magic, seed, bytes of the names that follow the probabilities.
_HEAD = struct.Struct("<8sQQ")
_VALUE_BYTES = 8
#: Begins a header that says where its message comes from; MessagePack never uses this byte.
_SOURCE = b"\xc1"
#: Keys whose fifth chunk is the one node that a message is for (see `Keys`).
_FOR_ONE_NODE = frozenset({"in", "state", "snapshot"})


def target_of(key: str) -> str | None:
    """Return the node that a message is for, by its key; None where several nodes hear it.

    ``dwell/CELL/in/TASK/NODE/KIND``, ``state/TASK/NODE`` and ``snapshot/TASK/NODE`` are for one.
    """
    chunks = key.split("/")
    return chunks[4] if len(chunks) > 4 and chunks[2] in _FOR_ONE_NODE else None


class LossFile:
    """Probabilities by direction that processes read while they change: the side that writes.

    Every value is 8 bytes at a multiple of 8 and written at once: who reads it sees the old or the
    new one.

    Parameters
    ----------
    path : Path
        Made anew; processes that have one of this name open keep it.
    nodes : sequence of str
    seed : int
        In [0, 2**64).

    Raises
    ------
    LiveError
        If it cannot be written.
    """

    def __init__(self, path: Path, nodes: Sequence[str], *, seed: int = 0) -> None:
        self.path, self.nodes = path, tuple(nodes)
        names = json.dumps(self.nodes).encode()
        content = bytearray(_HEAD.size + _VALUE_BYTES * len(self.nodes) ** 2)
        _HEAD.pack_into(content, 0, _MAGIC, seed, len(names))
        try:
            write_whole(path, bytes(content + names), durable=False)
        except OSError as error:
            raise LiveError(f"{path}: cannot be written ({error.strerror})") from None
        self._values = _values(path, len(self.nodes), mmap.ACCESS_WRITE)

    def set(self, source: str, target: str, probability: float) -> None:
        """Change the share of messages that are lost from one node to another, from now on.

        Raises
        ------
        LiveError
            If there is no such node, or the probability is not in [0, 1].
        """
        for name in (source, target):
            if name not in self.nodes:
                raise LiveError(f"{self.path}: no node {name}; it has {', '.join(self.nodes)}")
        if not 0.0 <= probability <= 1.0:
            raise LiveError(f"loss from {source} to {target}: {probability:g} is not in [0, 1]")
        self._values[_index(self.nodes, source, target)] = probability

    def close(self) -> None:
        """Write no more; the file stays."""
        self._values.release()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Write no more."""
        self.close()


class Losses:
    """What one process leaves out.

    Each process draws each direction from a stream of its own: of the file's seed, its own name
    and the direction. One that is started again begins its streams again.

    Parameters
    ----------
    path : Path
        As `LossFile` has written it.
    who, node : str
        Process, and its node.

    Raises
    ------
    LiveError
        If there is no such file, it is another kind of file, or has no such node.
    """

    def __init__(self, path: Path, who: str, node: str) -> None:
        try:
            content = path.read_bytes()
        except OSError as error:
            raise LiveError(f"{path}: cannot be read ({error.strerror})") from None
        self.node = node
        seed, names = _head(path, content)
        if node not in names:
            raise LiveError(f"{path}: no node {node}; it has {', '.join(names)}")
        values = _values(path, len(names), mmap.ACCESS_READ)
        others = [name for name in names if name != node]
        self._to = {name: _drawer(values, names, node, name, seed, who) for name in others}
        self._from = {name: _drawer(values, names, name, node, seed, who) for name in others}

    def sending(self, key: str) -> Callable[[], bool] | None:
        """Return what draws whether the next message under a key is lost; None if none ever is."""
        target = target_of(key)
        return None if target is None else self._to.get(target)

    def receives(self, key: str, source: str) -> bool:
        """Draw whether a message from a node is received; what its sender draws always is."""
        lost = self._from.get(source)
        return lost is None or target_of(key) is not None or not lost()


class LossyTransport:
    """A transport that leaves messages out; see `Transport`.

    Parameters
    ----------
    transport : Transport
    losses : Losses
    """

    def __init__(self, transport: Transport, losses: Losses) -> None:
        self._transport, self._losses = transport, losses
        node = losses.node.encode()
        self._source = _SOURCE + bytes([len(node)]) + node

    def put(
        self, key: str, payload: bytes | memoryview, header: bytes = b"", *, lane: Lane = "control"
    ) -> None:
        """Send a message, unless it is for one node and lost; else say where it comes from."""
        if target_of(key) is None:
            self._transport.put(key, payload, self._source + header, lane=lane)
            return
        lost = self._losses.sending(key)
        if lost is None or not lost():
            self._transport.put(key, payload, header, lane=lane)

    def subscribe(self, key: str, receive: Receive) -> None:
        """Have `receive` called with every message under a key expression that is not lost."""

        def filtered(sample: Arrival) -> None:
            source, header = without_source(sample.header)
            if self._losses.receives(sample.key, source):
                receive(Arrival(sample.key, sample.payload, header) if source else sample)

        self._transport.subscribe(key, filtered)

    def close(self) -> None:
        """Send and deliver nothing more; safe to call twice."""
        self._transport.close()


def without_source(header: bytes) -> tuple[str, bytes]:
    """Return the node that a message comes from and its own header; no node where none is said."""
    if not header.startswith(_SOURCE):
        return "", header
    end = len(_SOURCE) + 1 + header[len(_SOURCE)]
    return header[len(_SOURCE) + 1 : end].decode(), header[end:]


def _drawer(
    values: memoryview[float], names: Sequence[str], source: str, target: str, seed: int, who: str
) -> Callable[[], bool]:
    index = _index(names, source, target)
    draw = random.Random(f"{seed}/{who}/{source}/{target}").random  # noqa: S311 - no secret

    def lost() -> bool:
        probability: float = values[index]
        return probability > 0.0 and draw() < probability

    return lost


def _index(names: Sequence[str], source: str, target: str) -> int:
    return _HEAD.size // _VALUE_BYTES + names.index(source) * len(names) + names.index(target)


def _head(path: Path, content: bytes) -> tuple[int, tuple[str, ...]]:
    """Return seed and nodes of a file.

    Raises
    ------
    LiveError
        If it is no `LossFile`.
    """
    try:
        magic, seed, length = _HEAD.unpack_from(content)
        names = json.loads(content[len(content) - length :])
        good = magic == _MAGIC and all(isinstance(name, str) for name in names)
        good = good and len(content) == _HEAD.size + _VALUE_BYTES * len(names) ** 2 + length
    except (struct.error, ValueError, TypeError):
        good = False
    if not good:
        raise LiveError(f"{path}: is no file of losses")
    return seed, tuple(names)


def _values(path: Path, nodes: int, access: int) -> memoryview[float]:
    """Map the file; indices are multiples of 8 bytes from its beginning."""
    size = _HEAD.size + _VALUE_BYTES * nodes**2
    with path.open("r+b" if access == mmap.ACCESS_WRITE else "rb") as file:
        return memoryview(mmap.mmap(file.fileno(), size, access=access)).cast("d")
