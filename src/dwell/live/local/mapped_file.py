"""Files about nodes that the processes of a testbed share as mapped memory.

A file has a head, the numbers of `dwell.live.local.clocks` or `dwell.live.local.message_links`, and
the names of the nodes.
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
    """Make a file with `size` bytes of zeros after `HEAD`; raises a LiveError if that fails.

    Processes that have mapped an older file with this path keep the older file.
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
    """Map a file of `make_file`; return its content, nodes and seed.

    `size_of` returns the bytes of the numbers for a number of nodes. Raises a LiveError if the file
    is missing, of another kind, or lacks the node.
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
