"""Files about nodes that processes share."""

from __future__ import annotations

from pathlib import Path

import pytest

from dwell.errors import LiveError
from dwell.live.local.mapped_file import HEAD, make_file, open_file

NODES = "R1", "E"


def size_of(count: int) -> int:
    return 8 * count


def test_one_writes_and_others_read(tmp_path: Path) -> None:
    path = tmp_path / "file"
    written = make_file(path, "numbers", NODES, size_of(2), seed=7)
    read, nodes, seed = open_file(path, "numbers", "E", size_of)
    assert (nodes, seed) == (NODES, 7)
    assert read[HEAD.size : HEAD.size + 16] == bytes(16)
    written[HEAD.size] = 9
    assert read[HEAD.size] == 9
    # One that is made anew is another one.
    make_file(path, "numbers", NODES, size_of(2))
    assert read[HEAD.size] == 9


def test_what_is_wrong_with_a_file_is_told(tmp_path: Path) -> None:
    path = tmp_path / "file"
    with pytest.raises(LiveError, match="cannot be read"):
        open_file(path, "numbers", "E", size_of)
    make_file(path, "numbers", NODES, size_of(2))
    with pytest.raises(LiveError, match="is no file of links"):
        open_file(path, "links", "E", size_of)
    with pytest.raises(LiveError, match="is no file of numbers"):
        open_file(path, "numbers", "E", lambda count: 9 * count)
    with pytest.raises(LiveError, match="no node X; it has R1, E"):
        open_file(path, "numbers", "X", size_of)
