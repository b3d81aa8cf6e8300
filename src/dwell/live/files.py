"""What a process of a live cell keeps across its own death, in files of its node."""

from __future__ import annotations

import json
import mmap
import os
import struct
import zlib
from dataclasses import asdict
from pathlib import Path

from dwell.errors import LiveError
from dwell.live.stamper import Entry

__all__ = ["BookFile", "HighestFile", "InFlight", "make_folder"]

# Run and cycle, and a checksum of the two.
_SLOT = struct.Struct("<qqI")
_LENGTH = struct.Struct("<QI")


def make_folder(path: Path) -> Path:
    """Make a folder for a node's files.

    Raises
    ------
    LiveError
        If it cannot be made or written to.
    """
    try:
        path.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise LiveError(f"{path}: cannot be made ({error.strerror})") from None
    if not os.access(path, os.W_OK):
        raise LiveError(f"{path}: cannot be written to")
    return path


class BookFile:
    """A stamper's `Entry` as a small file, replaced as a whole."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> Entry | None:
        """Return what was written last; None where nothing was, or it cannot be read."""
        try:
            values = json.loads(self.path.read_text(encoding="utf-8"))
            entry = Entry(**values)
        except (OSError, ValueError, TypeError):
            return None
        numbers = (entry.run, entry.reserved, entry.term)
        return entry if all(type(n) is int and n >= 0 for n in numbers) else None

    def write(self, entry: Entry) -> None:
        """Replace the file."""
        draft = self.path.with_suffix(".new")
        draft.write_text(json.dumps(asdict(entry)), encoding="utf-8")
        draft.replace(self.path)


class HighestFile:
    """The highest cycle actuated, in two slots of mapped memory written in turn.

    Mapped memory outlives its process; a process that dies while it writes spoils one slot only.
    """

    def __init__(self, path: Path) -> None:
        size = 2 * _SLOT.size
        with path.open("a+b") as file:
            if file.seek(0, os.SEEK_END) != size:
                file.truncate(0)
                file.truncate(size)
            self._map = mmap.mmap(file.fileno(), size)
        self._turn = 0

    def load(self) -> tuple[int, int]:
        """Return the highest run and cycle of the good slots; (-1, -1) where none is."""
        found = (-1, -1)
        for turn in (0, 1):
            run, cycle, check = _SLOT.unpack_from(self._map, turn * _SLOT.size)
            if check and check == _checksum(run, cycle) and (run, cycle) > found:
                found, self._turn = (run, cycle), 1 - turn
        return found

    def store(self, run: int, cycle: int) -> None:
        """Write the slot that holds the lower one."""
        offset = self._turn * _SLOT.size
        _SLOT.pack_into(self._map, offset, run, cycle, _checksum(run, cycle))
        self._turn = 1 - self._turn


def _checksum(run: int, cycle: int) -> int:
    return zlib.crc32(struct.pack("<qq", run, cycle)) | 1


class InFlight:
    """What a worker is working on, in mapped memory: what it died of, if it dies.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = 0
        self._map: mmap.mmap | None = None

    def begin(self, content: bytes) -> None:
        """Note the inputs of the job that begins."""
        needed = _LENGTH.size + len(content)
        if self._map is None or needed > self._size:
            self._grow(needed)
        if self._map is not None:
            self._map[_LENGTH.size : needed] = content
            _LENGTH.pack_into(self._map, 0, len(content), 1)

    def end(self) -> None:
        """Note that the job is over."""
        if self._map is not None:
            _LENGTH.pack_into(self._map, 0, 0, 0)

    def _grow(self, needed: int) -> None:
        self._size = 1 << (needed - 1).bit_length()
        with self._path.open("a+b") as file:
            file.truncate(self._size)
            self._map = mmap.mmap(file.fileno(), self._size)

    @staticmethod
    def read(path: Path) -> bytes | None:
        """Return the inputs of the job that a dead worker was at; None if it was at none."""
        try:
            data = path.read_bytes()
        except OSError:
            return None
        if len(data) < _LENGTH.size:
            return None
        length, at_work = _LENGTH.unpack_from(data)
        if not at_work or _LENGTH.size + length > len(data):
            return None
        return data[_LENGTH.size : _LENGTH.size + length]
