"""Files about nodes that the processes of a testbed map into their memory, and one of them writes.

A file has a head, numbers whose meaning is its owner's (`dwell.live.local.clocks`,
`dwell.live.local.message_links`), and the names of the nodes.
"""

from __future__ import annotations

import json
import mmap
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

from dwell.errors import LiveError
from dwell.files import write_whole

# Kind of the file, seed, bytes of the names at the end.
HEAD = struct.Struct("<8sQQ")


def make_file(path: Path, kind: str, nodes: Sequence[str], size: int, seed: int = 0) -> mmap.mmap:
    """Make a file anew, with zeros for numbers; processes that have an older one open keep it.

    Parameters
    ----------
    size : int
        Bytes of the numbers, which begin behind `HEAD`.

    Raises
    ------
    LiveError
        If it cannot be written.
    """
    names = json.dumps(list(nodes)).encode()
    content = HEAD.pack(kind.encode(), seed, len(names)) + bytes(size)
    try:
        write_whole(path, content + names, durable=False)
        return _mapped(path)
    except OSError as error:
        raise LiveError(f"{path}: cannot be written ({error.strerror})") from None


def open_file(
    path: Path, kind: str, node: str, size_of: Callable[[int], int]
) -> tuple[mmap.mmap, tuple[str, ...], int]:
    """Open a file that `make_file` has made; returns its content, nodes and seed.

    Parameters
    ----------
    node : str
        Node that has to be in it.
    size_of : callable
        Takes the number of nodes, and returns the bytes of the numbers.

    Raises
    ------
    LiveError
        If there is no such file, it is another kind of file, or has no such node.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise LiveError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        written, seed, length = HEAD.unpack_from(content)
        names = json.loads(content[len(content) - length :])
        good = written == HEAD.pack(kind.encode(), 0, 0)[:8]
        good = good and all(isinstance(name, str) for name in names)
        good = good and len(content) == HEAD.size + size_of(len(names)) + length
    except (struct.error, ValueError, TypeError):
        good = False
    if not good:
        raise LiveError(f"{path}: is no file of {kind}")
    if node not in names:
        raise LiveError(f"{path}: no node {node}; it has {', '.join(names)}")
    return _mapped(path), tuple(names), seed


def _mapped(path: Path) -> mmap.mmap:
    with path.open("r+b") as file:
        return mmap.mmap(file.fileno(), 0)
